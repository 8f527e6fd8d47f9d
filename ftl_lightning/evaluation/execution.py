"""Execution in the Python API: outcomes, frames and films of episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Domain, closed_loop_of
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, roll_out, sampled_plans
from ftl_lightning.evaluation.pictures import captioned, gif, outcome_text
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import atomic
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.training.concept_model import ConceptModel


def episodes(
    model: ConceptModel,
    loop: ClosedLoop,
    concept: Composition,
    starts: InitialStates,
    sampling: Sampling,
    replan: int,
    seed: int,
) -> tuple[Rollout, Mapping[int, Sequence[Tensor]]]:
    """Execute a ``concept`` ``(K, ...)`` by plans of ``model`` in ``loop``, an episode from each of ``starts``, which have scenes.

    Args:
        sampling, seed: sampler, steps and temperature; seed of the noise.
        replan: number of steps before replanning.

    Returns:
        Rollout, and the plan ``(horizon, state)`` at each step, by episode.
    """
    draws = [generator("cpu", seed, 1, episode) for episode in range(len(starts))]
    make = sampled_plans(model, [concept] * len(starts), sampling, draws)
    policy = PlanFollower(make, planner(model, loop), replan)
    return roll_out(loop, starts, policy), policy.followed


@dataclass(frozen=True, repr=False)
class Execution(Shown):
    """Executed episodes.

    Attributes:
        domain: domain of the environment.
        goal: goal as text; empty without a judgement.
        rollout: recorded episodes.
        followed: plan ``(horizon, state)`` at each step, by episode.
    """

    domain: Domain
    goal: str
    rollout: Rollout
    followed: Mapping[int, Sequence[Tensor]]

    def _words(self) -> Iterator[str]:
        yield repr(self.domain.name)
        yield counted(len(self.rollout.failed), "episode")
        if self.goal:
            yield f"goal {self.goal!r}"
        for name, value in self.outcomes.items():
            yield f"{name} {value:.2f}"

    def _judged(self) -> dict[str, Tensor]:
        return self.domain.judge(self.goal, self.rollout) if self.goal else {}

    @property
    def outcomes(self) -> dict[str, float]:
        """Share of episodes (boolean outcomes) or mean (numeric outcomes) by name; empty without a goal."""
        return {name: float(values.float().mean()) for name, values in self._judged().items()}

    def frames(self, episode: int = 0) -> list[NDArray[np.uint8]]:
        """Render the frames ``(height, width, 3)`` of an ``episode``, a number from 0.

        Raises:
            UserError: for an episode that did not begin, or a domain without films of episodes.
        """
        began = isinstance(episode, int) and self.followed.get(episode)
        require(began, "episode", f"one of {len(self.rollout.failed)} that began", episode)
        if (film := closed_loop_of(self.domain).film) is None:
            raise UserError(f"film: expected a domain that films episodes, found {self.domain.name}")
        return film(self.rollout.take(episode, episode + 1), torch.stack(list(self.followed[episode])))

    def save(self, path: str | Path, episode: int = 0) -> None:
        """Save an ``episode``, a number from 0, to a ``path`` that ends in .gif.

        Raises:
            UserError: for another suffix, an episode that did not begin, or a domain without films of episodes.
        """
        suffix = Path(path).suffix
        require(suffix == ".gif", str(path), "a name that ends in .gif", suffix or "no ending")
        pictures = captioned(self.frames(episode), self.goal, outcome_text(self._judged(), episode))
        with atomic(path) as temporary:
            temporary.write_bytes(gif(pictures))
