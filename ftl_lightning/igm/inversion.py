"""Inversion: gradient descent on concept embeddings and weights through the frozen model (Eq. 2 of the paper)."""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.adam import adam

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms.adapter import LowRank
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.igm.forms.stopping import Stopping
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.settings import CONCEPTS, EXPLAINED, REDUCED, InversionSettings
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.randomness import generator, task_key

FINAL_SAMPLES = 128
"""Number of noised demonstrations for the final loss, the same for all restarts."""
HELD_OUT = 32
"""Number of noised demonstrations for the stopping loss."""

Tell = Callable[[float], None]
"""Callback after a gradient step with its mean loss."""
Watch = Callable[[int, float, Callable[[], dict[str, Concept]]], None]
"""Callback after a gradient step: the step's number from 1, its mean loss, and a function that returns the concepts so far."""


@usual_modes()
def invert(
    model: Invertible,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Tell = lambda loss: None,
    watch: Watch | None = None,
    start: "Inversion | None" = None,
) -> dict[str, Concept]:
    """Learn the embeddings and weights of every concept of the demonstrations, in one batch.

    Args:
        demonstrations: demonstrations; their concept texts name the concepts.
        steps: maximum number of gradient steps.
        tell, watch: callbacks after each step; reading the concepts so far changes nothing.
        start: initial parameters, which are changed; ``None`` to create them.

    Returns:
        Concepts by name.

    Raises:
        UserError: if a loss is not finite, or the model does not support the settings.
    """
    inversion = Inversion(model, demonstrations, settings).to(model.device) if start is None else start
    optimizers = [Adam(parameter, rate) for parameter, rate in inversion.rates]
    decay = steps if settings.budget.tolerance is None else None
    for step in range(steps):
        losses = inversion.step_losses(step)
        # The sum over runs: runs do not affect each other's gradients. Adapter factors of the condition encoder, which is evaluated
        # once per plan, may have no gradient.
        parameters = [optimizer.parameter for optimizer in optimizers]
        gradients = torch.autograd.grad(losses.sum(), parameters, materialize_grads=True)
        for optimizer, gradient in zip(optimizers, gradients, strict=True):
            optimizer.step(gradient, step, decay)
        loss = losses.detach().mean().item()
        tell(loss)
        if watch is not None:
            watch(step + 1, loss, inversion.learned)
        if not inversion.stepped(step):
            break
    return inversion.learned()


class Run(NamedTuple):
    """A restart of one set of embeddings.

    Attributes:
        concept: index of the concept.
        rows: rows of its demonstrations.
        mode: number of the mode from 1; 0 for the set that is learned from all demonstrations of the concept.
    """

    concept: int
    rows: Sequence[int]
    mode: int


class Inversion(nn.Module):
    """Parameters of an inversion: K embeddings and guidance weights for every concept, in one batch.

    Parameters: ``embeddings (run, K, knots, n)``; ``weights (run, K)`` unless omega is fixed; the adapter's factors for each
    concept and restart. A run is a restart of a concept or of a mode. Modes use their concept's adapter without changing it.

    Args:
        model: the frozen model, which is not a submodule.
        demonstrations: demonstrations; their concept texts name the concepts to learn.
        settings: settings of the inversion.

    Raises:
        UserError: if the model does not support the settings.
    """

    basis: Tensor
    weights: Tensor
    is_mode: Tensor
    active: Tensor

    def __init__(self, model: Invertible, demonstrations: Demonstrations, settings: InversionSettings) -> None:
        super().__init__()
        model.check_settings(settings)
        self._model = (model,)  # a tuple, so that it is not registered as a submodule
        self.demonstrations, self.settings = demonstrations, settings
        self.concepts = tuple(dict.fromkeys(demonstrations.concepts))
        training, restarts = model.training_embeddings, settings.budget.restarts
        # Rows span the training embeddings, whose mean is the origin of the concept space.
        basis = torch.linalg.svd(training, full_matrices=False).Vh[: max(len(training) - 1, 1)]
        self.register_buffer("basis", basis, persistent=False)
        self.runs = self._runs()
        self.register_buffer("is_mode", torch.tensor([run.mode > 0 for run in self.runs]), persistent=False)
        self.register_buffer("active", torch.ones(len(self.runs), dtype=torch.bool), persistent=False)  # after screening
        # A generator for each concept: its start does not depend on the rest of the batch. Its modes share the start.
        draws = [generator("cpu", settings.seed, 0, task_key(name)) for name in self.concepts]
        shape = (restarts, settings.components, training.shape[1])
        starts = [torch.randn(shape, generator=draw) for draw in draws]
        start = torch.cat([starts[run.concept] for run in self.runs[::restarts]])[:, :, None]
        start = settings.embeddings.initial_spread * start.repeat(1, 1, settings.embeddings.knots, 1)
        if settings.embeddings.start == CONCEPTS:
            start = start + training.cpu()[torch.arange(len(start)) % restarts % len(training), None, None]
        self.embeddings = nn.Parameter(start)
        runs = (len(start), settings.components)
        if settings.omega == "learned":
            self.weights = nn.Parameter(torch.full(runs, float(settings.weights.initial)))
        else:
            self.register_buffer("weights", torch.full(runs, float(settings.omega)), persistent=False)
        # Adapter factors for each concept and restart: ``up (adapter, outputs, rank)``, initially 0, and ``down`` of each weight.
        self.factors, rank = nn.ParameterList(), settings.adapter.rank
        sizes = model.adaptable() if rank else {}
        self._names = list(sizes)
        adapted = [run for run in self.runs if not run.mode]
        for outputs, inputs in sizes.values():
            down = torch.stack([torch.randn(rank, inputs, generator=draws[run.concept]) for run in adapted])
            self.factors.append(torch.zeros(len(adapted), outputs, rank))
            self.factors.append(down / inputs**0.5)
        tolerance = settings.budget.tolerance
        self.stopping = None if tolerance is None else Stopping(self.embeddings, self.weights, tolerance)

    def _runs(self) -> list[Run]:
        """Runs by concept: first all its demonstrations, then its modes. Restarts of a run are adjacent."""
        texts, modes, runs = self.demonstrations.concepts, self.settings.modes.sets, []
        for concept, name in enumerate(self.concepts):
            rows = tuple(row for row, text in enumerate(texts) if text == name)
            count = min(modes, len(rows)) if isinstance(modes, int) else len(rows)
            parts = [rows, *((rows[mode::count] for mode in range(count)) if count > 1 else ())]
            runs += [Run(concept, part, mode) for mode, part in enumerate(parts) for _ in range(self.settings.budget.restarts)]
        return runs

    @property
    def model(self) -> Invertible:
        """The frozen model."""
        return self._model[0]

    @property
    def rates(self) -> list[tuple[nn.Parameter, float]]:
        """Each parameter with its learning rate."""
        learned = isinstance(self.weights, nn.Parameter)
        weights = [(self.weights, self.settings.weights.learning_rate)] if learned else []
        factors = [(factor, self.settings.adapter.learning_rate) for factor in self.factors]
        return [(self.embeddings, self.settings.budget.learning_rate), *weights, *factors]

    def parametrised(self, embeddings: Tensor) -> Tensor:
        """Scale the part of embeddings ``(run, K, knots, n)`` that is off the training span."""
        if self.settings.embeddings.off_span == 1:
            return embeddings
        inside = embeddings @ self.basis.T @ self.basis
        return inside + self.settings.embeddings.off_span * (embeddings - inside)

    def adapter(self, run: int) -> LowRank | None:
        """Adapter of a run, shared by the modes of its concept; ``None`` without adapters."""
        factors = [factor[self._adapter_of(run)] for factor in self.factors]
        if not factors:
            return None
        named = dict(zip(self._names, zip(factors[::2], factors[1::2], strict=True), strict=True))
        return LowRank(named, self.settings.adapter.scope == "all")

    def _adapter_of(self, run: int) -> int:
        """Number of a run's adapter, ordered by concept, then restart."""
        restarts = self.settings.budget.restarts
        return self.runs[run].concept * restarts + run % restarts

    def _composition(self, embeddings: Tensor, weights: Tensor, runs: Sequence[int]) -> Composition:
        """Composition of runs with their adapters. Modes do not change the adapter of their concept."""
        composition = Composition(self.parametrised(embeddings), weights)
        if not self.factors:
            return composition
        first = {self._adapter_of(run): run for run in reversed(runs)}
        different = list(dict.fromkeys(self._adapter_of(run) for run in runs))
        adapters = [adapter for number in different if (adapter := self.adapter(first[number]))]
        if all(self.runs[run].mode for run in runs):
            adapters = [adapter.detached() for adapter in adapters]
        number = torch.tensor([1 + different.index(self._adapter_of(run)) for run in runs], device=weights.device)[:, None]
        return replace(composition, adapters=tuple(adapters), adapter=number.expand_as(weights))

    def losses(
        self,
        samples: int,
        draw: torch.Generator,
        chosen: Tensor | None = None,
        embeddings: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Loss of Eq. 2 of every sample ``(run, samples)``. Runs share noise, timesteps and the relative start of windows.

        Args:
            samples: noised demonstrations of each run, spread evenly over its demonstrations.
            draw: generator of noise, timesteps and windows.
            chosen: bool mask of runs ``(run,)``; ``None`` for all.
            embeddings, weights: of every run ``(run, K, knots, n)``, ``(run, K)``; ``None`` for the parameters.
        """
        embeddings, weights = self.embeddings if embeddings is None else embeddings, self.weights if weights is None else weights
        runs: Sequence[int] = range(len(self.runs))
        if chosen is not None:
            embeddings, weights, runs = embeddings[chosen], weights[chosen], chosen.nonzero()[:, 0].tolist()
        draws = self.model.draws(samples, self.settings.loss.timestep_power, draw)
        demonstrated = [self.runs[run].rows for run in runs]
        rows = torch.tensor([rows[sample % len(rows)] for rows in demonstrated for sample in range(samples)])
        share = torch.rand(samples, generator=draw, device=embeddings.device).cpu().repeat(len(runs))
        states, observed = self.model.windows(self.demonstrations, rows, share, draw)
        composition = self._composition(embeddings, weights, runs)
        return self.model.losses(states, observed, composition, draws, self.settings.loss.kind)

    def step_losses(self, step: int) -> Tensor:
        """Mean losses of gradient step ``step`` ``(run,)``, over the active runs; ``UserError`` if the mean is not finite."""
        if self.stopping is not None and step == 0:
            self.stopping.begin(self._held_out(self.embeddings, self.weights, None))
        losses = []
        for samples, mask in ((self.settings.budget.samples, ~self.is_mode), (self.settings.modes.samples, self.is_mode)):
            chosen = mask & self.active if self.stopping is None else mask & self.active & self.stopping.going
            if chosen.any():
                # A new generator for the modes, so that they do not depend on whether other runs are active.
                draw = generator(self.embeddings.device, self.settings.seed, 1, step)
                with self._precision():
                    losses.append(self.losses(samples, draw, None if chosen.all() else chosen).mean(dim=1))
        every = torch.cat(losses)
        mean = every.detach().mean()
        if not mean.isfinite():
            raise UserError(f"inversion: the loss became {mean.item()} at step {step}; lower model.budget.learning_rate")
        return every

    def _precision(self) -> AbstractContextManager[None]:
        """Autocast to bfloat16 if the settings ask for it."""
        reduced = self.settings.budget.precision == REDUCED
        return torch.autocast(self.embeddings.device.type, torch.bfloat16) if reduced else nullcontext()

    def stepped(self, step: int) -> bool:
        """Screen restarts and stop runs after gradient step ``step``, numbered from 0.

        Returns:
            Whether any run is still active.
        """
        if step + 1 == self.settings.budget.screening:
            losses = self._held_out(self.embeddings, self.weights, None).unflatten(0, (-1, self.settings.budget.restarts))
            self.active = functional.one_hot(losses.argmin(dim=1), losses.shape[1]).bool().flatten()
            if self.stopping is not None:
                self.stopping.going &= self.active  # otherwise no run would be left to step once the others stop
        return self.stopping is None or self.stopping.stepped(step, self.embeddings, self.weights, self._held_out)

    @torch.no_grad()
    def _held_out(self, embeddings: Tensor, weights: Tensor, chosen: Tensor | None) -> Tensor:
        """Mean losses ``(run,)`` on held-out noise."""
        draw = generator(self.embeddings.device, self.settings.seed, 3)
        return self.losses(HELD_OUT, draw, chosen, embeddings, weights).mean(dim=1)

    def _final(self, embeddings: Tensor, weights: Tensor) -> Tensor:
        """Mean losses ``(run,)`` on fixed noise, common to all runs."""
        draw = generator(self.embeddings.device, self.settings.seed, 2)
        return self.losses(FINAL_SAMPLES, draw, None, embeddings, weights).mean(dim=1)

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """Concepts by name, each from the restart with the lowest loss on common noise.

        Raises:
            UserError: if a concept is not finite.
        """
        # Before the first round of the stopping rule ends, there is no best round.
        source = self if self.stopping is None or not self.stopping.rounds else self.stopping
        raw, weights, restarts = source.embeddings.detach(), source.weights.detach(), self.settings.budget.restarts
        losses = self._final(raw, weights).where(self.active, torch.inf)
        best = torch.arange(0, len(losses), restarts, device=losses.device) + losses.unflatten(0, (-1, restarts)).argmin(dim=1)
        auto = self.settings.modes.sets == "auto"
        empty = self._final(raw, torch.zeros_like(weights)) if auto else losses
        embeddings, kind = self.parametrised(raw), "learned" if self.settings.omega == "learned" else "fixed"
        if kind == "learned":
            weights = weights * self.settings.weights.scale
        concepts, pretrained = {}, self.model.hash
        for index, name in enumerate(self.concepts):
            whole, *modes = [run for run in best.tolist() if self.runs[run].concept == index]
            mixed = auto and bool(explained(empty[whole], losses[whole], losses[modes].mean()) >= EXPLAINED)
            concepts[name] = Concept(
                embeddings[whole].cpu(),
                weights[whole].cpu(),
                self.model.origin(self.demonstrations, name, kind, losses[whole].item(), pretrained),
                Modes(embeddings[modes].cpu(), weights[modes].cpu(), mixed) if modes else None,
                adapter.copied() if (adapter := self.adapter(whole)) else None,
            )
            concepts[name].check_finite(f"inversion: concept {name!r}")
        return concepts


def explained(empty: Tensor, one: Tensor, modes: Tensor) -> Tensor:
    """Gain of one set over the unconditional (empty concept's) loss, as a share of the modes' gain."""
    return (empty - one) / (empty - modes)


class Adam:
    """Adam (Kingma & Ba, 2015) for one parameter, with cosine decay, in the arithmetic of torch's optimiser.

    torch's optimiser classes import torch's compiler on first use, which may take longer than learning a concept.
    """

    def __init__(self, parameter: nn.Parameter, rate: float) -> None:
        self.parameter, self.rate = parameter, rate
        self._mean, self._square, self._count = torch.zeros_like(parameter), torch.zeros_like(parameter), torch.zeros(())

    @torch.no_grad()
    def step(self, gradient: Tensor, step: int, decay: int | None) -> None:
        """Make gradient step ``step``, from 0; the rate decays to 0 over ``decay`` steps, ``None`` for a constant rate."""
        self.parameter.grad = gradient
        rates = {"lr": self.rate, "beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0}
        state: list[list[Tensor]] = [[self._mean], [self._square], [], [self._count]]
        adam([self.parameter], [gradient], *state, amsgrad=False, maximize=False, **rates)  # type: ignore[arg-type]
        if decay is not None:  # the recursion of torch's scheduler, in its order of arithmetic
            after, before = (1 + math.cos(math.pi * done / decay) for done in (step + 1, step))
            self.rate = after / before * self.rate
