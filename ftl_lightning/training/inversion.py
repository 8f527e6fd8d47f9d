"""Inversion: gradient descent on concept embeddings through the frozen model (Eq. 2 of the paper)."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import moved
from ftl_lightning.igm.adapter import LowRank
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept, Origin
from ftl_lightning.igm.modes import Modes
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.training.adam import Group
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.inversion_settings import (
    ADAPTED,
    AUTO,
    CONCEPTS,
    EXPLAINED,
    MIXED,
    MODES,
    ONE,
    PAPER,
    REDUCED,
    InversionSettings,
)
from ftl_lightning.training.stopping import Stopping
from ftl_lightning.training.text_concept_model import TextConceptModel

_LOG = logging.getLogger(__name__)

FINAL_SAMPLES = 128
"""Number of noised demonstrations for the final loss, the same for all restarts."""
HELD_OUT = 32
"""Number of noised demonstrations for the stopping loss."""


Watch = Callable[[int, float, Callable[[], dict[str, Concept]]], None]
"""Callback after a step: the step's number from 1, its mean loss, and a function that returns the concepts so far by name."""


@dataclass(frozen=True)
class _Run:
    """One restart of one set of embeddings.

    Attributes:
        concept: index of the concept.
        rows: rows of its demonstrations.
        mode: number of the mode from 1; 0 for the set that is learned from all demonstrations of the concept.
    """

    concept: int
    rows: tuple[int, ...]
    mode: int


class Inversion(nn.Module):
    """K embeddings and guidance weights for every concept of the demonstrations, in one batch.

    Parameters: ``embeddings (run, K, knots, n)``; ``weights (run, K)`` unless omega is fixed; the adapter's factors for each
    concept and restart. A run is one restart of a concept or of a mode. Modes use their concept's adapter without changing it.
    The frozen model is not a submodule.

    Args:
        model: the frozen model.
        demonstrations: demonstrations; their concept texts name the concepts to learn.
        settings: settings of the inversion.

    Raises:
        UserError: if ``off_span`` is below 1 for a model without text concepts.
    """

    basis: Tensor
    weights: Tensor
    screened: Tensor | None
    _modes: Tensor

    def __init__(self, model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings) -> None:
        super().__init__()
        check_settings(model, settings)
        self._model = (model,)  # a tuple, so that it is not registered as a submodule
        self.demonstrations, self.settings = demonstrations, settings
        self.concepts = tuple(dict.fromkeys(demonstrations.concepts))
        training = model.training_embeddings
        # Rows span the training embeddings, whose mean is the origin of the concept space.
        basis = torch.linalg.svd(training, full_matrices=False).Vh[: max(len(training) - 1, 1)]
        self.register_buffer("basis", basis, persistent=False)
        self.runs = self._runs()
        self.register_buffer("_modes", torch.tensor([run.mode > 0 for run in self.runs]), persistent=False)
        # The runs that survive screening; a buffer, so that checkpoints keep them.
        self.register_buffer("screened", torch.ones(len(self.runs), dtype=torch.bool) if settings.budget.screening else None)
        # A generator for each concept: its start does not depend on the rest of the batch. Its modes share the start.
        shape = (settings.budget.restarts, settings.components, model.config.concept_dim)
        draws = [generator("cpu", settings.seed, 0, task_key(name)) for name in self.concepts]
        starts = [torch.randn(shape, generator=draw) for draw in draws]
        start = torch.cat([starts[run.concept] for run in self.runs[:: settings.budget.restarts]])[:, :, None]
        start = settings.embeddings.initial_spread * start.repeat(1, 1, settings.embeddings.knots, 1)
        if settings.embeddings.start == CONCEPTS:
            turn = torch.arange(len(start)) % settings.budget.restarts % len(training)
            start = start + training.cpu()[turn, None, None]
        self.embeddings = nn.Parameter(start)
        runs = (len(start), settings.components)
        if settings.omega == "learned":
            self.weights = nn.Parameter(torch.full(runs, float(settings.weights.initial)))
        else:
            self.register_buffer("weights", torch.full(runs, float(settings.omega)), persistent=False)
        # Adapter factors for each concept and restart: ``up (adapter, outputs, rank)``, initially 0, and ``down`` of each weight.
        self.factors = nn.ParameterList()
        sizes = model.adaptable() if settings.adapter.rank else {}
        self._names = list(sizes)
        adapted = [run for run in self.runs if not run.mode]
        for outputs, inputs in sizes.values():
            down = torch.stack([torch.randn(settings.adapter.rank, inputs, generator=draws[run.concept]) for run in adapted])
            self.factors.append(torch.zeros(len(adapted), outputs, settings.adapter.rank))
            self.factors.append(down / inputs**0.5)
        self.stopping: Stopping | None = None
        if settings.budget.tolerance is not None:
            self.stopping = Stopping(self.embeddings, self.weights, settings.budget.tolerance)

    def _runs(self) -> list[_Run]:
        """Runs by concept: first all its demonstrations, then its modes. Restarts of a run are adjacent."""
        texts, modes, runs = self.demonstrations.concepts, self.settings.modes.sets, []
        for concept, name in enumerate(self.concepts):
            rows = tuple(row for row, text in enumerate(texts) if text == name)
            count = min(modes, len(rows)) if isinstance(modes, int) else len(rows)
            parts = [rows, *((rows[mode::count] for mode in range(count)) if count > 1 else ())]
            runs += [_Run(concept, part, mode) for mode, part in enumerate(parts) for _ in range(self.settings.budget.restarts)]
        return runs

    @property
    def model(self) -> ConceptModel:
        """The frozen model."""
        return self._model[0]

    def parametrised(self, embeddings: Tensor) -> Tensor:
        """Scale the part of embeddings ``(run, K, knots, n)`` that is off the training span."""
        if self.settings.embeddings.off_span == 1:
            return embeddings
        inside = embeddings @ self.basis.T @ self.basis
        return inside + self.settings.embeddings.off_span * (embeddings - inside)

    def adapter(self, number: int) -> LowRank | None:
        """The adapter with this number, see :attr:`_adapter_of`; ``None`` without adapters."""
        factors = [factor[number] for factor in self.factors]
        if not factors:
            return None
        named = dict(zip(self._names, zip(factors[::2], factors[1::2], strict=True), strict=True))
        return LowRank(named, self.settings.adapter.scope == "all")

    def _adapter_of(self, run: int) -> int:
        """Number of a run's adapter, ordered by concept, then restart."""
        restarts = self.settings.budget.restarts
        return self.runs[run].concept * restarts + run % restarts

    def _losses(self, samples: int, draw: torch.Generator, embeddings: Tensor, weights: Tensor, chosen: Tensor | None) -> Tensor:
        """The model's loss (Eq. 2) of every sample ``(run, samples)``. Runs share noise, timesteps and the relative start of
        windows.

        Args:
            samples: noised demonstrations of each run, spread evenly over its demonstrations.
            draw: generator of noise, timesteps and windows.
            embeddings: embeddings of every run ``(run, K, knots, n)``.
            weights: weights of every run ``(run, K)``.
            chosen: bool mask of runs ``(run,)``; ``None`` for all.
        """
        runs = self.runs
        if chosen is not None:
            embeddings, weights = embeddings[chosen], weights[chosen]
            runs = [run for run, kept in zip(runs, chosen.tolist(), strict=True) if kept]
        model, device = self.model, self.embeddings.device
        window = model.window
        draws = model.draws(samples, self.settings.loss.timestep_power, draw)
        rows = torch.tensor([run.rows[sample % len(run.rows)] for run in runs for sample in range(samples)])
        share = torch.rand(samples, generator=draw, device=device).cpu().repeat(len(runs))
        plans = model.domain.plans
        starts = self.demonstrations.starts(rows, share, plans.exponent(window), window, plans.at_rest)
        states, observed = self.demonstrations.windows(rows, starts, window)
        states, seen = model.perturbed(states.to(device), moved(observed, device), draw)
        composition = Composition(self.parametrised(embeddings), weights)
        if self.factors:
            indices = range(len(self.runs)) if chosen is None else chosen.nonzero()[:, 0].tolist()
            numbers = [self._adapter_of(run) for run in indices]
            different = list(dict.fromkeys(numbers))
            adapters = [adapter for number in different if (adapter := self.adapter(number))]
            if all(self.runs[run].mode for run in indices):  # modes do not change the adapter
                adapters = [adapter.detached() for adapter in adapters]
            number = torch.tensor([1 + different.index(number) for number in numbers], device=device)[:, None]
            composition = replace(composition, adapters=tuple(adapters), adapter=number.expand_as(weights))
        return model.losses(states, seen, composition, draws, self.settings.loss.kind)

    def losses(self, samples: int, draw: torch.Generator, chosen: Tensor | None = None) -> Tensor:
        """:meth:`_losses` of the current parameters."""
        return self._losses(samples, draw, self.embeddings, self.weights, chosen)

    def step_losses(self, step: int) -> Tensor:
        """Mean losses of a training step ``(run,)``, over the active runs.

        Raises:
            UserError: if the mean is not finite.
        """
        if self.stopping is not None and step == 0:
            self.stopping.begin(self._held_out(self.embeddings, self.weights, None))
        losses = []
        for samples, mask in ((self.settings.budget.samples, ~self._modes), (self.settings.modes.samples, self._modes)):
            chosen = mask if self.stopping is None else mask & self.stopping.going
            chosen = chosen if self.screened is None else chosen & self.screened
            if chosen.any():
                # A new generator for the modes, so that they do not depend on whether other runs are active.
                draw = generator(self.embeddings.device, self.settings.seed, 1, step)
                with self._reduced():
                    losses.append(self.losses(samples, draw, None if chosen.all() else chosen).mean(dim=1))
        every = torch.cat(losses)
        mean = every.detach().mean()
        if not mean.isfinite():
            raise UserError(f"inversion: the loss became {mean.item()} at step {step}; lower model.budget.learning_rate")
        return every

    def _reduced(self) -> AbstractContextManager[None]:
        """Autocast to bfloat16 if the settings ask for it."""
        reduced = self.settings.budget.precision == REDUCED
        return torch.autocast(self.embeddings.device.type, torch.bfloat16) if reduced else nullcontext()

    def stepped(self, step: int) -> bool:
        """Record a completed step, numbered from 0.

        Returns:
            Whether any run is still active.
        """
        if self.screened is not None and step + 1 == self.settings.budget.screening:
            losses = self._held_out(self.embeddings, self.weights, None).unflatten(0, (-1, self.settings.budget.restarts))
            self.screened = functional.one_hot(losses.argmin(dim=1), losses.shape[1]).bool().flatten()
            if self.stopping is not None:
                self.stopping.going &= self.screened  # otherwise no run would be left to step once the others stop
        return self.stopping is None or self.stopping.stepped(step, self.embeddings, self.weights, self._held_out)

    @torch.no_grad()
    def _held_out(self, embeddings: Tensor, weights: Tensor, chosen: Tensor | None) -> Tensor:
        """Mean losses ``(run,)`` on held-out noise."""
        draw = generator(self.embeddings.device, self.settings.seed, 3)
        return self._losses(HELD_OUT, draw, embeddings, weights, chosen).mean(dim=1)

    @property
    def rates(self) -> list[tuple[nn.Parameter, float]]:
        """Each parameter with its learning rate."""
        learned = isinstance(self.weights, nn.Parameter)
        weights = [(self.weights, self.settings.weights.learning_rate)] if learned else []
        factors = [(factor, self.settings.adapter.learning_rate) for factor in self.factors]
        return [(self.embeddings, self.settings.budget.learning_rate), *weights, *factors]

    def optimizer(self, steps: int) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        """Adam with a learning rate for each parameter group, and cosine decay over ``steps``; no decay with early stopping."""
        optimizer = torch.optim.Adam([{"params": [parameter], "lr": rate} for parameter, rate in self.rates])
        if self.settings.budget.tolerance is not None:
            return optimizer, torch.optim.lr_scheduler.ConstantLR(optimizer, factor=1.0)
        return optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """Concepts by name, each from the restart with the lowest loss on common noise.

        Raises:
            UserError: if a concept is not finite.
        """
        restarts = self.settings.budget.restarts
        # Before the first round ends, there is no best one.
        source = self if self.stopping is None or not self.stopping.rounds else self.stopping
        raw, weights = source.embeddings.detach(), source.weights.detach()
        losses = self._final(raw, weights)
        if self.screened is not None:
            losses = losses.where(self.screened, torch.inf)
        best = torch.arange(0, len(losses), restarts, device=losses.device) + losses.unflatten(0, (-1, restarts)).argmin(dim=1)
        auto = self.settings.modes.sets == "auto"
        empty = self._final(raw, torch.zeros_like(weights)) if auto else losses
        embeddings = self.parametrised(raw)
        kind = "learned" if self.settings.omega == "learned" else "fixed"
        if kind == "learned":
            weights = weights * self.settings.weights.scale
        concepts, pretrained = {}, self.model.hash
        for index, name in enumerate(self.concepts):
            whole, *modes = [run for run in best.tolist() if self.runs[run].concept == index]
            mixed = auto and bool(explained(empty[whole], losses[whole], losses[modes].mean()) >= EXPLAINED)
            concepts[name] = Concept(
                embeddings[whole].cpu(),
                weights[whole].cpu(),
                origin(self.model, self.demonstrations, name, kind, losses[whole].item(), pretrained),
                Modes(embeddings[modes].cpu(), weights[modes].cpu(), mixed) if modes else None,
                adapter.copied() if (adapter := self.adapter(self._adapter_of(whole))) else None,
            )
            concepts[name].check_finite(f"inversion: concept {name!r}")
        return concepts

    def _final(self, embeddings: Tensor, weights: Tensor) -> Tensor:
        """Mean losses ``(run,)`` on fixed noise, common to all runs."""
        draw = generator(self.embeddings.device, self.settings.seed, 2)
        return self._losses(FINAL_SAMPLES, draw, embeddings, weights, None).mean(dim=1)


def explained(empty: Tensor, one: Tensor, modes: Tensor) -> Tensor:
    """Gain of one set over the unconditional (empty concept's) loss, as a share of the modes' gain."""
    return (empty - one) / (empty - modes)


def check_settings(model: ConceptModel, settings: InversionSettings) -> None:
    """Refuse settings that a model does not support.

    Raises:
        UserError: with the key.
    """
    if not model.invertible:
        raise UserError(f"model.pretrained: expected a model that concepts are learned through, found one of {model.method.name}")
    if settings.embeddings.off_span < 1 and not isinstance(model, TextConceptModel):
        share = settings.embeddings.off_span
        raise UserError(
            f"model.embeddings.off_span: expected 1 (free) for {model.method.name}, whose concepts are no texts, found {share}"
        )
    if (knots := settings.embeddings.knots) > 1 and not model.over_time:
        message = f"expected 1 for this model, whose concepts do not vary over a plan, found {knots}"
        raise UserError(f"model.embeddings.knots: {message}")
    if settings.form in (AUTO, ADAPTED, MIXED) and not model.adaptable():
        raise UserError(f"model.form: expected {PAPER}, {ONE} or {MODES} for {model.method.name}, found {settings.form}")
    if settings.adapter.rank and not model.adaptable():
        raise UserError(f"model.adapter.rank: expected 0 (none) for {model.method.name}, found {settings.adapter.rank}")


def warn_of_loss(model: ConceptModel, settings: InversionSettings) -> None:
    """Log a warning if the loss differs from that of pretraining."""
    pretrained = model.config.training.get("model", {}).get("loss", settings.loss.kind)
    if pretrained != settings.loss.kind:
        _LOG.warning(
            "model.loss.kind: the model was pretrained with %r; with %r concepts are learned worse", pretrained, settings.loss.kind
        )


def origin(
    model: ConceptModel, demonstrations: Demonstrations, name: str, weights: str, loss: float, pretrained: str = ""
) -> Origin:
    """Origin of a learned concept.

    Args:
        model: the pretrained model.
        demonstrations: demonstrations, including the concept's.
        name: name of the concept.
        weights: ``'fixed'`` or ``'learned'``.
        loss: final loss.
        pretrained: the model's hash, if known (hashing takes as long as several steps).
    """
    selected = demonstrations.select(name)
    return Origin(
        name=name,
        domain=model.config.domain,
        encoder=model.config.encoder,
        pretrained=pretrained or model.hash,
        demonstrations=selected.hash,
        count=len(selected),
        weights=weights,
        loss=loss,
    )


def invert(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Callable[[float], None] = lambda loss: None,
    watch: Watch | None = None,
) -> dict[str, Concept]:
    """Learn every concept of the demonstrations without a trainer; same numbers as with a trainer.

    Args:
        model: the frozen model.
        demonstrations: demonstrations; their concept texts name the concepts.
        settings: settings of the inversion.
        steps: gradient steps.
        tell: called with the mean loss after each step.
        watch: called after each step; reading the concepts so far changes nothing.
    """
    inversion = Inversion(model, demonstrations, settings).to(model.device)
    groups = [Group(parameter, rate) for parameter, rate in inversion.rates]
    for step in range(steps):
        losses = inversion.step_losses(step)
        # A sum over runs, so that runs do not affect each other's gradients.
        # Adapter factors of the encoder of observed features, which runs once a plan, may have no gradient.
        gradients = torch.autograd.grad(losses.sum(), [group.parameter for group in groups], materialize_grads=True)
        for group, gradient in zip(groups, gradients, strict=True):
            group.step(gradient, None if settings.budget.tolerance is not None else (step, steps))
        loss = losses.detach().mean().item()
        tell(loss)
        if watch is not None:
            watch(step + 1, loss, inversion.learned)
        if not inversion.stepped(step):
            break
    return inversion.learned()
