"""Does generated behaviour look like the demonstrations? Measures that need nothing but the two, and what they mean in words."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from ftl_lightning.concepts.concept import Concept, QualityRecord
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates, moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.beside import Drawn, beside
from ftl_lightning.domains.distances import path_distance
from ftl_lightning.domains.domain import Domain
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.seeding import generator, task_key

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COPIES, COLLAPSED, ROUGH = 0.2, 0.5, 1.5
"""Novelty and spread below which, and roughness above which samples are called so."""
SCATTERED = 2.0
"""Spread above which samples are called so."""
GENERATED, SHOWN = 40, 16
"""Samples that are looked at, and those that are drawn."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""How they are generated: quickly, and as widely as the model does."""
SMOOTH = 0.01
"""Second differences by the size of a plan, of which nobody sees less."""
_LEAST = 1e-9


@dataclass(frozen=True)
class Quality:
    """What samples of a concept are like beside the demonstrations that it was learned from.

    Attributes:
        novelty: how far a sample is from the nearest demonstration, as a share of how far demonstrations are from their nearest
            others (mean over samples; means over demonstrations): 0 for copies, about 1 for behaviour that is as new as the
            demonstrations are to each other. Where what is observed is given, the demonstration whose it is does not count, as
            being like that may be right.
        spread: standard deviation over samples as a share of the demonstrations' own, unbiased, all columns and times together: 0
            where all samples are the same.
        roughness: second differences over time, relative to how much a plan varies, as a share of the demonstrations' (medians);
            less than :data:`SMOOTH` cannot be seen and counts as that. 1 for plans of fewer than three states.
    """

    novelty: float
    spread: float
    roughness: float

    @classmethod
    def of(cls, samples: Tensor, demonstrations: Tensor, observed: Tensor | None = None) -> Self:
        """Compare them.

        Args:
            samples: ``(sample, horizon, state)``, columns on comparable scales, such as a model's normalised ones.
            demonstrations: ``(demo, horizon, state)``, two or more.
            observed: the demonstration of which each sample sees what is observed ``(sample,)`` int64; ``None`` for none.

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
        """In plain words, such as ``'collapsed (spread 0.31)'``; what is fine is told as a number alone."""
        told = [
            f"spread {self.spread:.2f}{_remark(self.spread, COLLAPSED, 'collapsed', SCATTERED, 'scattered')}",
            f"novelty {self.novelty:.2f}{_remark(self.novelty, COPIES, 'copies')}",
            f"roughness {self.roughness:.2f}{_remark(self.roughness, 0, '', ROUGH, 'rougher than your demonstrations')}",
        ]
        return ", ".join(told)

    @property
    def numbers(self) -> Mapping[str, float]:
        """By name."""
        return asdict(self)


def roughness(plans: Tensor) -> Tensor:
    """Median over plans ``(plan, horizon, state)`` of root mean square second differences over time by that of the plan's
    deviation from its mean; plans that do not vary do not count.
    """
    size = (plans - plans.mean(dim=1, keepdim=True)).square().mean(dim=(1, 2)).sqrt()
    second = plans.diff(n=2, dim=1).square().mean(dim=(1, 2)).sqrt()
    moving = size > _LEAST
    return (second[moving] / size[moving]).median() if moving.any() else size.new_zeros(())


def _roughness_share(samples: Tensor, demonstrations: Tensor) -> float:
    one, other = (roughness(plans).clamp(min=SMOOTH) for plans in (samples, demonstrations))
    return float(one / other)


def _share(value: Tensor, whole: Tensor) -> float:
    """1 where both are nothing."""
    return float(value / whole) if whole > _LEAST else 1.0 if value <= _LEAST else float(value / _LEAST)


def _remark(value: float, least: float, below: str, most: float = torch.inf, above: str = "") -> str:
    return f" ({below})" if value < least else f" ({above})" if value > most else ""


def measured(model: ConceptModel, demonstrations: Demonstrations, concepts: Mapping[str, Concept], seed: int) -> dict[str, Quality]:
    """The quality of some concepts by name, in what the model's network sees, which compares columns of any unit.

    Args:
        model: that generates them.
        demonstrations: two or more, which samples are compared with and from whose initial states they start.
        concepts: by name.
        seed: of the samples.
    """
    known = _encoded(model, *first_windows(demonstrations, model.config.horizon))
    plans, starts = generated(model, demonstrations, concepts, seed)
    return {name: Quality.of(_encoded(model, own, starts), known, _observed(demonstrations)) for name, own in plans.items()}


def generated(
    model: ConceptModel, demonstrations: Demonstrations, concepts: Mapping[str, Concept], seed: int
) -> tuple[dict[str, Tensor], InitialStates]:
    """Samples of some concepts ``(GENERATED, horizon, state)`` by name, and where each starts; arguments as of :func:`measured`."""
    names = list(concepts)
    starts = demonstrations.initial_states.take(_turns(demonstrations))
    seen = {key: value.repeat(len(names), *(1,) * (value.dim() - 1)) for key, value in starts.observed.items()}
    draws = [generator("cpu", seed, 4, task_key(name)) for name in names]
    sampling = replace(SAMPLING, steps=min(SAMPLING.steps, model.max_steps or SAMPLING.steps))
    together = [concepts[name].composition.to(model.device) for name in names]
    plans = model.sample(together, GENERATED, sampling, draws, moved(seen, model.device)).cpu()
    return dict(zip(names, plans, strict=True)), starts


def _turns(demonstrations: Demonstrations) -> Tensor:
    """The demonstration that each sample starts like ``(GENERATED,)``."""
    return torch.arange(GENERATED) % len(demonstrations)


def _observed(demonstrations: Demonstrations) -> Tensor | None:
    """The same where anything is observed."""
    return _turns(demonstrations) if demonstrations.observed else None


def first_windows(demonstrations: Demonstrations, horizon: int) -> tuple[Tensor, InitialStates]:
    """The first states of demonstrations ``(demo, horizon, state)``, and where they start."""
    rows = torch.arange(len(demonstrations))
    return demonstrations.windows(rows, torch.zeros_like(rows), horizon)[0], demonstrations.initial_states


def _encoded(model: ConceptModel, plans: Tensor, starts: InitialStates) -> Tensor:
    return model.encode(plans.to(model.device), moved(starts.observed, model.device)).cpu()


@dataclass(frozen=True)
class Inspection:
    """Samples of a learned concept beside its demonstrations.

    Attributes:
        quality: what they are like.
        right: name and value of the domain's first metric that tells how many are right; ``None`` where none can.
        demonstrations: ``(demo, horizon, state)``, in the domain's units.
        samples: ``(GENERATED, horizon, state)``.
        starts: where each sample starts.
        domain: whose pictures they are drawn with.
        name: of the concept.
    """

    quality: Quality
    right: tuple[str, float] | None
    demonstrations: Tensor
    samples: Tensor
    starts: InitialStates
    domain: Domain
    name: str

    def __str__(self) -> str:
        told = "" if self.right is None else f"{self.right[0]} {self.right[1]:.2f}, "
        return f"{told}{self.quality.words} ({len(self.samples)} samples)"

    @property
    def record(self) -> QualityRecord:
        """What a concept's file keeps of it."""
        metric, right = ("", None) if self.right is None else self.right
        return QualityRecord(len(self.samples), **self.quality.numbers, metric=metric, right=right)

    def figure(self) -> "Figure":
        """Demonstrations above some of the samples."""
        shown = slice(0, SHOWN)
        observed = bool(self.domain.observed)
        known = self.starts.take(slice(0, len(self.demonstrations))) if observed else None  # samples start like these, in turn
        demonstrations = Drawn("demonstrations", self.demonstrations, known)
        samples = Drawn("samples", self.samples[shown], self.starts.take(shown) if observed else None)
        return beside(self.domain.show, demonstrations, samples, f"{self.name}: {self}")


def inspected(model: ConceptModel, domain: Domain, demonstrations: Demonstrations, concept: Concept, seed: int) -> Inspection:
    """Look at samples of a learned concept.

    Args:
        model: that generates them.
        domain: whose first metric that says so tells how many are right, where it can judge by the concept's name.
        demonstrations: two or more, that it was learned from.
        concept: the learned one.
        seed: of the samples.
    """
    name = concept.origin.name
    every, starts = generated(model, demonstrations, {name: concept}, seed)
    plans, (known, first) = every[name], first_windows(demonstrations, model.config.horizon)
    right = None
    if domain.metrics and domain.concepts.reads(name):
        measured = domain.measure(name, plans, starts if domain.observed else None)
        right = next(((key, float(own.float().mean())) for key, own in measured.items() if own.dtype == torch.bool), None)
    quality = Quality.of(_encoded(model, plans, starts), _encoded(model, known, first), _observed(demonstrations))
    return Inspection(quality, right, known, plans, starts, domain, name)
