"""Inversion: learning concepts from demonstrations by gradient descent through the frozen model (section 4.2 of the paper).

For each new concept, the embeddings ``c_1 .. c_K`` and the guidance weights ``w_1 .. w_K`` minimise Eq. 2 of the paper,

    ``E_{tau, t, eps} |eps - (eps_theta(x_t, empty) + sum_k w_k (eps_theta(x_t, c_k) - eps_theta(x_t, empty)))|^2``,

where tau is a window of a demonstration and ``x_t`` is tau with noise eps of timestep t. A *run* learns one set of K embeddings
from one initial value. A concept has a run on all its demonstrations and, if the settings ask for modes, a run on a part of them
for each *mode*. *Restarts* repeat each of these runs with other initial values. All runs of all concepts are learned in one batch.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms.adapter import LowRank
from ftl_lightning.igm.forms.modes import Modes, explained
from ftl_lightning.igm.forms.stopping import Stopping
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.optimizer import Adam
from ftl_lightning.igm.settings import CONCEPTS, EXPLAINED, REDUCED, InversionSettings
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.randomness import generator, task_key

FINAL_SAMPLES, HELD_OUT_SAMPLES = 128, 32
"""Noised windows per run for the final loss, which selects a restart, and for the held-out loss, which stops and screens runs."""
START, STEP, FINAL, HELD_OUT = range(4)
"""Random streams, the second number of a generator's key: initial values, gradient steps, final loss, held-out loss."""

Tell = Callable[[float], None]
"""Callback after a gradient step: receives the mean loss of the active runs."""
Watch = Callable[[int, float, Callable[[], dict[str, Concept]]], None]
"""Callback after a gradient step: receives the number of the step from 1, the mean loss of the active runs, and a function that
returns the current concepts by name."""


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
    """Learn all concepts of the demonstrations in one batch (Eq. 2).

    Args:
        model: frozen model.
        demonstrations: demonstrations; ``demonstrations.concepts`` names the concept of each.
        settings: settings of the inversion.
        steps: maximum number of gradient steps; without early stopping the learning rates decay to 0 over them.
        tell, watch: callbacks after each gradient step; they do not affect the result.
        start: initial parameters, optimised in place; ``None`` for new ones.

    Returns:
        Concepts by name.

    Raises:
        UserError: if a loss or a concept is not finite, or if the model does not support the settings.
    """
    inversion = Inversion(model, demonstrations, settings).to(model.device) if start is None else start
    optimizers = [Adam(parameter, rate) for parameter, rate in inversion.rates]
    decay_steps = steps if settings.budget.tolerance is None else None
    for step in range(steps):
        losses = inversion.step_losses(step)
        # The gradient of the sum holds the gradient of each run, whose loss depends on no other run. The condition encoder is
        # evaluated without adapter: the adapter factors of its weights get zero gradients.
        parameters = [optimizer.parameter for optimizer in optimizers]
        gradients = torch.autograd.grad(losses.sum(), parameters, materialize_grads=True)
        for optimizer, gradient in zip(optimizers, gradients, strict=True):
            optimizer.step(gradient, step, decay_steps)
        loss = losses.detach().mean().item()
        tell(loss)
        if watch is not None:
            watch(step + 1, loss, inversion.learned)
        if not inversion.after_step(step):
            break
    return inversion.learned()


class Run(NamedTuple):
    """Optimisation of one set of K embeddings from one initial value.

    Attributes:
        concept: index of the concept in :attr:`Inversion.concepts`.
        rows: rows of the demonstrations that the run learns from.
        mode: number of the mode from 1; 0 for a run on all demonstrations of the concept.
    """

    concept: int
    rows: Sequence[int]
    mode: int


class Inversion(nn.Module):
    """Parameters and losses of an inversion, with all runs in one batch.

    Each restart of a concept has a low-rank adapter of the denoiser, if the settings ask for one. The run on all demonstrations
    learns the adapter; the modes use the adapter without learning it. The paper's form has neither modes nor adapter, and 1 knot.

    Args:
        model, demonstrations, settings: see :func:`invert`.
        by_sample: see :func:`~ftl_lightning.igm.forms.adapter.adaptable`.
        frames: frames of each concept ``(concept, place, horizon)``; ``None`` for those of its demonstrations.

    Attributes:
        embeddings: parameter ``(run, K, knots, n)``; a component has one embedding at each of ``knots`` times of the plan.
        weights: guidance weights ``(run, K)``; a parameter if omega is ``'learned'``, else constant.
        factors: parameters of the adapters ``(adapter, ...)``, a pair for each adapted weight of the denoiser.
        concepts, runs: names of the concepts, and the runs, ordered by concept, mode, restart.
        basis: orthonormal basis of the span of the training embeddings ``(rank, n)``.
        is_mode, kept: masks of the runs that learn a mode, and of those that are not screened out ``(run,)``.
        stopping: rule of early stopping; ``None`` without early stopping.

    Raises:
        UserError: if the model does not support the settings.
    """

    model: Invertible
    weights: Tensor
    frames: Tensor | None
    basis: Tensor
    is_mode: Tensor
    kept: Tensor

    def __init__(
        self,
        model: Invertible,
        demonstrations: Demonstrations,
        settings: InversionSettings,
        by_sample: bool = False,
        frames: Tensor | None = None,
    ) -> None:
        super().__init__()
        model.check_settings(settings)
        object.__setattr__(self, "model", model)  # not registered as a submodule
        self.demonstrations, self.settings = demonstrations, settings
        self.concepts = tuple(dict.fromkeys(demonstrations.concepts))
        self.runs = self._runs()
        frames = model.frames_of(demonstrations) if frames is None else frames
        self.register_buffer("frames", None if frames is None else frames[[run.concept for run in self.runs]], persistent=False)
        # N training embeddings with mean 0 have rank N - 1 or less.
        training = model.training_embeddings
        basis = torch.linalg.svd(training, full_matrices=False).Vh[: max(len(training) - 1, 1)]
        self.register_buffer("basis", basis, persistent=False)
        self.register_buffer("is_mode", torch.tensor([run.mode > 0 for run in self.runs]), persistent=False)
        self.register_buffer("kept", torch.ones(len(self.runs), dtype=torch.bool), persistent=False)
        # One generator per concept: its initial values do not depend on the other concepts.
        draws = [generator("cpu", settings.seed, START, task_key(name)) for name in self.concepts]
        self.embeddings = nn.Parameter(self._initial_embeddings(draws))
        shape = (len(self.runs), settings.components)
        if settings.omega == "learned":
            self.weights = nn.Parameter(torch.full(shape, float(settings.weights.initial)))
        else:
            self.register_buffer("weights", torch.full(shape, float(settings.omega)), persistent=False)
        sizes = model.adaptable(by_sample) if settings.adapter.rank else {}
        self._adapted = list(sizes)
        self.factors = self._initial_factors(list(sizes.values()), draws)
        tolerance = settings.budget.tolerance
        self.stopping = None if tolerance is None else Stopping(self.embeddings, self.weights, tolerance)

    def _runs(self) -> list[Run]:
        """Runs of each concept: on all its demonstrations, then on a part for each mode; each with its restarts."""
        texts, modes, runs = self.demonstrations.concepts, self.settings.modes.sets, []
        for concept, name in enumerate(self.concepts):
            rows = tuple(row for row, text in enumerate(texts) if text == name)
            count = min(modes, len(rows)) if isinstance(modes, int) else len(rows)
            parts = [rows, *((rows[mode::count] for mode in range(count)) if count > 1 else ())]
            runs += [Run(concept, part, mode) for mode, part in enumerate(parts) for _ in range(self.settings.budget.restarts)]
        return runs

    def _initial_embeddings(self, draws: Sequence[torch.Generator]) -> Tensor:
        """Initial embeddings ``(run, K, knots, n)``: normal noise around a training embedding, or around 0, the mean of them all.

        The paper uses U([0, 1]^n). A concept and its modes have the same initial embeddings, and so have all knots of a component.
        """
        options, restarts, training = self.settings.embeddings, self.settings.budget.restarts, self.model.training_embeddings
        shape = (restarts, self.settings.components, training.shape[1])
        by_concept = [torch.randn(shape, generator=draw) for draw in draws]
        noise = torch.cat([by_concept[run.concept] for run in self.runs[::restarts]])[:, :, None]
        initial = options.initial_spread * noise.repeat(1, 1, options.knots, 1)
        if options.start == CONCEPTS:
            restart = torch.arange(len(initial)) % restarts
            initial = initial + training.cpu()[restart % len(training), None, None]
        return initial

    def _initial_factors(self, sizes: Sequence[tuple[int, int]], draws: Sequence[torch.Generator]) -> nn.ParameterList:
        """Initial ``up (adapter, outputs, rank)`` and ``down (adapter, rank, inputs)`` of each weight ``(outputs, inputs)``.

        ``up`` is 0 and ``down`` is drawn from N(0, 1 / inputs), so that the initial update ``up @ down`` is 0.
        """
        factors, rank = nn.ParameterList(), self.settings.adapter.rank
        learning = [run for run in self.runs if not run.mode]
        for outputs, inputs in sizes:
            down = torch.stack([torch.randn(rank, inputs, generator=draws[run.concept]) for run in learning])
            factors.append(torch.zeros(len(learning), outputs, rank))
            factors.append(down / inputs**0.5)
        return factors

    @property
    def rates(self) -> list[tuple[nn.Parameter, float]]:
        """Each parameter with its initial learning rate."""
        learned = isinstance(self.weights, nn.Parameter)
        weights = [(self.weights, self.settings.weights.learning_rate)] if learned else []
        factors = [(factor, self.settings.adapter.learning_rate) for factor in self.factors]
        return [(self.embeddings, self.settings.budget.learning_rate), *weights, *factors]

    def scale_off_span(self, embeddings: Tensor) -> Tensor:
        """Scale the part of embeddings ``(..., n)`` that is orthogonal to the span of the training embeddings by ``off_span``."""
        if self.settings.embeddings.off_span == 1:
            return embeddings
        inside = embeddings @ self.basis.T @ self.basis
        return inside + self.settings.embeddings.off_span * (embeddings - inside)

    def _adapter_index(self, run: int) -> int:
        """Index of a run's adapter; adapters are ordered by concept, then restart."""
        restarts = self.settings.budget.restarts
        return self.runs[run].concept * restarts + run % restarts

    def _adapter(self, index: int) -> LowRank:
        """Adapter by its index."""
        factors = [factor[index] for factor in self.factors]
        pairs = zip(factors[::2], factors[1::2], strict=True)  # up and down
        return LowRank(dict(zip(self._adapted, pairs, strict=True)), self.settings.adapter.scope == "all")

    def _composition(self, embeddings: Tensor, weights: Tensor, runs: Sequence[int]) -> Composition:
        """Composition ``(run, K, ...)`` of some runs, with their adapters; detached adapters if all these runs are modes."""
        frames = None if self.frames is None else self.frames[list(runs), None].expand(-1, weights.shape[1], -1, -1)
        composition = Composition(self.scale_off_span(embeddings), weights, frames=frames)
        if not self.factors:
            return composition
        indices = [self._adapter_index(run) for run in runs]
        used = list(dict.fromkeys(indices))
        adapters = [self._adapter(index) for index in used]
        if all(self.runs[run].mode for run in runs):
            adapters = [adapter.detached() for adapter in adapters]
        number = torch.tensor([1 + used.index(index) for index in indices], device=weights.device)[:, None]
        return replace(composition, adapters=tuple(adapters), adapter=number.expand_as(weights))

    def losses(
        self,
        samples: int,
        draw: torch.Generator,
        chosen: Tensor | None = None,
        embeddings: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Loss of Eq. 2 for every sample of a run ``(run, samples)``. A sample is a window of a demonstration with noise.

        Sample s of a run is from demonstration ``s mod D`` of the D demonstrations of the run. All runs have the same noise,
        timesteps and relative starts of windows.

        Args:
            samples: number of samples per run.
            draw: random generator of timesteps, noise and windows.
            chosen: bool mask of runs ``(run,)``; ``None`` for all runs.
            embeddings, weights: values for all runs, ``(run, K, knots, n)`` and ``(run, K)``; ``None`` for the parameters.
        """
        embeddings, weights = self.embeddings if embeddings is None else embeddings, self.weights if weights is None else weights
        runs: Sequence[int] = range(len(self.runs))
        if chosen is not None:
            embeddings, weights, runs = embeddings[chosen], weights[chosen], chosen.nonzero()[:, 0].tolist()
        draws = self.model.draws(samples, self.settings.loss.timestep_power, draw)
        by_run = [self.runs[run].rows for run in runs]
        rows = torch.tensor([rows[sample % len(rows)] for rows in by_run for sample in range(samples)])
        starts = torch.rand(samples, generator=draw, device=embeddings.device).cpu().repeat(len(runs))
        states, observed = self.model.windows(self.demonstrations, rows, starts, draw)
        composition = self._composition(embeddings, weights, runs)
        return self.model.losses(states, observed, composition, draws, self.settings.loss)

    def step_losses(self, step: int) -> Tensor:
        """Mean losses ``(active run,)`` of gradient step ``step``, numbered from 0; modes come last.

        A run is active unless it is screened out or has stopped early.

        Raises:
            UserError: if a loss is not finite.
        """
        if self.stopping is not None and step == 0:
            self.stopping.begin(self._held_out(self.embeddings, self.weights))
        losses = []
        for samples, group in ((self.settings.budget.samples, ~self.is_mode), (self.settings.modes.samples, self.is_mode)):
            chosen = group & self.kept if self.stopping is None else group & self.kept & self.stopping.going
            if chosen.any():
                # A new generator for the modes: their noise does not depend on whether other runs are active.
                draw = generator(self.embeddings.device, self.settings.seed, STEP, step)
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

    def after_step(self, step: int) -> bool:
        """Screen restarts and stop runs early, if the settings ask for it, after gradient step ``step``, numbered from 0.

        Returns:
            Whether any run is still active.
        """
        if step + 1 == self.settings.budget.screening:
            losses = self._held_out(self.embeddings, self.weights).unflatten(0, (-1, self.settings.budget.restarts))
            self.kept = functional.one_hot(losses.argmin(dim=1), losses.shape[1]).bool().flatten()
            if self.stopping is not None:
                self.stopping.going &= self.kept  # a screened-out run counts as stopped
        return self.stopping is None or self.stopping.after_step(step, self.embeddings, self.weights, self._held_out)

    @torch.no_grad()
    def _held_out(self, embeddings: Tensor, weights: Tensor, chosen: Tensor | None = None) -> Tensor:
        """Held-out loss ``(run,)``: mean loss on the demonstrations with fixed noise that no gradient step uses."""
        draw = generator(self.embeddings.device, self.settings.seed, HELD_OUT)
        return self.losses(HELD_OUT_SAMPLES, draw, chosen, embeddings, weights).mean(dim=1)

    @torch.no_grad()
    def _final(self, embeddings: Tensor, weights: Tensor) -> Tensor:
        """Final loss ``(run,)``: mean loss on the demonstrations with another fixed noise, and more samples."""
        draw = generator(self.embeddings.device, self.settings.seed, FINAL)
        return self.losses(FINAL_SAMPLES, draw, None, embeddings, weights).mean(dim=1)

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """Current concepts by name, of each run the restart with the lowest final loss.

        With early stopping, embeddings and weights are those of the best round of steps, see
        :class:`~ftl_lightning.igm.forms.stopping.Stopping`; before the first round ends, those of the last step.

        Raises:
            UserError: if a concept is not finite.
        """
        source = self if self.stopping is None or not self.stopping.rounds else self.stopping
        parameters, weights, restarts = source.embeddings.detach(), source.weights.detach(), self.settings.budget.restarts
        losses = self._final(parameters, weights).where(self.kept, torch.inf)
        best = torch.arange(0, len(losses), restarts, device=losses.device) + losses.unflatten(0, (-1, restarts)).argmin(dim=1)
        auto = self.settings.modes.sets == "auto"
        empty = self._final(parameters, torch.zeros_like(weights)) if auto else losses
        embeddings, kind = self.scale_off_span(parameters), "learned" if self.settings.omega == "learned" else "fixed"
        weights = weights * (self.settings.weights.scale if kind == "learned" else 1.0)
        concepts, pretrained = {}, self.model.hash
        for index, name in enumerate(self.concepts):
            single, *modes = [run for run in best.tolist() if self.runs[run].concept == index]
            # Mixtures of the modes are samples of the concept only if a single set of embeddings describes it nearly as well.
            mixed = auto and bool(explained(empty[single], losses[single], losses[modes].mean()) >= EXPLAINED)
            concepts[name] = Concept(
                embeddings[single].cpu(),
                weights[single].cpu(),
                self.model.origin(self.demonstrations, name, kind, losses[single].item(), pretrained),
                Modes(embeddings[modes].cpu(), weights[modes].cpu(), mixed) if modes else None,
                self._adapter(self._adapter_index(single)).copied() if self.factors else None,
                frames=None if self.frames is None else self.frames[single].cpu(),
            )
            concepts[name].check_finite(f"inversion: concept {name!r}")
        return concepts
