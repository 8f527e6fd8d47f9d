"""Demonstrations as episodes: how other programs record behaviour, one after another, each of its own length and without padding.

Two things are not told by episodes alone and stand beside them, see :class:`Beside`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.demonstrations.file_format import Contents
from ftl_lightning.errors import UserError, short
from ftl_lightning.limits import VARIABLE, most_bytes


@dataclass(frozen=True)
class Episode:
    """One demonstration.

    Attributes:
        states: ``(time, state)`` float32.
        observed: what is observed at each time, by name ``(time, *shape)``, float32, or uint8 of images.
        concept: its text; empty where it has none.
        scene: ``(scene,)`` float32, what resets the environment to its start; ``None`` where there is nothing of the kind.
    """

    states: NDArray[np.float32]
    observed: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    concept: str = ""
    scene: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Beside:
    """What the formats of other programs have no place for. It is written beside the episodes, as JSON.

    Attributes:
        domain: name of the domain; empty where it is not known.
        state_names, state_units: one a column of the states; ``None`` for numbers and no units.
        per_step: names of the observed features that are known at every time; ``None`` for all. The others are the same at all
            times of an episode, and known at its start alone.
        provenance: how the demonstrations came about.
    """

    domain: str = ""
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    per_step: tuple[str, ...] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def of(self, observed: Sequence[str], own_states: bool) -> Self:
        """The same where a reader asked for some of the features, or for other states than those that were written.

        Args:
            observed: features that are read.
            own_states: whether the states are those that were written; names and units are theirs.
        """
        per_step = None if self.per_step is None else tuple(name for name in self.per_step if name in observed)
        names, units = (self.state_names, self.state_units) if own_states else (None, None)
        return replace(self, state_names=names, state_units=units, per_step=per_step)


def beside(demonstrations: Demonstrations) -> dict[str, Any]:
    """What :class:`Beside` says of demonstrations, as JSON can hold it."""
    names = ("domain", "state_names", "state_units", "per_step", "provenance")
    return asdict(Beside(**{name: getattr(demonstrations, name) for name in names}))


def episodes(demonstrations: Demonstrations) -> Iterator[Episode]:
    """Each demonstration without its padding; what is observed once is repeated at each time."""
    scenes = demonstrations.scenes
    for row, (length, text) in enumerate(zip(demonstrations.lengths.tolist(), demonstrations.concepts, strict=True)):
        observed = {
            name: values[row, :length] if name in demonstrations.per_step else values[row].expand(length, *values[row].shape)
            for name, values in demonstrations.observed.items()
        }
        yield Episode(
            demonstrations.states[row, :length].numpy(),
            {name: values.numpy() for name, values in observed.items()},
            text,
            None if scenes is None else scenes[row].numpy(),
        )


def contents(found: Sequence[Episode], told: Beside) -> Contents:
    """The inverse of :func:`episodes`, padded to the longest with the last state.

    Args:
        found: at least one, all with the same columns and observed features.
        told: what stands beside them.

    Returns:
        The attributes of demonstrations; whether they fit each other is known once these are made.

    Raises:
        UserError: where there is none, or padding them would need far more memory than honest data do.
    """
    if not found:
        raise UserError("expected at least one episode, found none")
    longest = max(len(one.states) for one in found)
    step = sum(values[0].nbytes for values in (found[0].states, *found[0].observed.values()))
    if (size := longest * len(found) * step) > (most := most_bytes()):
        told_size = f"{len(found)} episodes, the longest of {longest} steps, which are {size} bytes padded to it"
        raise UserError(f"expected at most {most} bytes, found {told_size}; leave out the longest, or set {VARIABLE} to more")
    states, lengths = padded([_tensor(one.states) for one in found])
    per_step = tuple(found[0].observed) if told.per_step is None else told.per_step
    columns = states.shape[2]
    return {
        "states": states,
        "lengths": lengths,
        "domain": told.domain,
        "state_names": tuple(map(str, range(columns))) if told.state_names is None else told.state_names,
        "state_units": ("",) * columns if told.state_units is None else told.state_units,
        "concepts": tuple(one.concept for one in found),
        "observed": {name: _observed(found, name, name in per_step) for name in found[0].observed},
        "per_step": per_step,
        "scenes": _scenes(found),
        "provenance": told.provenance,
    }


def expect_names(demonstrations: Demonstrations, taken: str, where: str) -> None:
    """Refuse names of observed features that another format cannot hold.

    Args:
        demonstrations: whose names they are.
        taken: the name under which the format holds the states.
        where: they are written, for messages.

    Raises:
        UserError: naming the feature.
    """
    for name in demonstrations.observed:
        if name == taken or "/" in name or not name.isprintable() or not name.strip("."):
            expected = f"the name of an observed feature other than {taken!r} and without '/'"
            raise UserError(f"{where}: expected {expected}, found {short(name)!r}; rename it")


def _tensor(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.array(values))  # a copy: what is read from files often cannot be written to


def _observed(found: Sequence[Episode], name: str, per_step: bool) -> Tensor:
    if per_step:
        return padded([_tensor(one.observed[name]) for one in found])[0]
    return torch.stack([_tensor(one.observed[name][0]) for one in found])


def _scenes(found: Sequence[Episode]) -> Tensor | None:
    scenes = [_tensor(one.scene) for one in found if one.scene is not None]
    return torch.stack(scenes) if len(scenes) == len(found) else None
