"""Files of demonstrations: safetensors, compressed images, npz, and the cache."""

import json
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Feature
from ftl_lightning.data.formats.files import VERSION, Tell, cached
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import file_hash, save_tensors
from tests.data.samples import demonstrations, everything, expect_same

shapes = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 6))


@settings(max_examples=10, deadline=None)
@given(shape=shapes, seed=st.integers(0, 2**31), initial=st.booleans(), text=st.text(max_size=20))
def test_round_trip_through_a_file_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], seed: int, initial: bool, text: str
) -> None:
    draw = torch.Generator().manual_seed(seed)
    states = torch.randn(shape, generator=draw) * 1e3
    photos = torch.randint(256, (shape[0], 3, 2, 2), generator=draw, dtype=torch.uint8)
    before = demonstrations(
        states,
        concepts=(text,) * shape[0],
        observed={"place": torch.randn((*shape[:2], 3), generator=draw), "photo": photos} if initial else {},
        per_step=("place",) if initial else (),
        scenes=torch.randn((shape[0], 4), generator=draw) if initial else None,
        provenance={"seed": seed, "nested": {"a": [1, None]}},
    )
    path = tmp_path_factory.mktemp("demos") / "d.safetensors"
    before.save(path)
    after = Demonstrations.load(path)
    assert torch.equal(after.states, before.states)
    assert torch.equal(after.lengths, before.lengths)
    assert after.observed.keys() == before.observed.keys()
    for name, values in before.observed.items():
        assert torch.equal(after.observed[name], values)
        assert after.observed[name].dtype == values.dtype
    assert (after.per_step, after.features) == (before.per_step, before.features)
    assert (after.scenes is None) == (not initial)
    assert after.scenes is None or torch.equal(after.scenes, before.scenes)  # type: ignore[arg-type]
    assert (after.concepts, after.provenance, after.hash) == (before.concepts, before.provenance, before.hash)
    first = file_hash(path)
    after.save(path)
    assert file_hash(path) == first  # the same content gives the same bytes


def test_damaged_and_foreign_files_are_told_apart_and_an_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    with pytest.raises(UserError, match="found nothing"):
        Demonstrations.load(path)
    demonstrations(torch.zeros(2, 1, 3)).save(path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(UserError, match="damaged or foreign"):
        Demonstrations.load(path)
    with pytest.raises(UserError, match=r"d\.safetensors/e\.safetensors: cannot be written"):
        demonstrations(torch.zeros(1, 1, 1)).save(path / "e.safetensors")


def test_what_is_observed_may_be_the_scene_itself(tmp_path: Path) -> None:
    same = torch.arange(6.0).reshape(2, 3)
    demonstrations(torch.zeros(2, 1, 1), observed={"world": same}, scenes=same).save(tmp_path / "d.safetensors")
    found = Demonstrations.load(tmp_path / "d.safetensors")
    assert found.scenes is not None
    assert torch.equal(found.scenes, found.observed["world"])
    assert torch.equal(found.scenes, same)


@pytest.mark.parametrize("version", [1, VERSION - 1, VERSION + 1, True, "4"])
def test_a_file_of_another_version_is_refused(version: Any) -> None:
    save_tensors("d.safetensors", "demonstrations", {"states": torch.zeros(2, 4, 1)}, {}, version)
    with pytest.raises(UserError, match=rf"^d\.safetensors: key 'format': expected {VERSION}, found .*; it is of another version$"):
        Demonstrations.load("d.safetensors")


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
SHAPES: dict[str, list[object]] = {
    FITS: [[2, 40, 3, 10**6, 10**6], [2, 39, 3, 32, 32], [3, 40, 3, 32, 32], [2]],
    rf"key 'compressed.{PHOTO}\[\d\]': expected a whole number": [[2, 40, 3, 1 << 40], [2, 40, -3], [2, 40, 3.0], [2, 40, True]],
    f"key 'compressed.{PHOTO}': expected a list, found '2, 40'": ["2, 40"],
}


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
        *(({}, {"compressed": {PHOTO: shape}}, message) for message, shapes in SHAPES.items() for shape in shapes),
        ({}, {"compressed": {PHOTO: [2, 40]}}, rf"{PHOTO}': expected 80 bytes of images, found more"),
        ({}, {"compressed": {"observed/view": [2, 40, 3]}}, "key 'observed/view': expected compressed images, .*, found nothing"),
        ({}, {"compressed": {"lengths": [2]}}, "key 'lengths': expected compressed images, .*, found int64 of shape"),
        ({}, {"compressed": [PHOTO]}, r"key 'compressed': expected a mapping, found \['observed/photo'\]"),
        ({}, {"compressed": None}, "key 'compressed': expected a mapping, found None"),
        ({}, {"compressed": {}}, r"key 'observed/photo': expected shape \(2, 40, ...\), found"),
        ({"states": torch.zeros(2, 40)}, {}, "key 'states': expected float32"),
        ({}, {"per_step": 5}, "key 'per_step': expected a list, found 5"),
        ({}, {"concepts": ["a", 3]}, r"key 'concepts\[1\]': expected a text, found 3"),
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


def test_npz_is_accepted_without_objects(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", states=np.ones((2, 1, 21)), concepts=np.array(["a", "b"]))
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.states.shape == (2, 1, 21)
    assert loaded.states.dtype == torch.float32
    assert loaded.concepts == ("a", "b")
    np.savez(tmp_path / "o.npz", states=np.array([{}], dtype=object))
    with pytest.raises(UserError, match=r"o\.npz: expected an \.npz of plain arrays"):
        Demonstrations.load(tmp_path / "o.npz")


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written = everything()
    written.save(tmp_path / "d.npz")
    expect_same(Demonstrations.load(tmp_path / "d.npz"), written, provenance=False)
    assert dict(np.load(tmp_path / "d.npz", allow_pickle=False))["concepts"].tolist() == list(written.concepts)
    assert [path.name for path in tmp_path.iterdir()] == ["d.npz"]


def test_images_stay_bytes_in_npz_files_and_in_our_own(tmp_path: Path) -> None:
    photos = np.arange(2 * 4 * 3 * 2 * 2, dtype=np.uint8).reshape(2, 4, 3, 2, 2)
    arrays = {"observed/photo": photos, "observed/place": np.ones((2, 3)), "scenes": np.ones((2, 5), dtype=np.uint8)}
    np.savez(tmp_path / "d.npz", states=np.ones((2, 4, 1), dtype=np.uint8), per_step=np.array(["photo"]), **arrays)
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.states.dtype == torch.float32  # bytes are images only among what is observed
    assert loaded.scenes is not None
    assert loaded.scenes.dtype == torch.float32
    assert loaded.features == {"photo": Feature((3, 2, 2), "image"), "place": Feature((3,))}
    loaded.save(tmp_path / "d.safetensors")
    again = Demonstrations.load(tmp_path / "d.safetensors")
    assert again.observed["photo"].dtype == torch.uint8
    assert np.array_equal(again.observed["photo"].numpy(), photos)
    assert again.features == loaded.features
    assert again.per_step == ("photo",)
    assert (tmp_path / "d.safetensors").stat().st_size < photos.nbytes + 2000
    first = again.initial_states
    assert np.array_equal(first.observed["photo"].numpy(), photos[:, 0])
    assert first.observed["place"].shape == (2, 3)
    assert first.scenes is not None
    assert first.scenes.shape == (2, 5)
    assert again.every_observation["photo"].shape == (8, 3, 2, 2)
    assert again.every_observation["place"].shape == (2, 3)


def test_demonstrations_are_made_once_and_again_where_their_file_is_damaged(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def make(tell: Tell) -> Demonstrations:
        calls.append(1)
        return demonstrations(torch.ones(2, 3, 1))

    first, second = (cached({"domain": "made"}, 2, make) for _ in range(2))
    assert len(calls) == 1
    assert first.hash == second.hash
    (file,) = Path("cache/ftl-lightning").glob("made-*.safetensors")
    file.write_bytes(file.read_bytes()[:-3])
    remove = Path.unlink

    def removed_by_another_process_first(path: Path, missing_ok: bool = False) -> None:
        if path.name == file.name:
            remove(path)
        remove(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", removed_by_another_process_first)
    assert cached({"domain": "made"}, 2, make).hash == first.hash
    assert len(calls) == 2
