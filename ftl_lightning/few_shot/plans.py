"""Sampling of plans in batches, independent of the batch size, and their execution: outcomes, frames and films of episodes."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.deformation import Pinned
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed, take
from ftl_lightning.domains.domain import Domain, closed_loop_of
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, roll_out, sampled_plans
from ftl_lightning.evaluation.pictures import captioned, gif, outcome_text
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Epsilon, Noise, Sampling
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.progress import Advance, bar
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import atomic
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.training.concept_model import ConceptModel


@dataclass(frozen=True)
class _Part(Sampling):
    """Sampling of some of the plans, with given ``noise``."""

    noise: Noise | None = None
    advance: Callable[[], None] = field(default=lambda: None)

    def run(self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, pinned: Pinned | None = None) -> Tensor:
        def predict(x: Tensor, t: Tensor) -> Tensor:
            predicted = epsilon(x, t)
            self.advance()
            return predicted

        return super().run(predict, self.noise or noise, alpha_bar, pinned)


def sampled(
    model: ConceptModel,
    concept: Composition,
    count: int,
    sampling: Sampling,
    seed: int,
    observed: Observed,
    batch_size: int | None = None,
    progress: bool = False,
) -> Tensor:
    """Sample ``count`` plans of a concept by a ``model``, ``(count, horizon, state)``.

    Noise and modes are drawn for all plans from the seed, so that plans do not depend on the batch size, up to rounding. Methods
    without a sampler generate all plans in a single pass and ignore the batch size.

    Args:
        concept: ``(K, ...)``.
        sampling, seed: sampler, steps and temperature; seed of the noise.
        observed: features ``(count, *shape)`` by name, on the model's device.
        batch_size: maximum number of plans in a batch; ``None`` for all.
        progress: whether to show a bar.
    """
    size = count if batch_size is None or model.max_steps is None else min(batch_size, count)
    steps = 1 if model.max_steps is None else sampling.steps
    with bar(f"{count} plans", steps * math.ceil(count / size)) if progress else nullcontext(lambda *_: None) as advance:
        if size < count:
            parts = torch.arange(count).split(size)
            return torch.cat([_part(model, concept, count, sampling, seed, observed, rows, advance) for rows in parts])
        how = sampling if model.max_steps is None or not progress else _Part(**asdict(sampling), advance=advance)
        plans = model.sample([concept], count, how, [generator("cpu", seed)], observed)[0]
        if model.max_steps is None:
            advance()
        return plans


def _part(
    model: ConceptModel,
    concept: Composition,
    count: int,
    sampling: Sampling,
    seed: int,
    observed: Observed,
    rows: Tensor,
    advance: Advance | Callable[..., None],
) -> Tensor:
    """Plans ``(n, horizon, state)`` of some ``rows (n,)`` in :func:`sampled`; noise is drawn for all rows and selected."""
    concept, draw = concept.uncomposed, generator("cpu", seed)
    compositions, numbers = concept.draw(count, draw)
    shape = (count, model.config.horizon, model.config.state_dim)

    def noise() -> Tensor:
        return torch.randn(shape, generator=draw)[rows].to(model.device)

    how = _Part(**asdict(sampling), noise=noise, advance=advance)
    features = take(observed, rows.to(model.device))
    if concept.modes is None:
        return model.sample([concept], len(rows), how, [draw], features)[0]
    modes = [compositions.row(number) for number in numbers[rows.to(numbers.device)].tolist()]
    return model.sample(modes, 1, how, [draw] * len(modes), features)[:, 0]


def plans_of(domain: Domain, states: Tensor, starts: InitialStates | None, provenance: Mapping[str, Any]) -> Demonstrations:
    """Generated plans as demonstrations.

    Args:
        domain, starts, provenance: of the demonstrations.
        states: plans ``(sample, horizon, state)``.
    """
    return Demonstrations(
        states=states,
        lengths=torch.full((len(states),), states.shape[1]),
        domain=domain.name,
        state_names=domain.plans.columns,
        state_units=domain.plans.units,
        concepts=("",) * len(states),
        observed={} if starts is None else starts.observed,
        scenes=None if starts is None else starts.scenes,
        provenance=provenance,
    )


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
