"""Observed features by name, and initial states."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import torch
from torch import Tensor

from ftl_lightning.services.errors import UserError, shown
from ftl_lightning.services.text import Shown

Observed = Mapping[str, Tensor]
"""Observed features by name, each ``(sample, *shape)``; empty where nothing is observed."""

READ = "(read)"  # no user's feature has this name
"""Key of encoded images ``(sample, n)``, in place of the images."""


@dataclass(frozen=True)
class Feature:
    """One part of what is observed.

    Attributes:
        shape: shape of one sample, such as ``(7,)`` or ``(3, 96, 96)``.
        kind: ``'vector'`` (float32) or ``'image'`` (uint8, channels first).
        entities: for a vector: the columns of each of its exchangeable objects, in the same order for each. The other columns
            belong to no single object.
        attributes: which of an object's columns, counted from its first, a concept may refer to (colour, shape); all where empty.
        state: for a vector: the columns that hold the state a plan starts from, in the order of a state; empty where it holds none.

    Raises:
        UserError: at construction, for columns that it does not have.
    """

    shape: tuple[int, ...]
    kind: Literal["vector", "image"] = "vector"
    entities: tuple[tuple[int, ...], ...] = ()
    attributes: tuple[int, ...] = ()
    state: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        widths = {len(entity) for entity in self.entities}
        if len(widths) > 1 or widths == {0}:
            raise UserError(f"entities: expected as many columns of each, found {shown(sorted(widths))}")
        for name, columns, size in (
            ("entities", [column for entity in self.entities for column in entity], self.size),
            ("attributes", self.attributes, max(widths, default=0)),
            ("state", self.state, self.size),
        ):
            if any(not 0 <= column < size for column in columns):
                raise UserError(f"{name}: expected columns from 0 to {size - 1}, found {shown(columns)}")

    @property
    def size(self) -> int:
        """Numbers in one sample."""
        return math.prod(self.shape)

    @property
    def words(self) -> str:
        """Type and shape of one sample, for messages."""
        return f"{'uint8 images' if self.kind == 'image' else 'float32'} of shape {self.shape}"

    @classmethod
    def of(cls, values: Tensor, leading: int = 1) -> Self:
        """Feature of samples ``(sample, *shape)``, by their type and the axes after the leading ones."""
        return cls(tuple(values.shape[leading:]), "image" if values.dtype == torch.uint8 else "vector")

    def fits(self, expected: "Feature") -> bool:
        """Whether kind and shape equal those of another feature."""
        return (self.kind, self.shape) == (expected.kind, expected.shape)


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
        if name not in observed:
            names = ", ".join(observed) or "none"
            raise UserError(f"key 'observed': expected the feature {name!r}, {feature.words}, found {names}")
        if not (given := Feature.of(observed[name])).fits(feature):
            raise UserError(f"key 'observed/{name}': expected {feature.words} a sample, found {given.words}")


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
        """Return the scenes.

        Raises:
            UserError: if there are none.
        """
        if self.scenes is None:
            raise UserError("key 'scenes': expected (sample, scene), what an environment is reset with, found none")
        return self.scenes


def check_starts(starts: InitialStates | None) -> InitialStates:
    """Return initial states.

    Raises:
        UserError: if they are missing.
    """
    if starts is None:
        raise UserError("starts: expected initial states, found none; give what is observed where plans start")
    return starts


def join(parts: Sequence[InitialStates]) -> InitialStates:
    """Concatenate initial states of several batches."""
    scenes = [part.scenes for part in parts if part.scenes is not None]
    return InitialStates(joined([part.observed for part in parts]), torch.cat(scenes) if scenes else None)
