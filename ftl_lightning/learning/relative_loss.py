"""How well concepts explain demonstrations: the loss of each under each, relative to the empty concept's on the same noise."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import Observed, moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.learning.concept_model import ConceptModel, Draws
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.seeding import generator

TOGETHER = 4096
"""Noised demonstrations in a batch."""
GENERATED = Sampling("dpm_solver", 10)
"""How behaviour is generated that demonstrations are compared with."""
COMPARED = 8
"""Training concepts at most whose behaviour that is."""


@dataclass(frozen=True)
class _Noised:
    """Windows of demonstrations, and noise: alike for every demonstration and concept.

    Attributes:
        model, kind: whose loss it is, and of what.
        states, seen: of windows ``(demo * sample, window, state)``, demonstration after demonstration.
        draws: timesteps and noise.
        demonstrations: how many there are.
    """

    model: ConceptModel
    kind: str
    states: Tensor
    seen: Observed
    draws: Draws | None
    demonstrations: int

    @classmethod
    def of(cls, model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, samples: int) -> "_Noised":
        """So many noised windows of each demonstration."""
        count, device = len(demonstrations), model.device
        draw = generator(device, settings.seed, 4)
        draws = model.draws(samples, settings.loss.timestep_power, draw)
        if draws is not None:
            draws = Draws(draws.t.repeat(count), draws.noise.repeat(count, 1, 1))
        share = torch.rand(samples, generator=draw, device=device).cpu().repeat(count)
        plans, rows = model.domain.plans, torch.arange(count).repeat_interleave(samples)
        starts = demonstrations.starts(rows, share, plans.exponent(model.window), model.window, plans.at_rest)
        states, observed = demonstrations.windows(rows, starts, model.window)
        states, seen = model.perturbed(states.to(device), moved(observed, device), draw)
        return cls(model, settings.loss.kind, states, seen, draws, count)

    def losses(self, concepts: Composition, states: Tensor | None = None) -> Tensor:
        """``(concept, demo)`` on the processor, of each demonstration's windows or of other states in their place."""
        runs = len(concepts.weights)
        repeated = {name: values.repeat(runs, *[1] * (values.dim() - 1)) for name, values in self.seen.items()}
        shown = self.states.repeat(runs, 1, 1) if states is None else states
        losses = self.model.losses(shown, repeated, concepts, self.draws, self.kind)
        return losses.unflatten(1, (self.demonstrations, -1)).mean(dim=2).cpu()

    def empty(self, concepts: Composition) -> Tensor:
        """Losses of the empty concept ``(1, demo)``; of concepts the shape counts."""
        nothing = Composition(concepts.embeddings[:1], torch.zeros_like(concepts.weights[:1]))
        return self.losses(nothing).clamp(min=1e-12)


@torch.no_grad()
def relative_losses(
    model: ConceptModel,
    demonstrations: Demonstrations,
    concepts: Composition,
    settings: InversionSettings,
    tell: Callable[[int], None] = lambda count: None,
) -> Tensor:
    """Losses by the empty concept's: less than 1 where a concept explains a demonstration better than nothing does.

    Noise, timesteps and starts of windows are the same for all demonstrations and concepts.

    Args:
        model: whose loss it is.
        demonstrations: that fit the model.
        concepts: ``(concept, K, ...)``, on the model's device.
        settings: kind of loss and timesteps, and the number of noised samples of each demonstration: twice the samples of a step.
        tell: called with the number of concepts after each batch.

    Returns:
        ``(concept, demo)`` on the processor.
    """
    noised = _Noised.of(model, demonstrations, settings, _samples(settings))
    empty = noised.empty(concepts)
    found, size = [], max(1, TOGETHER // len(noised.states))
    for first in range(0, len(concepts.weights), size):
        chosen = slice(first, first + size)
        found.append(noised.losses(Composition(concepts.embeddings[chosen], concepts.weights[chosen])))
        tell(len(found[-1]))
    return torch.cat(found) / empty


@torch.no_grad()
def generated_loss(model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings) -> float:
    """The loss of what a model generates itself, in the units of :func:`relative_losses`: how low a loss can be.

    Behaviour of training concepts is generated from where the demonstrations' windows start. A concept that is learned as well
    as those that were pretrained explains demonstrations about as well as they explain that.

    Args:
        model, demonstrations, settings: as of :func:`relative_losses`.

    Returns:
        the median over training concepts, :data:`COMPARED` at most.
    """
    embeddings = model.training_embeddings[:, None, None]
    chosen = torch.linspace(0, len(embeddings) - 1, min(COMPARED, len(embeddings))).round().long()
    ones = torch.ones(1, 1, device=model.device)
    noised = _Noised.of(model, demonstrations, settings, _samples(settings))
    means = []
    for number in chosen.tolist():
        concept = Composition(embeddings[number : number + 1], ones)
        alone = Composition(concept.embeddings[0], concept.weights[0])
        draws = [generator(model.device, settings.seed, 5, number)]
        own = model.sample([alone], len(noised.states), GENERATED, draws, noised.seen)[0]
        means.append(noised.losses(concept, own).mean())
    empty = noised.empty(Composition(embeddings[:1], ones))
    return float(torch.stack(means).median() / empty.mean())


def _samples(settings: InversionSettings) -> int:
    """Noised samples of each demonstration."""
    return max(2 * settings.budget.samples, 16)
