"""How concepts are learned: the settings of an inversion."""

from dataclasses import dataclass
from typing import Literal

from ftl_lightning.diffusion.prediction import LOSSES
from ftl_lightning.diffusion.schedule import LARGEST_POWER
from ftl_lightning.errors import UserError
from ftl_lightning.ranges import LARGEST_RATE, MOST_TOGETHER, expect_count, expect_factor, expect_range

EXPLAINED = 0.4
"""Share of the modes' gain from which on one set of embeddings is taken to say enough; chosen on validation suites."""


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
        learning_rate: of the embeddings (Adam).
        weight_learning_rate: of the weights; with the embeddings' rate they collapse.
        samples: noised demonstrations a step and run, spread over the run's demonstrations and timesteps.
        mode_samples: the same of the run of a mode.
        modes: sets of embeddings of a concept, see :class:`~ftl_lightning.concepts.composition.Modes`. 1 is the paper's form;
            otherwise beside it, from the same start, a set is learned from every demonstration (``'each'``), or from every
            n-th one for n sets. ``'auto'`` is ``'each'``, with samples from mixtures of the modes where one set explains the
            demonstrations at least :data:`EXPLAINED` as well as they do, and from single modes elsewhere.
        tolerance: a run stops when each of two rounds of 10 steps lowers its loss on held-out noise by less than this share of
            all that it has fallen; the learning rate is constant then, and the result is the mean over the best round, see
            :class:`~ftl_lightning.learning.stopping.Stopping`. Steps after the last whole round do not
            count; of fewer steps than a round has, the last one does. ``None`` for all
            steps, the rate decaying to 0.
        knots: embeddings of a component at even times of the plan, between which the denoiser interpolates; 1 is the paper's form.
            For denoisers that see time, such as the temporal U-Net.
        guidance_scale: what learned weights are multiplied by at the end; a fixed omega stays. A loss that is not zero leaves a
            plan between what was demonstrated and what is usual; more than 1 takes it further.
        adapter: rank of a low-rank change of the denoiser in the concept's own branches (LoRA), learned beside the embeddings; 0,
            the paper's form, for none.
        adapter_learning_rate: of that.
        adapter_scope: ``'concept'`` for these branches alone; ``'all'`` changes everything that the concept is composed with
            too, as fine-tuning does, to compare with.
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
    mode_samples: int = 8
    modes: int | Literal["each", "auto"] = 1
    tolerance: float | None = None
    knots: int = 1
    guidance_scale: float = 1.0
    adapter: int = 0
    adapter_learning_rate: float = 1e-3
    adapter_scope: Literal["concept", "all"] = "concept"
    loss: str = "epsilon"
    timestep_power: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("components", "restarts", "samples", "mode_samples", "knots"):
            if (value := getattr(self, name)) < 1:
                raise UserError(f"model.{name}: expected 1 or more, found {value}")
        for name, most in (("components", 1000), ("restarts", 1000), ("knots", 1000), ("samples", MOST_TOGETHER)):
            expect_count(f"model.{name}", getattr(self, name), 1, most)
        expect_count("model.mode_samples", self.mode_samples, 1, MOST_TOGETHER)
        for name in ("learning_rate", "weight_learning_rate", "adapter_learning_rate"):
            expect_factor(f"model.{name}", getattr(self, name), 0, LARGEST_RATE)
        expect_factor("model.initial_spread", self.initial_spread, 0)
        expect_range("model.seed", self.seed, 0)
        expect_factor("model.initial_omega", self.initial_omega)
        expect_factor("model.guidance_scale", self.guidance_scale, 0)
        if self.omega != "learned":
            expect_factor("model.omega", self.omega)
        if isinstance(self.modes, int) and self.modes < 1:
            raise UserError(f"model.modes: expected 1 or more, 'each' or 'auto', found {self.modes}")
        if isinstance(self.modes, str) and self.modes not in ("each", "auto"):
            raise UserError(f"model.modes: expected a number, 'each' or 'auto', found {self.modes!r}")
        if self.tolerance is not None and not 0 <= self.tolerance < 1:
            raise UserError(f"model.tolerance: expected null or a share from 0 up to 1, found {self.tolerance}")
        if self.adapter_scope not in ("concept", "all"):
            raise UserError(f"model.adapter_scope: expected concept or all, found {self.adapter_scope!r}")
        if self.adapter < 0:
            raise UserError(f"model.adapter: expected 0 (none) or a rank, found {self.adapter}")
        if self.adapter and (self.modes != 1 or self.tolerance is not None):
            raise UserError("model.adapter: expected model.modes 1 and model.tolerance null beside it, found others")
        if not 0 <= self.off_span <= 1:
            raise UserError(f"model.off_span: expected 0 (span) to 1 (free), found {self.off_span}")
        if self.timestep_power < 1:
            raise UserError(f"model.timestep_power: expected 1 or more, found {self.timestep_power}")
        expect_factor("model.timestep_power", self.timestep_power, 1, LARGEST_POWER)
        expect_count("model.adapter", self.adapter, 0, 1000)
        if isinstance(self.modes, int):
            expect_count("model.modes", self.modes, 1, MOST_TOGETHER)
        if self.loss not in LOSSES:
            raise UserError(f"model.loss: expected one of {', '.join(LOSSES)}, found {self.loss!r}")
