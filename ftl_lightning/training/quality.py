"""Judgement of plans by a domain's metrics, and inspection of a learned concept: samples beside demonstrations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.places import first_windows
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.domains.pictures import Drawn, beside
from ftl_lightning.igm.concept import Concept, QualityRecord
from ftl_lightning.igm.forms.quality import Quality, encoded, generated, observed_from
from ftl_lightning.services.errors import note, require
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 16
"""Number of samples in a figure, and of demonstrations above samples."""


def right_plans(measured: Mapping[str, Tensor]) -> tuple[str, Tensor] | None:
    """Name and values ``(sample,)`` of the first boolean metric per plan, of metrics by name; ``None`` without such a metric."""
    return next(((name, values) for name, values in measured.items() if values.dtype == torch.bool and values.dim()), None)


def judging_domain(model: ConceptModel, examples: Sequence[Demonstrations]) -> Domain:
    """Domain that judges a model's samples: the model's; for user data, extended by demonstrations of learned concepts."""
    if model.examples is None:
        return model.domain
    config = model.config
    return own_domain(concatenate(examples), config.training_concepts, config.horizon, config.metrics)


def calibration_of(domain: Domain, goal: str, name: str | None = None) -> str:
    """How often a metric accepts real behaviour of a goal, or why it is not measured; empty for a rule.

    Args:
        name: the metric; ``None`` for the first that is calibrated.
    """
    for metric in domain.metrics.values() if name is None else (domain.metrics[name],):
        if metric.calibration is not None:
            return metric.calibration(goal)
    return ""


def judged(domain: Domain, plans: Demonstrations, goal: str) -> dict[str, float]:
    """Evaluate plans by the domain's metrics: success rates or means by name, over the plans to which a metric applies.

    Metrics without an applicable plan are omitted.

    Raises:
        UserError: for a goal that the domain cannot judge, or a domain without metrics.

    Warns:
        UserWarning: with the reason why a metric is not measured.
    """
    require(domain.metrics, "evaluate", "a domain that judges plans", f"{domain.name}; execute them")
    domain.check_goal(goal)
    measured = domain.measure(goal, plans.states, plans.initial_states)
    means = {}
    for name, values in measured.items():
        if not values.isnan().all():
            means[name] = float(values.double().nanmean())
        elif reason := calibration_of(domain, goal, name):
            note(reason)
    return means


def picture(domain: Domain, plans: Demonstrations, goal: str = "", demonstrations: Demonstrations | None = None) -> "Figure":
    """Draw plans, below ``demonstrations`` if given; with a goal, correct plans are framed green, wrong plans red.

    Raises:
        UserError: for a goal that the domain cannot judge.
    """
    starts, right = plans.initial_states, None
    if goal:
        domain.check_goal(goal)
        right = right_plans(domain.measure(goal, plans.states, starts))
    framed = None if right is None else right[1].tolist()
    title = goal or plans.concepts[0] or "samples"
    return drawn(domain, plans.states, starts if domain.observed else None, framed, title, demonstrations)


def drawn(
    domain: Domain,
    states: Tensor,
    starts: InitialStates | None,
    right: Sequence[bool] | None,
    title: str,
    demonstrations: Demonstrations | None,
) -> "Figure":
    """Draw samples ``(sample, horizon, state)`` with their initial states and verdicts, below the first demonstrations, if any."""
    if demonstrations is None:
        return domain.show.picture(states, right, title, starts)
    shown = slice(0, SHOWN)
    windows, first = first_windows(demonstrations, states.shape[1]), demonstrations.initial_states
    below = "samples" if right is None else f"samples: {sum(right)} right (green), {list(right).count(False)} wrong (red)"
    names = ", ".join(dict.fromkeys(filter(None, demonstrations.concepts)))
    above = Drawn(
        ": ".join(filter(None, ("demonstrations", names))), windows[shown], first.take(shown) if domain.observed else None
    )
    return beside(domain.show, above, Drawn(below, states, starts, right), title)


@dataclass(frozen=True)
class Inspection:
    """Samples of a learned concept with its demonstrations.

    Attributes:
        quality: quality of the samples.
        right: name and value of the domain's first success metric; ``None`` without such a metric.
        demonstrations: ``(demo, horizon, state)``, in the domain's units.
        samples: ``(GENERATED, horizon, state)``.
        starts: initial state of each sample.
        domain: domain that draws the pictures.
        name: name of the concept.
        skill: skill of the form beside references; empty if it was not measured.
        calibration: how often the metric accepts real behaviour, or why it is not shown; empty for a rule.
    """

    quality: Quality
    right: tuple[str, float] | None
    demonstrations: Tensor
    samples: Tensor
    starts: InitialStates
    domain: Domain
    name: str
    skill: str = ""
    calibration: str = ""

    def __str__(self) -> str:
        about = f" ({self.calibration})" if self.calibration else ""
        metric = "" if self.right is None else f"{self.right[0]} {self.right[1]:.2f}{about}, "
        skill = f"{self.skill}; " if self.skill else ""
        hidden = f"; {self.calibration}" if self.right is None and self.calibration else ""
        return f"{skill}{metric}{self.quality.words} ({len(self.samples)} samples){hidden}"

    @property
    def record(self) -> QualityRecord:
        """Record for a concept's file."""
        metric, right = ("", None) if self.right is None else self.right
        return QualityRecord(len(self.samples), **self.quality.numbers, metric=metric, right=right)

    def figure(self) -> "Figure":
        """Figure of demonstrations above samples."""
        shown = slice(0, SHOWN)
        observed = bool(self.domain.observed)
        starts = self.starts.take(slice(0, len(self.demonstrations))) if observed else None  # initial states of samples, in turn
        demonstrations = Drawn("demonstrations", self.demonstrations, starts)
        samples = Drawn("samples", self.samples[shown], self.starts.take(shown) if observed else None)
        return beside(self.domain.show, demonstrations, samples, f"{self.name}: {self}")


def inspected(model: ConceptModel, domain: Domain, demonstrations: Demonstrations, concept: Concept) -> Inspection | None:
    """Sample a learned concept, with the same noise for every seed of learning, and measure quality and success.

    Args:
        domain: domain whose first success metric judges samples, if it can read the concept's name.
        demonstrations: demonstrations of the concept.

    Returns:
        Inspection; ``None`` for a single demonstration, or a model whose plans are shorter than the domain's.
    """
    if len(demonstrations) < 2 or model.horizon != domain.plans.horizon:
        return None
    name = concept.origin.name
    samples, starts = generated(model, demonstrations, {name: concept}, seed=0)
    plans, known, first = samples[name], first_windows(demonstrations, model.config.horizon), demonstrations.initial_states
    right, calibration = None, ""
    if domain.concepts.reads(name):
        right = right_plans(domain.measure(name, plans, starts if domain.observed else None))
        calibration = calibration_of(domain, name, None if right is None else right[0])
    observed = observed_from(demonstrations)
    quality = Quality.of(encoded(model, plans, starts), encoded(model, known, first), observed)
    success = None if right is None else (right[0], float(right[1].float().mean()))
    skill = "" if concept.choice is None else concept.choice.words
    return Inspection(quality, success, known, plans, starts, domain, name, skill, calibration)
