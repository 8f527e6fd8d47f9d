"""How concepts are learned: the settings of an inversion, in groups."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, Self

from ftl_lightning.diffusion.prediction import LOSSES
from ftl_lightning.diffusion.schedule import LARGEST_POWER
from ftl_lightning.errors import UserError, shown
from ftl_lightning.option_groups import replaced
from ftl_lightning.ranges import LARGEST, LARGEST_RATE, MOST_TOGETHER, expect_count, expect_factor, expect_range

EXPLAINED = 0.4
"""Share of the modes' gain from which on one set of embeddings is taken to say enough; chosen on validation suites."""
MOST = 1000
"""Components, knots, restarts, or ranks of an adapter."""

UNSAID, PAPER, AUTO = "", "paper", "auto"
"""Of a concept's form: what goes with where demonstrations come from, see :meth:`InversionSettings.for_own`; what the other options
say, the paper's unless they add to it; the one that the demonstrations ask for."""
ONE, MODES, ADAPTED, MIXED = "one set", "modes", "adapter", "mixtures"
"""Forms: one set of embeddings; one for each demonstration, of which one is drawn; one set and a small adapter of the denoiser; one
for each demonstration and an adapter that they share, with samples from mixtures."""
MEAN, CONCEPTS = STARTS = "mean", "concepts"
"""Where embeddings start."""
FULL, REDUCED = PRECISIONS = "32-true", "bf16-mixed"
"""Of products while concepts are learned."""
FORMS = (UNSAID, PAPER, AUTO, ONE, MODES, ADAPTED, MIXED)

INVERSION: Mapping[str, str] = {
    "initial_omega": "weights.initial",
    "off_span": "embeddings.off_span",
    "initial_spread": "embeddings.initial_spread",
    "start": "embeddings.start",
    "restarts": "budget.restarts",
    "screening": "budget.screening",
    "learning_rate": "budget.learning_rate",
    "weight_learning_rate": "weights.learning_rate",
    "samples": "budget.samples",
    "mode_samples": "modes.samples",
    "modes": "modes.sets",
    "tolerance": "budget.tolerance",
    "precision": "budget.precision",
    "knots": "embeddings.knots",
    "guidance_scale": "weights.scale",
    "adapter": "adapter.rank",
    "adapter_learning_rate": "adapter.learning_rate",
    "adapter_scope": "adapter.scope",
    "loss": "loss.kind",
    "timestep_power": "loss.timestep_power",
    "training_omega": "weights.training",
}
"""Place of each option of a group, ``'group.option'``, by its flat name in results, checkpoints and the Python API."""


@dataclass(frozen=True, kw_only=True)
class EmbeddingOptions:
    """Where embeddings are looked for.

    Attributes:
        knots: embeddings of a component at even times of the plan, between which the denoiser interpolates; 1 is the paper's form.
            For denoisers that see time, such as the temporal U-Net.
        off_span: how freely embeddings leave the affine span of the training embeddings: 1 is the paper's free form, 0 keeps
            them in the span, between the two the part off the span is scaled, which slows its learning down.
        initial_spread: embeddings start at the mean of the training embeddings plus so much normal noise a column.
        start: ``'mean'`` for there, or ``'concepts'``: restart r starts at the r-th training embedding, with the noise. What
            a network chooses by the concept, such as a thing that behaviour aims at, is steep between concepts and flat around
            their mean.
    """

    knots: int = 1
    off_span: float = 1.0
    initial_spread: float = 0.05
    start: str = MEAN

    def __post_init__(self) -> None:
        expect_count("model.embeddings.knots", self.knots, 1, MOST)
        expect_factor("model.embeddings.initial_spread", self.initial_spread, 0)
        if self.start not in STARTS:
            raise UserError(f"model.embeddings.start: expected {' or '.join(STARTS)}, found {shown(self.start)}")
        if not 0 <= self.off_span <= 1:
            raise UserError(f"model.embeddings.off_span: expected 0 (span) to 1 (free), found {self.off_span}")


@dataclass(frozen=True, kw_only=True)
class WeightOptions:
    """How guidance weights are learned where omega is ``'learned'``, and those of training concepts.

    Attributes:
        initial: where learned weights start (the paper draws them from U(0, 1)).
        learning_rate: of the weights; with the embeddings' rate they collapse.
        scale: what learned weights are multiplied by at the end; a fixed omega stays. Where the loss does not reach zero, plans
            regress towards the training distribution; more than 1 counters that.
        training: guidance weight of training concepts composed with a learned one; ``None`` for the paper's rule: the fixed omega,
            or 1 where weights are learned.
    """

    initial: float = 1.0
    learning_rate: float = 3e-3
    scale: float = 1.0
    training: float | None = None

    def __post_init__(self) -> None:
        expect_factor("model.weights.initial", self.initial)
        expect_factor("model.weights.learning_rate", self.learning_rate, 0, LARGEST_RATE)
        expect_factor("model.weights.scale", self.scale, 0)
        if self.training is not None:
            expect_factor("model.weights.training", self.training)


@dataclass(frozen=True, kw_only=True)
class ModeOptions:
    """Several sets of embeddings of a concept, see :class:`~ftl_lightning.concepts.modes.Modes`.

    Attributes:
        sets: 1 is the paper's form; otherwise beside it, from the same start, a set is learned from every demonstration
            (``'each'``), or from every n-th one for n sets. ``'auto'`` is ``'each'``, with samples from mixtures of the modes where
            one set explains the demonstrations at least :data:`EXPLAINED` as well as they do, and from single modes elsewhere.
        samples: noised demonstrations a step of the run of a mode.
    """

    sets: int | Literal["each", "auto"] = 1
    samples: int = 8

    def __post_init__(self) -> None:
        if isinstance(self.sets, int) and self.sets < 1:
            raise UserError(f"model.modes.sets: expected 1 or more, 'each' or 'auto', found {self.sets}")
        if isinstance(self.sets, str) and self.sets not in ("each", "auto"):
            raise UserError(f"model.modes.sets: expected a number, 'each' or 'auto', found {self.sets!r}")
        if isinstance(self.sets, int):
            expect_count("model.modes.sets", self.sets, 1, MOST_TOGETHER)
        expect_count("model.modes.samples", self.samples, 1, MOST_TOGETHER)


@dataclass(frozen=True, kw_only=True)
class AdapterOptions:
    """A low-rank change of the denoiser (LoRA), learned beside the embeddings.

    Attributes:
        rank: 0, the paper's form, for none.
        learning_rate: of its factors.
        scope: ``'concept'`` for the concept's own branches alone; ``'all'`` changes everything that the concept is composed with
            too, as fine-tuning does, to compare with.
    """

    rank: int = 0
    learning_rate: float = 1e-3
    scope: Literal["concept", "all"] = "concept"

    def __post_init__(self) -> None:
        if self.scope not in ("concept", "all"):
            raise UserError(f"model.adapter.scope: expected concept or all, found {self.scope!r}")
        if self.rank < 0:
            raise UserError(f"model.adapter.rank: expected 0 (none) or a rank, found {self.rank}")
        expect_count("model.adapter.rank", self.rank, 0, MOST)
        expect_factor("model.adapter.learning_rate", self.learning_rate, 0, LARGEST_RATE)


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """How much is computed for a concept.

    Attributes:
        samples: noised demonstrations a step and run, spread over the run's demonstrations and timesteps.
        restarts: independent starts of each concept; the one with the lowest loss on common noise is kept.
        screening: steps after which, of each concept, the restart with the lowest loss on held-out noise goes on alone; 0 for none.
        learning_rate: of the embeddings (Adam).
        tolerance: a run stops when each of two rounds of 10 steps lowers its loss on held-out noise by less than this share of
            all that it has fallen; the learning rate is constant then, and the result is the mean over the best round, see
            :class:`~ftl_lightning.learning.stopping.Stopping`. Steps after the last whole round do not count; of fewer steps than
            a round has, the last one does. ``None`` for all steps, the rate decaying to 0.
        precision: of the network's products in a step, with the names of Lightning's trainer: ``'32-true'``, or ``'bf16-mixed'``
            for bfloat16, half the time where a processor or GPU multiplies it, see ``docs/speed.md``. Stopping and the loss that
            is told are in single precision.
    """

    samples: int = 32
    restarts: int = 1
    screening: int = 0
    learning_rate: float = 0.1
    tolerance: float | None = None
    precision: Literal["32-true", "bf16-mixed"] = "32-true"

    def __post_init__(self) -> None:
        expect_count("model.budget.samples", self.samples, 1, MOST_TOGETHER)
        expect_count("model.budget.restarts", self.restarts, 1, MOST)
        expect_count("model.budget.screening", self.screening, 0, LARGEST)
        expect_factor("model.budget.learning_rate", self.learning_rate, 0, LARGEST_RATE)
        if self.tolerance is not None and not 0 <= self.tolerance < 1:
            raise UserError(f"model.budget.tolerance: expected null or a share from 0 up to 1, found {self.tolerance}")
        if self.precision not in PRECISIONS:
            raise UserError(f"model.budget.precision: expected one of {', '.join(PRECISIONS)}, found {self.precision!r}")


@dataclass(frozen=True, kw_only=True)
class LossOptions:
    """What is minimised.

    Attributes:
        kind: whose squared error, ``'epsilon'`` (Eq. 2), ``'v'`` or ``'clean'``. The others weigh noisy timesteps, at which the
            concept decides, by 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: timesteps are drawn as T (1 - u^power), u even in [0, 1). 1 spreads them evenly (the paper's); with 3 half
            of them fall in the noisiest eighth. There the concept alone tells what to do; at low noise the plan reveals the goal,
            so the empty concept already has a low loss: a local minimum.
    """

    kind: str = "epsilon"
    timestep_power: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in LOSSES:
            raise UserError(f"model.loss.kind: expected one of {', '.join(LOSSES)}, found {self.kind!r}")
        expect_factor("model.loss.timestep_power", self.timestep_power, 1, LARGEST_POWER)


@dataclass(frozen=True, kw_only=True)
class InversionSettings:
    """How concepts are learned.

    Attributes:
        components: K.
        omega: fixed guidance weight of every component, or ``'learned'``.
        embeddings: where they are looked for.
        weights: how they are learned.
        modes: several sets of embeddings.
        adapter: of the denoiser.
        budget: how much is computed.
        loss: what is minimised.
        seed: decides starts, noise and timesteps.
        form: of concepts, one of :data:`FORMS`, see :mod:`ftl_lightning.learning.forms`. ``'auto'`` and the forms behind it decide
            about modes and adapter; of an adapter that the options name, rank and learning rate are taken over.

    Raises:
        UserError: at construction, for a value that is none.
    """

    components: int = 2
    omega: float | Literal["learned"] = 1.2
    embeddings: EmbeddingOptions = field(default_factory=EmbeddingOptions)
    weights: WeightOptions = field(default_factory=WeightOptions)
    modes: ModeOptions = field(default_factory=ModeOptions)
    adapter: AdapterOptions = field(default_factory=AdapterOptions)
    budget: BudgetOptions = field(default_factory=BudgetOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    seed: int = 0
    form: str = UNSAID

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise UserError(f"model.form: expected one of {', '.join(FORMS[1:])}, found {self.form!r}")
        expect_count("model.components", self.components, 1, MOST)
        expect_range("model.seed", self.seed, 0)
        if self.omega != "learned":
            expect_factor("model.omega", self.omega)
        if self.form in (UNSAID, PAPER) and self.adapter.rank and self.budget.tolerance is not None:
            raise UserError("model.adapter.rank: expected model.budget.tolerance null beside it, found a number")

    def for_own(self, choose: bool) -> Self:
        """The same for demonstrations of one's own: where nothing is said of form, modes and adapter, the form is chosen.

        Args:
            choose: whether the model takes adapters, and nobody says otherwise.
        """
        unsaid = self.form == UNSAID and self.modes.sets == 1 and not self.adapter.rank
        return replace(self, form=AUTO) if unsaid and choose else self

    def from_one_start(self, **options: Any) -> Self:
        """The same with one start, at the mean of the training embeddings, and some options changed, see :meth:`changed`."""
        return self.changed(start=MEAN, restarts=1, screening=0, **options)

    def changed(self, **options: Any) -> Self:
        """The same with some options changed, given by their flat names (:data:`INVERSION`)."""
        return replaced(self, options, INVERSION)


GROUPS: Mapping[str, type] = MappingProxyType(
    {
        "embeddings": EmbeddingOptions,
        "weights": WeightOptions,
        "modes": ModeOptions,
        "adapter": AdapterOptions,
        "budget": BudgetOptions,
        "loss": LossOptions,
    }
)
"""The groups by name."""
