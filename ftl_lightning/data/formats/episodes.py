"""Demonstrations as episodes, the form of other programs: without padding, each with its length.

Attributes that episodes lack are stored beside them, see :class:`Beside`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.container import Demonstrations, padded
from ftl_lightning.data.formats.file_format import Contents
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.files import VARIABLE, most_bytes


@dataclass(frozen=True)
class Episode:
    """A single demonstration.

    Attributes:
        states: ``(time, state)`` float32.
        observed: features at each time, by name ``(time, *shape)``, float32, or uint8 for images.
        concept: text of the concept; empty if unknown.
        scene: ``(scene,)`` float32, which resets the environment to the initial state; ``None`` if there is none.
    """

    states: NDArray[np.float32]
    observed: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    concept: str = ""
    scene: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Beside:
    """Attributes that formats of other programs lack, stored beside the episodes as JSON.

    Attributes:
        domain: name of the domain; empty if unknown.
        state_names, state_units: an entry for each column of the states; ``None`` for numbers and no units.
        per_step: names of the features that are known at every time; ``None`` for all. Other features are constant in an episode,
            and known only at its start.
        provenance: origin of the demonstrations.
    """

    domain: str = ""
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    per_step: tuple[str, ...] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def of(self, observed: Sequence[str], own_states: bool) -> Self:
        """Restrict the attributes to the features and states that are read.

        Args:
            observed: names of features that are read.
            own_states: whether the states are those that were written, to which names and units belong.
        """
        per_step = None if self.per_step is None else tuple(name for name in self.per_step if name in observed)
        names, units = (self.state_names, self.state_units) if own_states else (None, None)
        return replace(self, state_names=names, state_units=units, per_step=per_step)


def beside(demonstrations: Demonstrations) -> dict[str, Any]:
    """Attributes of :class:`Beside` as JSON can hold them."""
    names = ("domain", "state_names", "state_units", "per_step", "provenance")
    return asdict(Beside(**{name: getattr(demonstrations, name) for name in names}))


def episodes(demonstrations: Demonstrations) -> Iterator[Episode]:
    """Yield each demonstration without padding; features known only at the start are repeated at each time."""
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
    """Invert :func:`episodes`, padding to the longest with the last state.

    Args:
        found: at least one episode, all with the same columns and observed features.
        told: attributes beside the episodes.

    Returns:
        Attributes of demonstrations, not validated yet.

    Raises:
        UserError: without episodes, or if padding needs far more memory than honest data do.
    """
    if not found:
        raise UserError("expected at least one episode, found none")
    longest = max(len(episode.states) for episode in found)
    step = sum(values[0].nbytes for values in (found[0].states, *found[0].observed.values()))
    if (size := longest * len(found) * step) > (most := most_bytes()):
        message = f"{len(found)} episodes, the longest of {longest} steps, which are {size} bytes padded to it"
        raise UserError(f"expected at most {most} bytes, found {message}; leave out the longest, or set {VARIABLE} to more")
    states, lengths = padded([_tensor(episode.states) for episode in found])
    per_step = tuple(found[0].observed) if told.per_step is None else told.per_step
    columns = states.shape[2]
    return {
        "states": states,
        "lengths": lengths,
        "domain": told.domain,
        "state_names": tuple(map(str, range(columns))) if told.state_names is None else told.state_names,
        "state_units": ("",) * columns if told.state_units is None else told.state_units,
        "concepts": tuple(episode.concept for episode in found),
        "observed": {name: _observed(found, name, name in per_step) for name in found[0].observed},
        "per_step": per_step,
        "scenes": _scenes(found),
        "provenance": told.provenance,
    }


def check_names(demonstrations: Demonstrations, taken: str, where: str) -> None:
    """Refuse names of observed features that another format cannot hold.

    Args:
        demonstrations: demonstrations to write.
        taken: name of the states in the format.
        where: target, for messages.

    Raises:
        UserError: naming the feature.
    """
    for name in demonstrations.observed:
        if name == taken or "/" in name or not name.isprintable() or not name.strip("."):
            expected = f"the name of an observed feature other than {taken!r} and without '/'"
            raise UserError(f"{where}: expected {expected}, found {short(name)!r}; rename it")


def _tensor(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.array(values))  # a copy: arrays from files are often read-only


def _observed(recorded: Sequence[Episode], name: str, per_step: bool) -> Tensor:
    if per_step:
        return padded([_tensor(episode.observed[name]) for episode in recorded])[0]
    return torch.stack([_tensor(episode.observed[name][0]) for episode in recorded])


def _scenes(recorded: Sequence[Episode]) -> Tensor | None:
    scenes = [_tensor(episode.scene) for episode in recorded if episode.scene is not None]
    return torch.stack(scenes) if len(scenes) == len(recorded) else None
