"""Plans that are made some at a time, from the same noise as all at once."""

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates, Observed, take
from ftl_lightning.diffusion.samplers import Epsilon, Noise, Sampling
from ftl_lightning.domains.domain import Domain
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.progress import Advance, bar
from ftl_lightning.seeding import generator


@dataclass(frozen=True)
class _Part(Sampling):
    """How some of the plans are generated.

    Attributes:
        own: draws their noise; ``None`` for the noise that the model draws.
        advance: called after each step.
    """

    own: Noise | None = None
    advance: Callable[[], None] = field(default=lambda: None)

    def run(self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor) -> Tensor:
        def told(x: Tensor, t: Tensor) -> Tensor:
            found = epsilon(x, t)
            self.advance()
            return found

        return super().run(told, self.own or noise, alpha_bar)


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
    """Plans of a concept ``(count, horizon, state)``.

    Noise, and modes, are drawn for all plans by the seed alone, so that a plan does not depend on the size of a batch but for
    rounding. Methods without a sampler need one pass of a small network and make all plans at once.

    Args:
        model: that makes them.
        concept: of all of them.
        count: of plans.
        sampling: sampler, steps and temperature.
        seed: of the noise.
        observed: features ``(count, *shape)`` by name, on the model's device.
        batch_size: plans that are made at once; ``None`` for all.
        progress: show a bar.
    """
    size = count if batch_size is None or model.max_steps is None else min(batch_size, count)
    steps = 1 if model.max_steps is None else sampling.steps
    with bar(f"{count} plans", steps * math.ceil(count / size)) if progress else nullcontext(lambda *_: None) as advance:
        if size < count:
            parts = torch.arange(count).split(size)
            return torch.cat([_part(model, concept, count, sampling, seed, observed, rows, advance) for rows in parts])
        how = sampling if model.max_steps is None or not progress else _Part(**asdict(sampling), advance=advance)
        found = model.sample([concept], count, how, [generator("cpu", seed)], observed)[0]
        if model.max_steps is None:
            advance()
        return found


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
    """Some ``rows (n,)`` of the plans of :func:`sampled` ``(n, horizon, state)``: all noise is drawn, and theirs is taken."""
    concept, draw = concept.uncomposed, generator("cpu", seed)
    whole, own = concept.draw(count, draw)
    shape = (count, model.config.horizon, model.config.state_dim)

    def noise() -> Tensor:
        return torch.randn(shape, generator=draw)[rows].to(model.device)

    how = _Part(**asdict(sampling), own=noise, advance=advance)
    seen = take(observed, rows.to(model.device))
    if concept.modes is None:
        return model.sample([concept], len(rows), how, [draw], seen)[0]
    each = [whole.row(number) for number in own[rows.to(own.device)].tolist()]
    return model.sample(each, 1, how, [draw] * len(each), seen)[:, 0]


def plans_of(domain: Domain, states: Tensor, starts: InitialStates | None, provenance: Mapping[str, Any]) -> Demonstrations:
    """Generated plans ``(sample, horizon, state)`` as demonstrations, with where they start."""
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
