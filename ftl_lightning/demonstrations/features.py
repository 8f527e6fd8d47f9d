"""What is observed, by name, and where behaviour starts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import torch
from torch import Tensor

from ftl_lightning.errors import UserError, shown
from ftl_lightning.representation import Shown

Observed = Mapping[str, Tensor]
"""Observed features by name, each ``(sample, *shape)``; empty where nothing is observed."""

READ = "(read)"  # not as a feature of anybody's own is named
"""Observed in place of images where they have been read already: what an encoder read of them ``(sample, n)``."""


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
        """What samples ``(sample, *shape)`` are, by their type and what follows the first axes."""
        return cls(tuple(values.shape[leading:]), "image" if values.dtype == torch.uint8 else "vector")

    def fits(self, expected: "Feature") -> bool:
        """Whether kind and shape are those of another feature."""
        return (self.kind, self.shape) == (expected.kind, expected.shape)


def take(observed: Observed, rows: Tensor | Sequence[int] | slice | int) -> dict[str, Tensor]:
    """Some of the samples, or one."""
    return {name: values[rows] for name, values in observed.items()}


def moved(observed: Observed, device: torch.device) -> dict[str, Tensor]:
    """Observed features on a device."""
    return {name: values.to(device) for name, values in observed.items()}


def joined(parts: Sequence[Observed]) -> dict[str, Tensor]:
    """Samples of several batches one after another."""
    return {name: torch.cat([part[name] for part in parts]) for name in (parts[0] if parts else ())}


def expect_features(observed: Observed, expected: Mapping[str, Feature]) -> None:
    """Refuse observations that lack a feature or hold one of another shape, or bytes for numbers and the other way round.

    Raises:
        UserError: naming the feature.
    """
    for name, feature in expected.items():
        if name not in observed:
            found = ", ".join(observed) or "none"
            raise UserError(f"key 'observed': expected the feature {name!r}, {feature.words}, found {found}")
        if not (given := Feature.of(observed[name])).fits(feature):
            raise UserError(f"key 'observed/{name}': expected {feature.words} a sample, found {given.words}")


@dataclass(frozen=True, repr=False)
class InitialStates(Shown):
    """Where behaviour starts.

    Attributes:
        observed: what a model sees there.
        scenes: ``(sample, scene)`` float32, what resets an environment and what a judge reads, never shown to a model; ``None``
            where there is nothing of the kind.
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
        """Some of them."""
        return type(self)(take(self.observed, rows), None if self.scenes is None else self.scenes[rows])

    def require_scenes(self) -> Tensor:
        """The scenes.

        Raises:
            UserError: if there are none.
        """
        if self.scenes is None:
            raise UserError("key 'scenes': expected (sample, scene), what an environment is reset with, found none")
        return self.scenes


def expect_starts(starts: InitialStates | None) -> InitialStates:
    """Where behaviour starts, for what cannot do without.

    Raises:
        UserError: if nothing says where.
    """
    if starts is None:
        raise UserError("starts: expected initial states, found none; give what is observed where plans start")
    return starts


def join(parts: Sequence[InitialStates]) -> InitialStates:
    """Initial states of several batches one after another."""
    scenes = [part.scenes for part in parts if part.scenes is not None]
    return InitialStates(joined([part.observed for part in parts]), torch.cat(scenes) if scenes else None)
