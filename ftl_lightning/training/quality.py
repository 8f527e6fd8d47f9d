"""Inspection of a learned concept: samples beside demonstrations."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.pictures import Drawn, beside
from ftl_lightning.igm.concept import Concept, QualityRecord
from ftl_lightning.igm.forms.quality import Quality, encoded, first_windows, generated, observed_from
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 16
"""Number of samples in a figure."""


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
    """

    quality: Quality
    right: tuple[str, float] | None
    demonstrations: Tensor
    samples: Tensor
    starts: InitialStates
    domain: Domain
    name: str

    def __str__(self) -> str:
        metric = "" if self.right is None else f"{self.right[0]} {self.right[1]:.2f}, "
        return f"{metric}{self.quality.words} ({len(self.samples)} samples)"

    @property
    def record(self) -> QualityRecord:
        """Record for a concept's file."""
        metric, right = ("", None) if self.right is None else self.right
        return QualityRecord(len(self.samples), **self.quality.numbers, metric=metric, right=right)

    def figure(self) -> "Figure":
        """Figure of demonstrations above samples."""
        shown = slice(0, SHOWN)
        observed = bool(self.domain.observed)
        known = self.starts.take(slice(0, len(self.demonstrations))) if observed else None  # initial states of samples, in turn
        demonstrations = Drawn("demonstrations", self.demonstrations, known)
        samples = Drawn("samples", self.samples[shown], self.starts.take(shown) if observed else None)
        return beside(self.domain.show, demonstrations, samples, f"{self.name}: {self}")


def inspected(model: ConceptModel, domain: Domain, demonstrations: Demonstrations, concept: Concept, seed: int) -> Inspection:
    """Inspect samples of a learned concept.

    Args:
        model: generative model.
        domain: domain whose first success metric judges samples, if it can read the concept's name.
        demonstrations: two or more demonstrations of the concept.
        concept: learned concept.
        seed: seed of the samples.
    """
    name = concept.origin.name
    every, starts = generated(model, demonstrations, {name: concept}, seed)
    plans, (known, first) = every[name], first_windows(demonstrations, model.config.horizon)
    right = None
    if domain.metrics and domain.concepts.reads(name):
        measured = domain.measure(name, plans, starts if domain.observed else None)
        right = next(((key, float(values.float().mean())) for key, values in measured.items() if values.dtype == torch.bool), None)
    quality = Quality.of(encoded(model, plans, starts), encoded(model, known, first), observed_from(demonstrations))
    return Inspection(quality, right, known, plans, starts, domain, name)
