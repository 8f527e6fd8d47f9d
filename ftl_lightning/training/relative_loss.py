"""Losses of demonstrations under concepts, relative to the unconditional (empty concept's) loss on the same noise."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import Observed, moved
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.concept_model import ConceptModel, Draws
from ftl_lightning.training.inversion_settings import InversionSettings

TOGETHER = 4096
"""Maximum number of noised demonstrations in a batch."""
GENERATED = Sampling("dpm_solver", 10)
"""Sampling of the behaviour in :func:`generated_loss`."""
COMPARED = 8
"""Maximum number of training concepts in :func:`generated_loss`."""


@dataclass(frozen=True)
class _Noised:
    """Windows of demonstrations, and noise shared by all demonstrations and concepts.

    Attributes:
        model, kind: model and kind of the loss.
        states, seen: windows ``(demo * sample, window, state)``, ordered by demonstration, and their observations.
        draws: timesteps and noise.
        demonstrations: number of demonstrations.
    """

    model: ConceptModel
    kind: str
    states: Tensor
    seen: Observed
    draws: Draws | None
    demonstrations: int

    @classmethod
    def of(cls, model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, samples: int) -> "_Noised":
        """Draw ``samples`` noised windows of each demonstration."""
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
        """Mean losses ``(concept, demo)`` on the CPU, of the windows or of ``states`` in their place."""
        runs = len(concepts.weights)
        repeated = {name: values.repeat(runs, *[1] * (values.dim() - 1)) for name, values in self.seen.items()}
        shown = self.states.repeat(runs, 1, 1) if states is None else states
        losses = self.model.losses(shown, repeated, concepts, self.draws, self.kind)
        return losses.unflatten(1, (self.demonstrations, -1)).mean(dim=2).cpu()

    def empty(self, concepts: Composition) -> Tensor:
        """Unconditional losses ``(1, demo)``; only the shape of ``concepts`` is used."""
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
    """Losses relative to the unconditional loss; below 1 if a concept explains a demonstration.

    Noise, timesteps and starts of windows are shared by all demonstrations and concepts.

    Args:
        model: model of the loss.
        demonstrations: demonstrations that fit the model.
        concepts: ``(concept, K, ...)``, on the model's device.
        settings: kind of loss, timesteps, and samples a step; each demonstration gets twice as many noised samples.
        tell: called with the number of concepts after each batch.

    Returns:
        ``(concept, demo)`` on the CPU.
    """
    noised = _Noised.of(model, demonstrations, settings, _samples(settings))
    empty = noised.empty(concepts)
    losses, size = [], max(1, TOGETHER // len(noised.states))
    for first in range(0, len(concepts.weights), size):
        chosen = slice(first, first + size)
        losses.append(noised.losses(Composition(concepts.embeddings[chosen], concepts.weights[chosen])))
        tell(len(losses[-1]))
    return torch.cat(losses) / empty


@torch.no_grad()
def generated_loss(model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings) -> float:
    """Loss of generated behaviour, in the units of :func:`relative_losses`: a lower bound of losses.

    Behaviour of training concepts is generated from the windows' initial states. A concept learned as well as in pretraining has
    about this loss.

    Args:
        model, demonstrations, settings: as in :func:`relative_losses`.

    Returns:
        Median over at most :data:`COMPARED` training concepts.
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
        plans = model.sample([alone], len(noised.states), GENERATED, draws, noised.seen)[0]
        means.append(noised.losses(concept, plans).mean())
    empty = noised.empty(Composition(embeddings[:1], ones))
    return float(torch.stack(means).median() / empty.mean())


def _samples(settings: InversionSettings) -> int:
    """Number of noised samples of each demonstration."""
    return max(2 * settings.budget.samples, 16)
