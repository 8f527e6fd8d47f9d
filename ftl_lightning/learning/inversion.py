"""Inversion: learning concepts from a few demonstrations by gradient descent through the frozen model (Eq. 2 of the paper)."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.concepts.adapter import LowRank
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept, Origin
from ftl_lightning.concepts.modes import Modes
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import moved
from ftl_lightning.errors import UserError
from ftl_lightning.learning.adam import Group
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion_settings import (
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
from ftl_lightning.learning.stopping import Stopping
from ftl_lightning.learning.text_concept_model import TextConceptModel
from ftl_lightning.seeding import generator, task_key

_LOG = logging.getLogger(__name__)

FINAL_SAMPLES = 128
"""Noised demonstrations on which a learned concept is judged, the same for all restarts."""
HELD_OUT = 32
"""Noised demonstrations whose loss decides when a run stops."""


Watch = Callable[[int, float, Callable[[], dict[str, Concept]]], None]
"""Called after a step with its number from 1, its mean loss, and what gives the concepts so far by name."""


@dataclass(frozen=True)
class _Run:
    """Embeddings that are learned from some demonstrations.

    Attributes:
        concept: its place among the concepts.
        rows: of its demonstrations.
        mode: its number from 1; 0 for the embeddings that are learned from all demonstrations of the concept.
    """

    concept: int
    rows: tuple[int, ...]
    mode: int


class Inversion(nn.Module):
    """K embeddings and their weights for every concept of some demonstrations, all in one batch.

    Its only parameters are ``embeddings (run, K, knots, n)`` and, unless omega is fixed, ``weights (run, K)``; with an adapter,
    its factors for each concept and restart too. A run is a concept, or a mode of one, and a restart. Modes are learned through
    their concept's adapter and do not change it. The model is frozen and no part of it.

    Args:
        model: that concepts are learned through.
        demonstrations: with concept texts, which name the concepts to learn.
        settings: how.

    Raises:
        UserError: for a model without text concepts that is to learn near their span.
    """

    basis: Tensor
    weights: Tensor
    screened: Tensor | None
    _modes: Tensor

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
        self.runs = self._runs()
        self.register_buffer("_modes", torch.tensor([run.mode > 0 for run in self.runs]), persistent=False)
        # Those that go on after screening; kept in checkpoints, as nothing else tells.
        self.register_buffer("screened", torch.ones(len(self.runs), dtype=torch.bool) if settings.budget.screening else None)
        # A generator for each concept, so that its start does not depend on what is learned beside it. Its modes start alike.
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
        # Factors of an adapter of each concept and restart: of each weight ``up (adapter, outputs, rank)``, first 0, and ``down``.
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
        """Of each concept the run of all its demonstrations, then those of its modes; restarts of a run stand together."""
        texts, modes, found = self.demonstrations.concepts, self.settings.modes.sets, []
        for concept, name in enumerate(self.concepts):
            rows = tuple(row for row, text in enumerate(texts) if text == name)
            count = min(modes, len(rows)) if isinstance(modes, int) else len(rows)
            parts = [rows, *((rows[mode::count] for mode in range(count)) if count > 1 else ())]
            found += [_Run(concept, part, mode) for mode, part in enumerate(parts) for _ in range(self.settings.budget.restarts)]
        return found

    @property
    def model(self) -> ConceptModel:
        """That concepts are learned through."""
        return self._model[0]

    def parametrised(self, embeddings: Tensor) -> Tensor:
        """Embeddings ``(run, K, knots, n)`` after their part off the span is scaled."""
        if self.settings.embeddings.off_span == 1:
            return embeddings
        inside = embeddings @ self.basis.T @ self.basis
        return inside + self.settings.embeddings.off_span * (embeddings - inside)

    def adapter(self, number: int) -> LowRank | None:
        """An adapter by its number, see :attr:`_adapter_of`; ``None`` where there are none."""
        factors = [factor[number] for factor in self.factors]
        if not factors:
            return None
        named = dict(zip(self._names, zip(factors[::2], factors[1::2], strict=True), strict=True))
        return LowRank(named, self.settings.adapter.scope == "all")

    def _adapter_of(self, run: int) -> int:
        """The number of a run's adapter: concepts' one after another, those of a concept's restarts together."""
        restarts = self.settings.budget.restarts
        return self.runs[run].concept * restarts + run % restarts

    def _losses(self, samples: int, draw: torch.Generator, embeddings: Tensor, weights: Tensor, chosen: Tensor | None) -> Tensor:
        """The model's loss (ours is Eq. 2) for every sample ``(run, samples)``. Runs share what is random in it and, as a share of
        a demonstration's length, the windows' starts.

        Args:
            samples: noised demonstrations of each run, evenly spread over its own.
            draw: of noise, timesteps and windows.
            embeddings: of every run ``(run, K, knots, n)``.
            weights: of every run ``(run, K)``.
            chosen: which runs ``(run,)`` of bool; ``None`` for all.
        """
        runs = self.runs
        if chosen is not None:
            embeddings, weights = embeddings[chosen], weights[chosen]
            runs = [run for run, own in zip(runs, chosen.tolist(), strict=True) if own]
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
            own = range(len(self.runs)) if chosen is None else chosen.nonzero()[:, 0].tolist()
            numbers = [self._adapter_of(run) for run in own]
            different = list(dict.fromkeys(numbers))
            adapters = [adapter for number in different if (adapter := self.adapter(number))]
            if all(self.runs[run].mode for run in own):  # which learn through it and leave it as it is
                adapters = [adapter.detached() for adapter in adapters]
            number = torch.tensor([1 + different.index(number) for number in numbers], device=device)[:, None]
            composition = replace(composition, adapters=tuple(adapters), adapter=number.expand_as(weights))
        return model.losses(states, seen, composition, draws, self.settings.loss.kind)

    def losses(self, samples: int, draw: torch.Generator, chosen: Tensor | None = None) -> Tensor:
        """:meth:`_losses` of the embeddings and weights that are being learned."""
        return self._losses(samples, draw, self.embeddings, self.weights, chosen)

    def step_losses(self, step: int) -> Tensor:
        """The mean losses of a training step ``(run,)``, of the runs that have not stopped.

        Raises:
            UserError: if they are not finite.
        """
        if self.stopping is not None and step == 0:
            self.stopping.begin(self._held_out(self.embeddings, self.weights, None))
        found = []
        for samples, own in ((self.settings.budget.samples, ~self._modes), (self.settings.modes.samples, self._modes)):
            chosen = own if self.stopping is None else own & self.stopping.going
            chosen = chosen if self.screened is None else chosen & self.screened
            if chosen.any():
                # Anew for the modes, which would otherwise depend on whether any other run goes on.
                draw = generator(self.embeddings.device, self.settings.seed, 1, step)
                with self._reduced():
                    found.append(self.losses(samples, draw, None if chosen.all() else chosen).mean(dim=1))
        losses = torch.cat(found)
        mean = losses.detach().mean()
        if not mean.isfinite():
            raise UserError(f"inversion: the loss became {mean.item()} at step {step}; lower model.budget.learning_rate")
        return losses

    def _reduced(self) -> AbstractContextManager[None]:
        """Products in bfloat16, where the settings say so; a trainer may say so too."""
        reduced = self.settings.budget.precision == REDUCED
        return torch.autocast(self.embeddings.device.type, torch.bfloat16) if reduced else nullcontext()

    def stepped(self, step: int) -> bool:
        """Take note of a step that was made, by its number from 0.

        Returns:
            Whether any run goes on.
        """
        if self.screened is not None and step + 1 == self.settings.budget.screening:
            losses = self._held_out(self.embeddings, self.weights, None).unflatten(0, (-1, self.settings.budget.restarts))
            self.screened = functional.one_hot(losses.argmin(dim=1), losses.shape[1]).bool().flatten()
            if self.stopping is not None:
                self.stopping.going &= self.screened  # or nothing would be left to step once the others stop
        return self.stopping is None or self.stopping.stepped(step, self.embeddings, self.weights, self._held_out)

    @torch.no_grad()
    def _held_out(self, embeddings: Tensor, weights: Tensor, chosen: Tensor | None) -> Tensor:
        """Mean losses ``(run,)`` on noise that no step sees."""
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
        """Adam, weights with a rate of their own, and its cosine decay over so many steps, or no decay where runs are stopped."""
        optimizer = torch.optim.Adam([{"params": [parameter], "lr": rate} for parameter, rate in self.rates])
        if self.settings.budget.tolerance is not None:
            return optimizer, torch.optim.lr_scheduler.ConstantLR(optimizer, factor=1.0)
        return optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """The concepts by name: of each run, the restart with the lowest loss on common noise.

        Raises:
            UserError: for a concept that is not finite.
        """
        restarts = self.settings.budget.restarts
        # Where there were fewer steps than a round has, there is no best one yet.
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
        found, pretrained = {}, self.model.hash
        for index, name in enumerate(self.concepts):
            whole, *modes = [run for run in best.tolist() if self.runs[run].concept == index]
            mixed = auto and bool(explained(empty[whole], losses[whole], losses[modes].mean()) >= EXPLAINED)
            found[name] = Concept(
                embeddings[whole].cpu(),
                weights[whole].cpu(),
                origin(self.model, self.demonstrations, name, kind, losses[whole].item(), pretrained),
                Modes(embeddings[modes].cpu(), weights[modes].cpu(), mixed) if modes else None,
                adapter.copied() if (adapter := self.adapter(self._adapter_of(whole))) else None,
            )
            found[name].expect_finite(f"inversion: concept {name!r}")
        return found

    def _final(self, embeddings: Tensor, weights: Tensor) -> Tensor:
        """Mean losses ``(run,)`` on noise that is common to all runs and always the same."""
        draw = generator(self.embeddings.device, self.settings.seed, 2)
        return self._losses(FINAL_SAMPLES, draw, embeddings, weights, None).mean(dim=1)


def explained(empty: Tensor, one: Tensor, modes: Tensor) -> Tensor:
    """The share of what several modes lower the empty concept's loss by that one set of embeddings lowers it by."""
    return (empty - one) / (empty - modes)


def check_settings(model: ConceptModel, settings: InversionSettings) -> None:
    """Refuse settings that do not go with a model.

    Raises:
        UserError: naming the key.
    """
    if not model.invertible:
        raise UserError(f"model.pretrained: expected a model that concepts are learned through, found one of {model.method.name}")
    if settings.embeddings.off_span < 1 and not isinstance(model, TextConceptModel):
        found = settings.embeddings.off_span
        raise UserError(
            f"model.embeddings.off_span: expected 1 (free) for {model.method.name}, whose concepts are no texts, found {found}"
        )
    if (knots := settings.embeddings.knots) > 1 and not model.over_time:
        told = f"expected 1 for this model, whose concepts do not vary over a plan, found {knots}"
        raise UserError(f"model.embeddings.knots: {told}")
    if settings.form in (AUTO, ADAPTED, MIXED) and not model.adaptable():
        raise UserError(f"model.form: expected {PAPER}, {ONE} or {MODES} for {model.method.name}, found {settings.form}")
    if settings.adapter.rank and not model.adaptable():
        raise UserError(f"model.adapter.rank: expected 0 (none) for {model.method.name}, found {settings.adapter.rank}")


def warn_of_loss(model: ConceptModel, settings: InversionSettings) -> None:
    """Say where concepts are to be learned by another loss than the model was."""
    pretrained = model.config.training.get("model", {}).get("loss", settings.loss.kind)
    if pretrained != settings.loss.kind:
        _LOG.warning(
            "model.loss.kind: the model was pretrained with %r; with %r concepts are learned worse", pretrained, settings.loss.kind
        )


def origin(
    model: ConceptModel, demonstrations: Demonstrations, name: str, weights: str, loss: float, pretrained: str = ""
) -> Origin:
    """Where a concept comes from.

    Args:
        model: it was learned through.
        demonstrations: among which are its own.
        name: the concept.
        weights: ``'fixed'`` or ``'learned'``.
        loss: at the end of learning.
        pretrained: the model's hash, of which a concept more takes as long as several steps; empty where it is not known.
    """
    own = demonstrations.select(name)
    return Origin(
        name=name,
        domain=model.config.domain,
        encoder=model.config.encoder,
        pretrained=pretrained or model.hash,
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
    watch: Watch | None = None,
) -> dict[str, Concept]:
    """Learn every concept of some demonstrations, without a trainer; the same numbers as with one.

    Args:
        model: frozen.
        demonstrations: with concept texts, which name the concepts.
        settings: how.
        steps: of gradient descent.
        tell: called with the mean loss after each step.
        watch: called after each step too; it may look at the concepts so far, which changes nothing.
    """
    inversion = Inversion(model, demonstrations, settings).to(model.device)
    groups = [Group(parameter, rate) for parameter, rate in inversion.rates]
    for step in range(steps):
        losses = inversion.step_losses(step)
        # A sum over runs: each run's gradient is what it would be if it were learned alone.
        # An adapter also has factors of what reads observed features, which happens once a plan, outside of the branches.
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
