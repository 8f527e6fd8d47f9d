import json
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import pytest
import safetensors
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats.file_format import VERSION
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import save_tensors
from tests.data.samples import demonstrations


def filmed(always: bool = True) -> Demonstrations:
    """Two demonstrations with pictures of a square that moves over noise."""
    draw = torch.Generator().manual_seed(0)
    pictures = torch.randint(256, (2, 1, 3, 32, 32), generator=draw, dtype=torch.uint8).repeat(1, 40, 1, 1, 1)
    for time in range(40):
        pictures[:, time, :, time // 2 : time // 2 + 5, 10:15] = 255
    return demonstrations(
        torch.zeros(2, 40, 1),
        observed={"photo": pictures if always else pictures[:, 7], "place": torch.ones(2, 3)},
        per_step=("photo",) if always else (),
    )


def stored(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """What is in a file, whatever it means."""
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["ftl_lightning"])
        return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118


@pytest.mark.parametrize("always", [True, False])
def test_images_are_compressed_in_files_bit_for_bit(always: bool, tmp_path: Path) -> None:
    path, before = tmp_path / "d.safetensors", filmed(always)
    before.save(path)
    tensors, header = stored(path)
    assert header["compressed"] == {"observed/photo": list(before.observed["photo"].shape)}
    assert tensors["observed/photo"].dim() == 1
    assert tensors["observed/photo"].dtype == torch.uint8
    after = Demonstrations.load(path)
    assert torch.equal(after.observed["photo"], before.observed["photo"])
    assert (after.features, after.hash) == (before.features, before.hash)
    after.observed["photo"][0] = 0  # it can be written to
    if always:
        assert path.stat().st_size < before.observed["photo"].nbytes / 10


def squeezed(count: int) -> torch.Tensor:
    return torch.frombuffer(bytearray(zlib.compress(bytes(count))), dtype=torch.uint8)


PHOTO = "observed/photo"
SIZE = 2 * 40 * 3 * 32 * 32
FITS = r"expected images of shape \(2, 40, ...\) that fit into \d+ compressed bytes, found the shape "
SHAPES: list[object] = [[2, 40, 3, 1 << 40, 1 << 40], [2, 40, -3, -32, 32], [2, 39, 3, 32, 32], [3, 40, 3, 32, 32]]
SHAPES += [[2], [2, 40, 3, 32.0, 32], [2, 40, 3, True, 32], "2, 40"]


@pytest.mark.parametrize(
    ("tensors", "header", "message"),
    [
        ({PHOTO: torch.full((999,), 7, dtype=torch.uint8)}, {}, "expected compressed images, found damaged bytes"),
        ({PHOTO: squeezed(SIZE)[:-3]}, {}, f"expected {SIZE} bytes of images, found {SIZE} and no end; the file is damaged"),
        ({PHOTO: squeezed(SIZE)[:-20]}, {}, rf"expected {SIZE} bytes of images, found \d+ and no end"),
        ({PHOTO: squeezed(SIZE - 1)}, {}, f"expected {SIZE} bytes of images, found {SIZE - 1}; the file is damaged"),
        ({PHOTO: squeezed(SIZE + 1)}, {}, f"expected {SIZE} bytes of images, found more"),
        ({PHOTO: torch.cat((squeezed(SIZE), squeezed(5)))}, {}, f"expected {SIZE} bytes of images, found more"),
        ({PHOTO: torch.empty(0, dtype=torch.uint8)}, {}, FITS),
        ({PHOTO: torch.zeros(99)}, {}, r"expected compressed images, uint8 of shape \(byte,\) .*, found float32 of shape \(99,\)"),
        ({PHOTO: torch.zeros(9, 9, dtype=torch.uint8)}, {}, r"expected compressed images, .*, found uint8 of shape \(9, 9\)"),
        *(({}, {"compressed": {PHOTO: shape}}, FITS) for shape in SHAPES),
        ({}, {"compressed": {PHOTO: [2, 40]}}, rf"{PHOTO}': expected 80 bytes of images, found more"),
        ({}, {"compressed": {"observed/view": [2, 40, 3]}}, "key 'observed/view': expected compressed images, .*, found nothing"),
        ({}, {"compressed": {"lengths": [2]}}, "key 'lengths': expected compressed images, .*, found int64 of shape"),
        ({}, {"compressed": [PHOTO]}, "key 'compressed': expected shapes of images by key, found \\['observed/photo'\\]"),
        ({}, {"compressed": None}, "key 'compressed': expected shapes of images by key, found None"),
        ({}, {"compressed": {}}, r"key 'observed/photo': expected shape \(2, 40, ...\), found"),
        ({"states": torch.zeros(2, 40)}, {}, "key 'states': expected float32"),
        ({}, {"per_step": 5}, "key 'per_step': expected a list of texts, found 5"),
        ({}, {"concepts": ["a", 3]}, "key 'concepts': expected a list of texts, found"),
    ],
)
def test_damaged_images_are_told_in_one_line(
    tensors: dict[str, torch.Tensor], header: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    found, told = stored(path)
    save_tensors(path, "demonstrations", found | tensors, {**told, **header}, VERSION)
    with pytest.raises(UserError, match=message) as error:
        Demonstrations.load(path)
    assert str(error.value).startswith(f"{path}: key ")
    assert "\n" not in str(error.value)


def test_nothing_is_decompressed_beyond_what_the_header_says(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    tensors, header = stored(path)
    save_tensors(path, "demonstrations", tensors | {PHOTO: squeezed(100_000_000)}, header, VERSION)
    tracemalloc.start()
    with pytest.raises(UserError, match="found more"):
        Demonstrations.load(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5_000_000


def test_flipped_bits_of_compressed_images_are_found(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    tensors, header = stored(path)
    for place in range(0, len(tensors[PHOTO]), 97):
        damaged = tensors[PHOTO].clone()
        damaged[place] ^= 1 << (place % 8)
        save_tensors(path, "demonstrations", tensors | {PHOTO: damaged}, header, VERSION)
        with pytest.raises(UserError, match="key 'observed/photo'"):
            Demonstrations.load(path)
