"""How well concepts explain demonstrations: the loss of each under each, relative to the empty concept's on the same noise."""

from collections.abc import Callable

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import moved
from ftl_lightning.learning.concept_model import ConceptModel, Draws
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.seeding import generator

TOGETHER = 4096
"""Noised demonstrations in a batch."""


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
    samples, count, device = max(2 * settings.budget.samples, 16), len(demonstrations), model.device
    draw = generator(device, settings.seed, 4)
    draws = model.draws(samples, settings.loss.timestep_power, draw)
    if draws is not None:
        draws = Draws(draws.t.repeat(count), draws.noise.repeat(count, 1, 1))
    share = torch.rand(samples, generator=draw, device=device).cpu().repeat(count)
    plans, rows = model.domain.plans, torch.arange(count).repeat_interleave(samples)
    starts = demonstrations.starts(rows, share, plans.exponent(model.window), model.window, plans.at_rest)
    states, observed = demonstrations.windows(rows, starts, model.window)
    states, seen = model.perturbed(states.to(device), moved(observed, device), draw)

    def measured(part: Composition) -> Tensor:
        runs = len(part.weights)
        repeated = {name: values.repeat(runs, *[1] * (values.dim() - 1)) for name, values in seen.items()}
        losses = model.losses(states.repeat(runs, 1, 1), repeated, part, draws, settings.loss.kind)
        return losses.unflatten(1, (count, samples)).mean(dim=2).cpu()

    empty = measured(Composition(concepts.embeddings[:1], torch.zeros_like(concepts.weights[:1])))
    found, size = [], max(1, TOGETHER // len(rows))
    for first in range(0, len(concepts.weights), size):
        chosen = slice(first, first + size)
        found.append(measured(Composition(concepts.embeddings[chosen], concepts.weights[chosen])))
        tell(len(found[-1]))
    return torch.cat(found) / empty.clamp(min=1e-12)
