"""Observed features by name, and initial states."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.text import Shown

Observed = Mapping[str, Tensor]
"""Observed features by name, each ``(sample, *shape)``; empty where nothing is observed."""

READ = "(read)"  # no user's feature has this name
"""Key of encoded images ``(sample, n)``, in place of the images."""

PINNED = "(pinned)"  # no user's feature has this name
"""Key of known states ``(sample, horizon, state)`` that a plan has to pass, in the domain's units; NaN where nothing is known."""

COARSE = 1e-4
"""Maximum spacing of float32 at a column's largest number, as a share of the column's range; more needs float64."""
LARGEST_WHOLE = 2**53
"""Largest whole number up to which float64 holds all."""
BLOCK = 2**21
"""Maximum number of states whose precision is examined at once."""
SMOOTH = 0.8
"""Minimum correlation of neighbouring values of a column that moves rather than being noise."""


@dataclass(frozen=True)
class Feature:
    """Shape and kind of an observed feature.

    Attributes:
        shape: shape of a sample, such as ``(7,)`` or ``(3, 96, 96)``.
        kind: ``'vector'`` (float32) or ``'image'`` (uint8, channels first).
        entities: columns of each exchangeable object in a vector, in the same order for each; other columns belong to no object.
        attributes: columns of an object, counted from its first, that a concept may refer to (colour, shape); empty for all.
        state: columns of a vector that hold the state from which a plan starts, in the order of a state; empty for none.

    Raises:
        UserError: at construction, for columns beyond the shape.
    """

    shape: tuple[int, ...]
    kind: Literal["vector", "image"] = "vector"
    entities: tuple[tuple[int, ...], ...] = ()
    attributes: tuple[int, ...] = ()
    state: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        widths = sorted({len(entity) for entity in self.entities})
        require(not widths or (len(widths) == 1 and widths[0]), "entities", "as many columns of each", widths)
        for name, columns, size in (
            ("entities", [column for entity in self.entities for column in entity], self.size),
            ("attributes", self.attributes, max(widths, default=0)),
            ("state", self.state, self.size),
        ):
            require(all(0 <= column < size for column in columns), name, f"columns from 0 to {size - 1}", columns)

    @property
    def size(self) -> int:
        """Number of values in a sample."""
        return math.prod(self.shape)

    @property
    def words(self) -> str:
        """Type and shape of a sample, for messages."""
        return f"{'uint8 images' if self.kind == 'image' else 'float32'} of shape {self.shape}"

    @classmethod
    def of(cls, values: Tensor, leading: int = 1) -> Self:
        """Feature of samples ``(sample, *shape)``, by their type and the axes after the leading ones."""
        return cls(tuple(values.shape[leading:]), "image" if values.dtype == torch.uint8 else "vector")

    def fits(self, expected: "Feature") -> bool:
        """Whether kind and shape equal those of another feature."""
        return (self.kind, self.shape) == (expected.kind, expected.shape)


def precise(values: NDArray[Any], lengths: Sequence[int] | None = None) -> NDArray[np.float32] | NDArray[np.float64]:
    """Convert states ``(demo, time, column)`` to float32, or to float64 if float32 cannot hold how a column varies.

    Args:
        values: numbers of any type; float32 stays float32.
        lengths: number of valid times of each demonstration; ``None`` for all.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported later as a number that is not finite
        single = np.asarray(values, dtype=np.float32)
        short_float = values.dtype.kind == "f" and values.dtype.itemsize <= 4
        if short_float or values.dtype.kind not in "fiu" or values.ndim < 2 or not values.size:
            return single
        columns = values.reshape(*(values.shape[:2] if values.ndim > 2 else (1, len(values))), -1)
        each = max(BLOCK * columns.shape[2] // columns.size, 1)
        parts = (columns[..., first : first + each] for first in range(0, columns.shape[2], each))  # for bounded memory
        coarse = any(_coarse(part, lengths).any() for part in parts)
    return np.asarray(values, dtype=np.float64) if coarse else single


def _coarse(columns: NDArray[Any], lengths: Sequence[int] | None) -> NDArray[np.bool_]:
    """Whether float32 cannot hold how each of ``columns`` ``(demo, time, column)`` varies within valid times."""
    exact = np.asarray(columns, dtype=np.float64)
    valid = np.isfinite(exact)
    if lengths is not None and len(lengths) == len(exact):
        valid &= (np.arange(exact.shape[1]) < np.asarray(lengths)[:, None])[..., None]
    low, high = np.where(valid, exact, np.inf).min(axis=1), np.where(valid, exact, -np.inf).max(axis=1)  # (demo, column)
    size = np.where(valid, np.abs(exact), 0).max(axis=(0, 1), initial=0)
    whole = high.max(axis=0, initial=-np.inf) - low.min(axis=0, initial=np.inf)
    within = (high - low).max(axis=0, initial=0)
    within = np.where(moves(exact, valid), within, whole)  # noise within demonstrations is no movement
    noise = 0 if columns.dtype.kind in "iu" else 1e-12 * size  # of a constant
    return np.asarray((np.spacing(size.astype(np.float32)).astype(np.float64) > COARSE * within) & (within > noise))


def moves(exact: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether columns of ``(demo, time, column)`` move smoothly within demonstrations: neighbouring values are correlated."""
    count = valid.sum(axis=1, keepdims=True)
    centred = np.where(valid, exact - np.where(valid, exact, 0).sum(axis=1, keepdims=True) / np.maximum(count, 1), 0)
    products, squares = (centred[:, 1:] * centred[:, :-1]).sum(axis=(0, 1)), np.square(centred).sum(axis=(0, 1))
    return np.asarray((squares > 0) & (products > SMOOTH * squares))


def check_whole(place: str, values: NDArray[Any]) -> None:
    """Refuse whole numbers that float64 cannot hold; ``UserError`` with the place and the largest number."""
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8 and values.size:
        largest = max((int(values.min()), int(values.max())), key=abs)
        require(abs(largest) <= LARGEST_WHOLE, place, "whole numbers of at most 2^53", f"{largest}; subtract an offset")


def check_single(key: str, values: NDArray[Any]) -> None:
    """Refuse numbers whose differences float32 cannot hold; ``UserError`` with the key.

    Args:
        key: key of the numbers.
        values: ``(demo, ...)`` or ``(demo, time, ...)``.
    """
    flat = values.reshape(len(values), -1) if values.ndim else values
    if values.ndim and values.dtype != np.uint8 and precise(flat).dtype == np.float64:
        size = float(np.nanmax(np.abs(flat)))
        found = f"steps of {np.spacing(np.float32(size)):.2g} near {size:.3g}; subtract an offset"
        raise UserError(f"key {short(key)!r}: expected numbers that float32 can hold, found {found}")


def take(observed: Observed, rows: Tensor | Sequence[int] | slice | int) -> dict[str, Tensor]:
    """Select samples, or a single sample."""
    return {name: values[rows] for name, values in observed.items()}


def moved(observed: Observed, device: torch.device) -> dict[str, Tensor]:
    """Move observed features to a device."""
    return {name: values.to(device) for name, values in observed.items()}


def joined(parts: Sequence[Observed]) -> dict[str, Tensor]:
    """Concatenate samples of several batches."""
    return {name: torch.cat([part[name] for part in parts]) for name in (parts[0] if parts else ())}


def check_features(observed: Observed, expected: Mapping[str, Feature]) -> None:
    """Refuse observations that lack a feature, or hold it with another shape or type (bytes or numbers).

    Raises:
        UserError: naming the feature.
    """
    for name, feature in expected.items():
        names = ", ".join(observed) or "none"
        require(name in observed, "key 'observed'", f"the feature {name!r}, {feature.words}", names)
        given = Feature.of(observed[name])
        require(given.fits(feature), f"key 'observed/{name}'", f"{feature.words} a sample", given.words)


@dataclass(frozen=True, repr=False)
class InitialStates(Shown):
    """Initial states.

    Attributes:
        observed: observed features, the inputs of a model.
        scenes: ``(sample, scene)`` float32, which reset an environment and serve a judge, never a model; ``None`` if there are
            none.
    """

    observed: Observed = field(default_factory=dict)
    scenes: Tensor | None = None

    def _words(self) -> Iterator[str]:
        for name, values in self.observed.items():
            yield f"{name} {tuple(values.shape)}"
        if self.scenes is not None:
            yield f"scenes {tuple(self.scenes.shape)}"

    def __len__(self) -> int:
        return len(next(iter([*self.observed.values(), *([] if self.scenes is None else [self.scenes])]), ()))

    def take(self, rows: Tensor | Sequence[int] | slice) -> Self:
        """Select samples."""
        return type(self)(take(self.observed, rows), None if self.scenes is None else self.scenes[rows])

    def require_scenes(self) -> Tensor:
        """Return the scenes, or raise a :class:`UserError` if there are none."""
        if self.scenes is None:
            raise UserError("key 'scenes': expected (sample, scene), by which an environment is reset, found none")
        return self.scenes


def check_starts(starts: InitialStates | None) -> InitialStates:
    """Return initial states, or raise a :class:`UserError` if they are missing."""
    if starts is None:
        raise UserError("starts: expected initial states, found none; give the observed features where plans start")
    return starts


def joined_starts(parts: Sequence[InitialStates]) -> InitialStates:
    """Concatenate initial states of several batches."""
    scenes = [part.scenes for part in parts if part.scenes is not None]
    return InitialStates(joined([part.observed for part in parts]), torch.cat(scenes) if scenes else None)
