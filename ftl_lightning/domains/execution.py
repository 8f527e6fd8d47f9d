"""Execution of plans: closed loop, results of episodes, and the physics simulator of several domains."""

import functools
import importlib
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed, take
from ftl_lightning.domains.films import Frames, VectorFilm

if TYPE_CHECKING:
    import gymnasium

Policy = Callable[[Observed, list[int], int], Tensor]
"""``(observed (episode, *shape) by name, episode indices, step) -> actions (episode, action)``; not finite for no action."""


@dataclass(frozen=True)
class Rollout:
    """Results of executed episodes.

    Attributes:
        starts: initial states.
        observed: kept features by name ``(episode, steps + 1, *shape)``, padded with an episode's last observation.
        failed: ``(episode,)`` of bool: the episode ended as the policy had no finite action or the environment raised an error.
        infos: the environment's info of each episode's last step.
    """

    starts: InitialStates
    observed: Observed
    failed: Tensor
    infos: list[dict[str, Any]]

    def take(self, start: int, end: int) -> "Rollout":
        """Episodes from ``start`` to ``end``."""
        rows = slice(start, end)
        return Rollout(self.starts.take(rows), take(self.observed, rows), self.failed[rows], self.infos[rows])

    def split(self, counts: Sequence[int]) -> list["Rollout"]:
        """Split into parts of ``counts`` episodes."""
        ends = list(itertools.accumulate(counts))
        return [self.take(start, end) for start, end in zip([0, *ends], ends, strict=False)]


@dataclass(frozen=True)
class ClosedLoop:
    """Execution of plans in an environment.

    Attributes:
        environment: constructor of a Gymnasium environment. Observations are the domain's observed features by name;
            ``reset(options={'scene': (scene,)})`` restores a scene; ``judge`` receives the ``info`` of the last step.
        act: planner: ``(plans (episode, horizon, state), steps since the plans were made, observed (episode, *shape) by name) ->
            actions (episode, action)``.
        steps: maximum number of steps in an episode.
        judge: ``(goal, rollout) -> outcomes`` by name, each ``(episode,)``. ``'success'``, of bool, is required.
        film: ``(rollout of an episode, plans (step, horizon, state) that were followed) -> frames``; ``None`` for no film.
        vector_film: ``rollout of an episode -> film`` of moving shapes for ``report --html``; ``None`` for no film.
        keeps: names of the observed features that ``judge`` and films need; empty for all.
        less_is_better: names of the outcomes of which a smaller value is better, such as ``'crash'``.
        identity: description of what outcomes depend on besides the code, such as the planner's name; may be empty. It is part of
            the configuration's hash.
        others: alternative environments by name, such as an environment with another planner. ``evaluation.environments`` selects
            those in which plans are also executed.
        policies: reference policies that act step by step, by name: ``(goal, initial states, demonstrations of the concept or None,
            seed) -> policy``, or ``None`` if it would take too long.
        expect: check that raises a :class:`~ftl_lightning.services.errors.UserError` if the environment lacks a package; called
            before any work.
    """

    environment: "Callable[[], gymnasium.Env[Any, Any]]"
    act: Callable[[Tensor, int, Observed], Tensor]
    steps: int
    judge: Callable[[str, Rollout], dict[str, Tensor]]
    film: Callable[[Rollout, Tensor], Frames] | None = None
    vector_film: Callable[[Rollout], VectorFilm] | None = None
    keeps: tuple[str, ...] = ()
    less_is_better: tuple[str, ...] = ()
    identity: str = ""
    others: "Mapping[str, Callable[[], gymnasium.Env[Any, Any]]]" = field(default_factory=dict)
    policies: Mapping[str, Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]] = field(default_factory=dict)
    expect: Callable[[], None] = lambda: None

    def inside(self, name: str) -> Self:
        """Execution in an alternative environment; in the default environment for the empty name."""
        return replace(self, environment=self.others[name]) if name else self


@functools.cache
def pybullet() -> Any:
    """Import pybullet on first use, without the line it writes to standard error."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        return importlib.import_module("pybullet")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class Simulator:
    """pybullet's functions, bound to a separate simulator; pybullet's class for this prints a line per simulator."""

    def __init__(self) -> None:
        self._id = pybullet().connect(pybullet().DIRECT)
        if self._id < 0:
            raise pybullet().error("no connection")

    def __getattr__(self, name: str) -> Any:
        return functools.partial(getattr(pybullet(), name), physicsClientId=self._id)
