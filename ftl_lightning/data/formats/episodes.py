"""Demonstrations as episodes, the form of other programs: without padding, each with its length."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.actions import held_actions
from ftl_lightning.data.demonstrations import Contents, Demonstrations, padded
from ftl_lightning.data.features import precise
from ftl_lightning.services.errors import require, short
from ftl_lightning.services.files import VARIABLE, most_bytes

PART = "observation"
"""Key of the states in observations of several parts, as in Gymnasium's environments with goals."""


@dataclass(frozen=True)
class Episode:
    """A single demonstration.

    Attributes:
        states: ``(time, state)`` numbers.
        observed: features at each time, by name ``(time, *shape)``, float32, or uint8 for images.
        concept: text of the concept; empty if unknown.
        scene: ``(scene,)`` float32, which resets the environment to the initial state; ``None`` if there is none.
        actions: ``(time, action)`` or ``(time - 1, action)``; ``None`` if unknown.
    """

    states: NDArray[Any]
    observed: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    concept: str = ""
    scene: NDArray[np.float32] | None = None
    actions: NDArray[Any] | None = None


@dataclass(frozen=True)
class Metadata:
    """Attributes of demonstrations that formats of other programs lack, stored beside the episodes as JSON.

    Attributes:
        domain: name of the domain; empty if unknown.
        state_names, state_units: an entry for each column of the states; ``None`` for numbers and no units.
        per_step: names of the features that are known at every time; ``None`` for all. Other features are constant in an episode,
            and known only at its start.
        provenance: origin of the demonstrations.
        state_kinds: kind of each column; empty if all are linear.
        action_names: an entry for each action; empty for numbers.
        acted: whether the written actions are those of the demonstrations, and not what a format requires.
    """

    domain: str = ""
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    per_step: tuple[str, ...] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    state_kinds: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    acted: bool = False


def metadata(demonstrations: Demonstrations) -> dict[str, Any]:
    """Attributes of :class:`Metadata` as JSON can hold them."""
    names = ("domain", "state_names", "state_units", "per_step", "provenance", "state_kinds", "action_names")
    attributes = {name: getattr(demonstrations, name) for name in names}
    return asdict(Metadata(**attributes, acted=demonstrations.actions is not None))


def to_episodes(demonstrations: Demonstrations) -> Iterator[Episode]:
    """Yield each demonstration without padding; features known only at the start are repeated at each time."""
    scenes = demonstrations.scenes
    for row, (length, text) in enumerate(zip(demonstrations.lengths.tolist(), demonstrations.concepts, strict=True)):
        observed = {
            name: (
                values[row, :length] if name in demonstrations.per_step else values[row].expand(length, *values[row].shape)
            ).numpy()
            for name, values in demonstrations.observed.items()
        }
        scene = None if scenes is None else scenes[row].numpy()
        actions = None if demonstrations.actions is None else demonstrations.actions[row, :length].numpy()
        yield Episode(demonstrations.states[row, :length].numpy(), observed, text, scene, actions)


def from_episodes(episodes: Sequence[Episode], given: Metadata) -> Contents:
    """Invert :func:`to_episodes`, padding to the longest with the last state; attributes are not validated.

    Args:
        episodes: episodes with the same columns and observed features; not empty.
        given: attributes stored beside the episodes; features that were not read are ignored.

    Raises:
        UserError: without episodes, or if padding needs far more memory than honest data do.
    """
    require(episodes, "episodes", "at least one", "none")
    first, longest = episodes[0], max(len(episode.states) for episode in episodes)
    size = longest * len(episodes) * sum(values[0].nbytes for values in (first.states, *first.observed.values()))
    message = f"{size}, {len(episodes)} episodes padded to {longest} steps; leave out the longest, or set {VARIABLE} to more"
    require(size <= (most := most_bytes()), "episodes", f"at most {most} bytes", message)
    whole, lengths = padded([_tensor(episode.states) for episode in episodes])
    states = torch.from_numpy(precise(whole.numpy()))
    columns = states.shape[2]
    per_step = tuple(name for name in (first.observed if given.per_step is None else given.per_step) if name in first.observed)
    actions = [_tensor(episode.actions).float() for episode in episodes if episode.actions is not None]
    require(len(actions) in (0, len(episodes)), "actions", "of every episode, or of none", f"of {len(actions)} episodes")
    scenes = [_tensor(episode.scene) for episode in episodes if episode.scene is not None]
    return {
        "states": states,
        "lengths": lengths,
        "domain": given.domain,
        "state_names": tuple(map(str, range(columns))) if given.state_names is None else given.state_names,
        "state_units": ("",) * columns if given.state_units is None else given.state_units,
        "concepts": tuple(episode.concept for episode in episodes),
        "observed": {
            name: padded([_tensor(episode.observed[name]) for episode in episodes])[0]
            if name in per_step
            else torch.stack([_tensor(episode.observed[name][0]) for episode in episodes])
            for name in first.observed
        },
        "per_step": per_step,
        "scenes": torch.stack(scenes) if len(scenes) == len(episodes) else None,
        "provenance": given.provenance,
        "state_kinds": given.state_kinds,
        "actions": held_actions(padded(actions)[0], lengths, states.shape[1]) if actions else None,
        "action_names": given.action_names if actions else (),
    }


def check_names(demonstrations: Demonstrations, reserved: str, place: str) -> None:
    """Refuse names of observed features that a format cannot hold, whose states are named ``reserved``.

    Raises:
        UserError: naming the feature, at the place given.
    """
    expected = f"the name of an observed feature other than {reserved!r} and without '/'"
    for name in demonstrations.observed:
        allowed = name != reserved and "/" not in name and name.isprintable() and name.strip(".")
        require(allowed, place, expected, f"{short(name)!r}; rename it")


def measured(values: Any) -> NDArray[Any]:
    """Convert measurements to float32; images stay uint8."""
    array = np.asarray(values)
    with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
        return array if array.dtype == np.uint8 else array.astype(np.float32)


def _tensor(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.array(values))  # a copy: arrays from files are often read-only
