"""Inversion: learning concepts from a few demonstrations by gradient descent through the frozen model (Eq. 2 of the paper)."""

import logging
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept, Origin
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import moved
from ftl_lightning.diffusion.prediction import LOSSES
from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel, TextConceptModel
from ftl_lightning.seeding import generator

_LOG = logging.getLogger(__name__)

FINAL_SAMPLES = 128
"""Noised demonstrations on which a learned concept is judged, the same for all restarts."""


@dataclass(frozen=True, kw_only=True)
class InversionSettings:
    """How concepts are learned.

    Attributes:
        components: K.
        omega: fixed guidance weight of every component, or ``'learned'``.
        initial_omega: where learned weights start (the paper draws them from U(0, 1)).
        off_span: how freely embeddings leave the affine span of the training embeddings: 1 is the paper's free form, 0 keeps
            them in the span, between the two the part off the span is scaled, which slows its learning down.
        initial_spread: embeddings start at the mean of the training embeddings plus so much normal noise a column.
        restarts: independent starts of each concept; the one with the lowest loss on common noise is kept.
        learning_rate: of the embeddings (Adam, cosine decay to 0).
        weight_learning_rate: of the weights; with the embeddings' rate they collapse.
        samples: noised demonstrations a step and run, spread over demonstrations and timesteps.
        loss: whose squared error is minimised, ``'epsilon'`` (Eq. 2), ``'v'`` or ``'clean'``. The others weigh noisy timesteps,
            at which the concept decides, by 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: timesteps are drawn as T (1 - u^power), u even in [0, 1). 1 spreads them evenly (the paper's); with 3 half
            of them fall in the noisiest eighth. There the concept alone tells what to do; at low noise the plan reveals the goal,
            so the empty concept already has a low loss: a local minimum.
        seed: decides starts, noise and timesteps.

    Raises:
        UserError: at construction, for a value that is none.
    """

    components: int = 2
    omega: float | Literal["learned"] = 1.2
    initial_omega: float = 1.0
    off_span: float = 1.0
    initial_spread: float = 0.05
    restarts: int = 1
    learning_rate: float = 0.1
    weight_learning_rate: float = 3e-3
    samples: int = 32
    loss: str = "epsilon"
    timestep_power: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("components", "restarts", "samples"):
            if (value := getattr(self, name)) < 1:
                raise UserError(f"model.{name}: expected 1 or more, found {value}")
        if not 0 <= self.off_span <= 1:
            raise UserError(f"model.off_span: expected 0 (span) to 1 (free), found {self.off_span}")
        if self.timestep_power < 1:
            raise UserError(f"model.timestep_power: expected 1 or more, found {self.timestep_power}")
        if self.loss not in LOSSES:
            raise UserError(f"model.loss: expected one of {', '.join(LOSSES)}, found {self.loss!r}")


class Inversion(nn.Module):
    """K embeddings and their weights for every concept of some demonstrations, all in one batch.

    Its only parameters are ``embeddings (run, K, n)`` and, unless omega is fixed, ``weights (run, K)``, where the runs are
    concepts times restarts. The model is frozen and no part of it.

    Args:
        model: that concepts are learned through.
        demonstrations: with concept texts, which name the concepts to learn.
        settings: how.

    Raises:
        UserError: for a model without text concepts that is to learn near their span.
    """

    basis: Tensor
    weights: Tensor

    def __init__(self, model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings) -> None:
        super().__init__()
        check_settings(model, settings)
        self._model = (model,)  # in a tuple, or it would be a part of this module
        self.demonstrations, self.settings = demonstrations, settings
        self.concepts = tuple(dict.fromkeys(demonstrations.concepts))
        training = model.training_embeddings
        # Rows span the training embeddings, whose mean is the origin of the concept space.
        basis = torch.linalg.svd(training, full_matrices=False).Vh[: max(len(training) - 1, 1)]
        self.register_buffer("basis", basis, persistent=False)
        # A generator for each concept, so that its start does not depend on what is learned beside it.
        shape = (settings.restarts, settings.components, model.config.concept_dim)
        draws = [generator("cpu", settings.seed, 0, zlib.crc32(name.encode())) for name in self.concepts]
        start = torch.cat([torch.randn(shape, generator=draw) for draw in draws])
        self.embeddings = nn.Parameter(settings.initial_spread * start)
        runs = (len(start), settings.components)
        if settings.omega == "learned":
            self.weights = nn.Parameter(torch.full(runs, float(settings.initial_omega)))
        else:
            self.register_buffer("weights", torch.full(runs, float(settings.omega)), persistent=False)

    @property
    def model(self) -> ConceptModel:
        """That concepts are learned through."""
        return self._model[0]

    def _rows(self, samples: int) -> Tensor:
        """Which demonstration each sample of each run uses, evenly: ``(run, samples)``."""
        texts = self.demonstrations.concepts
        rows = [[row for row, text in enumerate(texts) if text == concept] for concept in self.concepts]
        each = torch.tensor([[own[sample % len(own)] for sample in range(samples)] for own in rows])
        return each.repeat_interleave(self.settings.restarts, dim=0)

    @property
    def parametrised(self) -> Tensor:
        """The embeddings ``(run, K, n)`` after the part off the span is scaled."""
        if self.settings.off_span == 1:
            return self.embeddings
        inside = self.embeddings @ self.basis.T @ self.basis
        return inside + self.settings.off_span * (self.embeddings - inside)

    def losses(self, samples: int, draw: torch.Generator) -> Tensor:
        """The model's loss (ours is Eq. 2) for every run and sample, ``(run, samples)``. Runs share what is random in it and, as
        a share of a demonstration's length, the windows' starts.
        """
        model, device = self.model, self.embeddings.device
        runs, window = len(self.embeddings), model.window
        draws = model.draws(samples, self.settings.timestep_power, draw)
        rows = self._rows(samples).flatten()
        share = torch.rand(samples, generator=draw, device=device).cpu().repeat(runs)
        starts = self.demonstrations.starts(rows, share, model.domain.plans.exponent(window), window)
        states, observed = self.demonstrations.windows(rows, starts, window)
        states, seen = model.perturbed(states.to(device), moved(observed, device), draw)
        return model.losses(states, seen, Composition(self.parametrised, self.weights), draws, self.settings.loss)

    def step_losses(self, step: int) -> Tensor:
        """The losses of a training step ``(run, samples)``.

        Raises:
            UserError: if they are not finite.
        """
        losses = self.losses(self.settings.samples, generator(self.embeddings.device, self.settings.seed, 1, step))
        mean = losses.detach().mean()
        if not mean.isfinite():
            raise UserError(f"inversion: the loss became {mean.item()} at step {step}; lower model.learning_rate")
        return losses

    @property
    def rates(self) -> list[tuple[nn.Parameter, float]]:
        """Each parameter with its learning rate."""
        learned = isinstance(self.weights, nn.Parameter)
        weights = [(self.weights, self.settings.weight_learning_rate)] if learned else []
        return [(self.embeddings, self.settings.learning_rate), *weights]  # type: ignore[list-item]

    def optimizer(self, steps: int) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        """Adam, weights with a rate of their own, and its cosine decay over so many steps."""
        optimizer = torch.optim.Adam([{"params": [parameter], "lr": rate} for parameter, rate in self.rates])
        return optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """The concepts by name: of each, the restart with the lowest loss on common noise."""
        restarts = self.settings.restarts
        # Noise that is common to all runs and always the same.
        losses = self.losses(FINAL_SAMPLES, generator(self.embeddings.device, self.settings.seed, 2)).mean(dim=1)
        losses = losses.unflatten(0, (-1, restarts))
        best = losses.argmin(dim=1)
        embeddings = self.parametrised.detach().unflatten(0, (-1, restarts))
        weights = self.weights.detach().unflatten(0, (-1, restarts))
        kind = "learned" if self.settings.omega == "learned" else "fixed"
        return {
            name: Concept(
                embeddings[index, best[index]].cpu(),
                weights[index, best[index]].cpu(),
                origin(self.model, self.demonstrations, name, kind, losses[index, best[index]].item()),
            )
            for index, name in enumerate(self.concepts)
        }


def check_settings(model: ConceptModel, settings: InversionSettings) -> None:
    """Refuse settings that do not go with a model.

    Raises:
        UserError: naming the key.
    """
    if settings.off_span < 1 and not isinstance(model, TextConceptModel):
        raise UserError(
            f"model.off_span: expected 1 (free) for {model.name}, whose concepts are no texts, found {settings.off_span}"
        )
    pretrained = model.config.training.get("model", {}).get("loss", settings.loss)
    if pretrained != settings.loss:
        _LOG.warning("model.loss: the model was pretrained with %r; with %r concepts are learned worse", pretrained, settings.loss)


def origin(model: ConceptModel, demonstrations: Demonstrations, name: str, weights: str, loss: float) -> Origin:
    """Where a concept comes from.

    Args:
        model: it was learned through.
        demonstrations: among which are its own.
        name: the concept.
        weights: ``'fixed'`` or ``'learned'``.
        loss: at the end of learning.
    """
    own = demonstrations.select(name)
    return Origin(
        name=name,
        domain=model.config.domain,
        encoder=model.config.encoder,
        pretrained=model.hash,
        demonstrations=own.hash,
        count=len(own),
        weights=weights,
        loss=loss,
    )


def invert(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Callable[[float], None] = lambda loss: None,
) -> dict[str, Concept]:
    """Learn every concept of some demonstrations, without a trainer; the same numbers as with one.

    Args:
        model: frozen.
        demonstrations: with concept texts, which name the concepts.
        settings: how.
        steps: of gradient descent.
        tell: called with the mean loss after each step.
    """
    inversion = Inversion(model, demonstrations, settings).to(model.device)
    groups = [_Group(parameter, rate) for parameter, rate in inversion.rates]
    for step in range(steps):
        losses = inversion.step_losses(step)
        # A sum over runs: each run's gradient is what it would be if it were learned alone.
        gradients = torch.autograd.grad(losses.mean(dim=1).sum(), [group.parameter for group in groups])
        for group, gradient in zip(groups, gradients, strict=True):
            group.step(gradient, step, steps)
        tell(losses.detach().mean().item())
    return inversion.learned()


class _Group:
    """A parameter and its state of Adam with cosine decay, the same arithmetic as :meth:`Inversion.optimizer`'s.

    torch's optimiser classes import its compiler when they are used first, which takes longer than some concepts take to learn.
    """

    def __init__(self, parameter: nn.Parameter, rate: float) -> None:
        self.parameter, self.rate = parameter, rate
        self._mean, self._square = torch.zeros_like(parameter), torch.zeros_like(parameter)
        self._count = torch.zeros(())

    @torch.no_grad()
    def step(self, gradient: Tensor, step: int, steps: int) -> None:
        """Follow the gradient of a step; the rate for the next is the decay's recursion in torch's order of arithmetic."""
        adam(
            [self.parameter],
            [gradient],
            [self._mean],
            [self._square],
            [],
            [self._count],
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
        after, before = (1 + math.cos(math.pi * done / steps) for done in (step + 1, step))
        self.rate = after / before * self.rate
