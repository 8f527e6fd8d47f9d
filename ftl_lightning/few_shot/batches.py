"""Sampling of plans in batches, independent of the batch size."""

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed, take
from ftl_lightning.data.pinned import Pinned
from ftl_lightning.domains.domain import Domain
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Epsilon, Noise, Sampling
from ftl_lightning.services.progress import Advance, bar
from ftl_lightning.services.randomness import generator
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
    """Sample plans of a concept ``(count, horizon, state)``.

    Noise and modes are drawn for all plans from the seed, so that plans do not depend on the batch size, up to rounding. Methods
    without a sampler generate all plans in a single pass and ignore the batch size.

    Args:
        observed: features ``(count, *shape)`` by name, on the model's device.
        batch_size: maximum number of plans in a batch; ``None`` for all.
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
    """Generated plans ``(sample, horizon, state)`` as demonstrations, with their initial states."""
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
