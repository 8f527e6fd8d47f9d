"""Quality of samples relative to demonstrations: measures and their description in words."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import path_distance
from ftl_lightning.data.features import InitialStates, moved
from ftl_lightning.data.places import first_windows
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.randomness import generator, task_key

COPIES, COLLAPSED, SMOOTHED = 0.2, 0.5, 0.67
"""Minimum novelty, spread and roughness. Fresh demonstrations of ten data sets lie within the limits of roughness, see
benchmarks/experiments/roughness.py."""
SCATTERED, ROUGH = 2.0, 1.5
"""Maximum spread and roughness."""
THAN = "than your demonstrations"
GENERATED = 40
"""Number of generated samples."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""Sampling: fast, at temperature 1."""
SMOOTH = 0.01
"""Minimum visible roughness: second differences relative to the size of a plan."""
_LEAST = 1e-9


@dataclass(frozen=True)
class Quality:
    """Quality of a concept's samples relative to its demonstrations.

    Attributes:
        novelty: mean distance of samples to the nearest demonstration, divided by the mean distance between nearest
            demonstrations: 0 for copies, about 1 for samples as different as demonstrations. With observations, the demonstration
            that a sample's observation comes from is excluded, since similarity may be right.
        spread: standard deviation over samples divided by that over demonstrations, unbiased, over all columns and times: 0 for
            equal samples.
        roughness: median of second differences over time relative to a plan's variation, divided by the demonstrations'; clipped
            below at :data:`SMOOTH`, which is invisible. 1 for plans of fewer than three states.
    """

    novelty: float
    spread: float
    roughness: float

    @classmethod
    def of(cls, samples: Tensor, demonstrations: Tensor, observed: Tensor | None = None) -> Self:
        """Compare samples with demonstrations.

        Args:
            samples: ``(sample, horizon, state)``, columns on comparable scales, such as a model's normalised columns.
            demonstrations: ``(demo, horizon, state)``, two or more.
            observed: index of the demonstration that each sample's observation comes from ``(sample,)`` int64; ``None`` for none.

        Raises:
            ValueError: for fewer than two demonstrations.
        """
        if len(demonstrations) < 2:
            raise ValueError(f"expected two demonstrations or more, found {len(demonstrations)}")
        among = path_distance(demonstrations, demonstrations).fill_diagonal_(torch.inf).amin(dim=1).mean()
        new = path_distance(samples, demonstrations)
        if observed is not None:
            new = new.scatter(1, observed[:, None], torch.inf)
        return cls(
            novelty=_share(new.amin(dim=1).mean(), among),
            spread=_share(samples.var(dim=0).mean().sqrt(), demonstrations.var(dim=0).mean().sqrt()),
            roughness=_roughness_share(samples, demonstrations) if samples.shape[1] > 2 else 1.0,
        )

    @property
    def words(self) -> str:
        """Description, such as ``'spread 0.31 (collapsed)'``; without a remark within the thresholds."""
        words = [
            f"spread {self.spread:.2f}{_remark(self.spread, COLLAPSED, 'collapsed', SCATTERED, 'scattered')}",
            f"relative novelty {self.novelty:.2f}{_remark(self.novelty, COPIES, 'copies')}",
            f"roughness {self.roughness:.2f}{_remark(self.roughness, SMOOTHED, f'smoother {THAN}', ROUGH, f'rougher {THAN}')}",
        ]
        return ", ".join(words)

    @property
    def numbers(self) -> Mapping[str, float]:
        """Measures by name."""
        return asdict(self)


def roughness(plans: Tensor) -> Tensor:
    """Median over plans ``(plan, horizon, state)`` of the root mean square (RMS) of second differences over time, divided by the
    RMS deviation from the plan's mean. Constant plans are excluded.
    """
    size = (plans - plans.mean(dim=1, keepdim=True)).square().mean(dim=(1, 2)).sqrt()
    second = plans.diff(n=2, dim=1).square().mean(dim=(1, 2)).sqrt()
    moving = size > _LEAST
    return (second[moving] / size[moving]).median() if moving.any() else size.new_zeros(())


def _roughness_share(samples: Tensor, demonstrations: Tensor) -> float:
    sampled, demonstrated = (roughness(plans).clamp(min=SMOOTH) for plans in (samples, demonstrations))
    return float(sampled / demonstrated)


def _share(value: Tensor, whole: Tensor) -> float:
    """Ratio; 1 if both are 0."""
    return float(value / whole) if whole > _LEAST else 1.0 if value <= _LEAST else float(value / _LEAST)


def _remark(value: float, least: float, below: str, most: float = torch.inf, above: str = "") -> str:
    return f" ({below})" if value < least else f" ({above})" if value > most else ""


def measured(model: Invertible, demonstrations: Demonstrations, concepts: Mapping[str, Concept], seed: int) -> dict[str, Quality]:
    """Quality of concepts by name, in the network's normalised inputs, so that columns are comparable.

    Args:
        demonstrations: two or more, which also provide the initial states.
    """
    known = encoded(model, first_windows(demonstrations, model.horizon), demonstrations.initial_states)
    plans, starts = generated(model, demonstrations, concepts, seed)
    return {
        name: Quality.of(encoded(model, samples, starts), known, observed_from(demonstrations)) for name, samples in plans.items()
    }


def generated(
    model: Invertible, demonstrations: Demonstrations, concepts: Mapping[str, Concept], seed: int
) -> tuple[dict[str, Tensor], InitialStates]:
    """Samples of concepts ``(GENERATED, horizon, state)`` by name, and their initial states; arguments as in :func:`measured`."""
    names = list(concepts)
    starts = demonstrations.initial_states.take(_turns(demonstrations))
    seen = {key: value.repeat(len(names), *(1,) * (value.dim() - 1)) for key, value in starts.observed.items()}
    draws = [generator("cpu", seed, 4, task_key(name)) for name in names]
    sampling = replace(SAMPLING, steps=min(SAMPLING.steps, model.max_steps or SAMPLING.steps))
    together = [concepts[name].composition.to(model.device) for name in names]
    plans = model.sample(together, GENERATED, sampling, draws, moved(seen, model.device)).cpu()
    return dict(zip(names, plans, strict=True)), starts


def _turns(demonstrations: Demonstrations) -> Tensor:
    """Index of the demonstration with each sample's initial state ``(GENERATED,)``."""
    return torch.arange(GENERATED) % len(demonstrations)


def observed_from(demonstrations: Demonstrations) -> Tensor | None:
    """The same; ``None`` without observations."""
    return _turns(demonstrations) if demonstrations.observed else None


def encoded(model: Invertible, plans: Tensor, starts: InitialStates) -> Tensor:
    """Normalised plans ``(plan, horizon, state)`` on the CPU."""
    return model.encode(plans.to(model.device), moved(starts.observed, model.device)).cpu()
