"""Compression of observed images in files, by zlib."""

import math
import zlib
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.formats.file_keys import OBSERVED
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.files import check_unpacked

MOST_SHRUNK = 1032
"""Maximum compression ratio of zlib."""


def compressed(images: Tensor) -> Tensor:
    """Compress images ``(demo, ...)`` uint8 to ``(byte,)``."""
    return torch.frombuffer(bytearray(zlib.compress(images.detach().cpu().numpy().tobytes())), dtype=torch.uint8)


def decompressed_images(tensors: Mapping[str, Tensor], shapes: object, per_step: Sequence[str]) -> dict[str, Tensor]:
    """Decompress images of a file, by key, with the shapes in its header.

    Memory is bounded: shapes must begin like that of the states, and nothing beyond them is decompressed.

    Args:
        tensors: tensors of the file, with states ``(demo, time, state)``.
        shapes: shapes by key, from the header.
        per_step: names of features that are known at every time.

    Raises:
        UserError: naming the key, for an impossible shape or damaged bytes.
    """
    if not isinstance(shapes, dict):
        raise UserError(f"key 'compressed': expected shapes of images by key, found {shown(shapes)}")
    images = {}
    for key, shape in shapes.items():
        packed = tensors.get(key)
        if packed is None or not key.startswith(OBSERVED) or packed.dtype != torch.uint8 or packed.dim() != 1:
            actual = "nothing" if packed is None else f"{str(packed.dtype).removeprefix('torch.')} of shape {tuple(packed.shape)}"
            expected = "compressed images, uint8 of shape (byte,) under 'observed/NAME'"
            raise UserError(f"key {short(key)!r}: expected {expected}, found {actual}")
        leading = list(tensors["states"].shape[: 2 if key.removeprefix(OBSERVED) in per_step else 1])
        numbers = isinstance(shape, list) and all(type(size) is int and size >= 0 for size in shape)
        if not numbers or shape[: len(leading)] != leading or math.prod(shape) > MOST_SHRUNK * len(packed):
            begin = ", ".join(map(str, leading))
            raise UserError(
                f"key {key!r}: expected images of shape ({begin}, ...) that fit into {len(packed)} compressed bytes, "
                f"found the shape {shown(shape)} in the header; the file is damaged"
            )
        with about(f"key {short(key)!r}"):
            check_unpacked(math.prod(shape), len(packed), "images")
        content = _decompressed(key, packed.numpy().tobytes(), math.prod(shape))
        images[key] = torch.from_numpy(np.frombuffer(content, dtype=np.uint8)).reshape(shape)
    return images


def _decompressed(key: str, packed: bytes, size: int) -> bytearray:
    reader = zlib.decompressobj()
    try:
        content = bytearray(reader.decompress(packed, size + 1))  # one more, to reach the end
    except zlib.error as error:
        raise UserError(f"key {key!r}: expected compressed images, found damaged bytes ({error}); take another copy") from error
    if len(content) != size or not reader.eof or reader.unused_data:
        more = len(content) > size or reader.unused_data
        actual = "more" if more else f"{len(content)}{'' if reader.eof else ' and no end'}"
        raise UserError(f"key {key!r}: expected {size} bytes of images, found {actual}; the file is damaged: take another copy")
    return content
