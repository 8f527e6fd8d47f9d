"""Settings of an inversion, in groups."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, Self

from ftl_lightning.data.references import GAUSSIAN, SHIFTED, VARIED, WARPED
from ftl_lightning.igm.diffusion import LARGEST_POWER, LOSSES
from ftl_lightning.services.errors import require
from ftl_lightning.services.validation import LARGEST, LARGEST_RATE, MOST_TOGETHER, check_count, check_factor, check_range, replaced

EXPLAINED = 0.4
"""Minimum gain of a single set of embeddings, as a share of the modes' gain, to use mixtures; chosen on validation suites."""
MOST = 1000
"""Maximum number of components, knots and restarts, and maximum rank of an adapter."""

UNSAID, PAPER, AUTO = "", "paper", "auto"
"""Rules for a concept's form: by the source of demonstrations, see :meth:`InversionSettings.for_own`; by the other options (the
paper's form by default); selected by leave-one-out error."""
ONE, MODES, ADAPTED, MIXED, COMBINED = "one set", "modes", "adapter", "mixtures", "combination"
"""Forms: a set of embeddings; a set for each demonstration, drawn at random; a set and a low-rank adapter of the denoiser; a
set for each demonstration and a shared adapter, with samples from mixtures; weights of training concepts alone."""
NOT_LEARNED = (SHIFTED, WARPED, GAUSSIAN, VARIED)
"""Forms that sample a reference made of the demonstrations, not the model."""
VARIATION = 0.3
"""Share of the variance of training concepts that is added to samples of a concept, see ``Composition.variation``."""
MEAN, CONCEPTS = STARTS = "mean", "concepts"
"""Initial embeddings."""
FULL, REDUCED = PRECISIONS = "32-true", "bf16-mixed"
"""Precision of matrix products in learning."""
FORMS = (UNSAID, PAPER, AUTO, ONE, MODES, ADAPTED, MIXED, COMBINED, *NOT_LEARNED)

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
    "discount": "loss.discount",
    "training_omega": "weights.training",
}
"""Grouped options ``'group.option'`` by their flat names in results, checkpoints and the Python API."""


@dataclass(frozen=True, kw_only=True)
class EmbeddingOptions:
    """Parametrisation and initial values of embeddings.

    Attributes:
        knots: embeddings of a component at even times of the plan, interpolated by the denoiser; 1 is the paper's form. For
            denoisers with a time axis, such as the temporal U-Net.
        off_span: scale of the part of embeddings off the affine span of the training embeddings: 1 (the paper's form) is free, 0
            keeps embeddings in the span, values between slow the learning of that part.
        initial_spread: standard deviation of the initial noise in each column.
        start: ``'mean'`` starts at the mean of the training embeddings, ``'concepts'`` starts restart r at the r-th training
            embedding, both with noise. A network's choice by the concept, such as a goal object, is steep between concepts and
            flat around their mean.
    """

    knots: int = 1
    off_span: float = 1.0
    initial_spread: float = 0.05
    start: str = MEAN

    def __post_init__(self) -> None:
        check_count("model.embeddings.knots", self.knots, 1, MOST)
        check_factor("model.embeddings.initial_spread", self.initial_spread, 0)
        require(self.start in STARTS, "model.embeddings.start", " or ".join(STARTS), repr(self.start))
        require(0 <= self.off_span <= 1, "model.embeddings.off_span", "0 (span) to 1 (free)", self.off_span)


@dataclass(frozen=True, kw_only=True)
class WeightOptions:
    """Guidance weights: learning, if omega is ``'learned'``, and those of training concepts.

    Attributes:
        initial: initial value of learned weights (the published code draws them from U(0, 1)).
        learning_rate: learning rate of the weights; with the embeddings' rate they collapse.
        scale: final factor of learned weights; a fixed omega is not scaled. If the loss does not reach zero, plans regress
            towards the training distribution; a factor above 1 counters that.
        training: guidance weight of training concepts composed with a learned concept; ``None`` for the paper's rule: the fixed
            omega, or 1 with learned weights.
    """

    initial: float = 1.0
    learning_rate: float = 3e-3
    scale: float = 1.0
    training: float | None = None

    def __post_init__(self) -> None:
        check_factor("model.weights.initial", self.initial)
        check_factor("model.weights.learning_rate", self.learning_rate, 0, LARGEST_RATE)
        check_factor("model.weights.scale", self.scale, 0)
        if self.training is not None:
            check_factor("model.weights.training", self.training)


@dataclass(frozen=True, kw_only=True)
class ModeOptions:
    """Several sets of embeddings of a concept, see :class:`~ftl_lightning.igm.forms.modes.Modes`.

    Attributes:
        sets: 1 is the paper's form; otherwise a set is also learned, from the same start, for every demonstration (``'each'``), or
            from every n-th demonstration for n sets. ``'auto'`` is ``'each'``, with samples from mixtures of the modes if a single
            set has at least :data:`EXPLAINED` of the modes' gain, and from single modes otherwise.
        samples: noised demonstrations a step for a mode.
    """

    sets: int | Literal["each", "auto"] = 1
    samples: int = 8

    def __post_init__(self) -> None:
        place = "model.modes.sets"
        if isinstance(self.sets, int):
            require(self.sets >= 1, place, "1 or more, 'each' or 'auto'", self.sets)
            check_count(place, self.sets, 1, MOST_TOGETHER)
        else:
            require(self.sets in ("each", "auto"), place, "a number, 'each' or 'auto'", repr(self.sets))
        check_count("model.modes.samples", self.samples, 1, MOST_TOGETHER)


@dataclass(frozen=True, kw_only=True)
class AdapterOptions:
    """Low-rank adapter (LoRA) of the denoiser, learned with the embeddings.

    Attributes:
        rank: rank; 0, the paper's form, for no adapter.
        learning_rate: learning rate of its factors.
        scope: ``'concept'`` adapts the concept's branches alone; ``'all'`` adapts every composed branch, as fine-tuning does, for
            comparison.
    """

    rank: int = 0
    learning_rate: float = 1e-3
    scope: Literal["concept", "all"] = "concept"

    def __post_init__(self) -> None:
        require(self.scope in ("concept", "all"), "model.adapter.scope", "concept or all", repr(self.scope))
        require(self.rank >= 0, "model.adapter.rank", "0 (none) or a rank", self.rank)
        check_count("model.adapter.rank", self.rank, 0, MOST)
        check_factor("model.adapter.learning_rate", self.learning_rate, 0, LARGEST_RATE)


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """Compute budget of a concept.

    Attributes:
        samples: noised demonstrations a step and run, spread over the run's demonstrations and timesteps.
        restarts: independent starts of each concept; the restart with the lowest loss on common noise is kept.
        screening: steps after which only the restart of each concept with the lowest held-out loss continues; 0 for none.
        learning_rate: learning rate of the embeddings (Adam).
        tolerance: early stopping: a run stops when each of two rounds of 10 steps lowers its loss on held-out noise by less than
            this share of its total decrease. The learning rate is constant and the result is the mean over the best round, see
            :class:`~ftl_lightning.igm.forms.stopping.Stopping`. Steps after the last whole round do not count; without a whole
            round the last step does. ``None`` for all steps, with the rate decaying to 0.
        precision: precision of the network's products in a step, named as in Lightning's trainer: ``'32-true'``, or
            ``'bf16-mixed'`` for bfloat16, half the time with hardware support, see ``docs/speed.md``. Stopping and the reported
            loss are in single precision.
    """

    samples: int = 32
    restarts: int = 1
    screening: int = 0
    learning_rate: float = 0.1
    tolerance: float | None = None
    precision: Literal["32-true", "bf16-mixed"] = "32-true"

    def __post_init__(self) -> None:
        check_count("model.budget.samples", self.samples, 1, MOST_TOGETHER)
        check_count("model.budget.restarts", self.restarts, 1, MOST)
        check_count("model.budget.screening", self.screening, 0, LARGEST)
        check_factor("model.budget.learning_rate", self.learning_rate, 0, LARGEST_RATE)
        share = self.tolerance is None or 0 <= self.tolerance < 1
        require(share, "model.budget.tolerance", "null or a share from 0 up to 1", self.tolerance)
        require(self.precision in PRECISIONS, "model.budget.precision", f"one of {', '.join(PRECISIONS)}", repr(self.precision))


@dataclass(frozen=True, kw_only=True)
class Loss:
    """Training loss.

    Attributes:
        kind: target of the squared error, ``'epsilon'`` (Eq. 2), ``'v'`` or ``'clean'``. ``'v'`` and ``'clean'`` weigh noisy
            timesteps, at which the concept decides, by 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: timesteps are drawn as T (1 - u^power), u uniform in [0, 1). 1 (the paper's) is uniform; with 3 half of them
            fall in the noisiest eighth. There the concept alone decides; at low noise the plan reveals the goal, so the
            unconditional loss is already low: a local minimum.
        discount: state k of a window has weight ``discount ** k``; use values below 1 with replanning. 1 is the paper's.
    """

    kind: str = "epsilon"
    timestep_power: float = 1.0
    discount: float = 1.0

    def __post_init__(self) -> None:
        require(self.kind in LOSSES, "model.loss.kind", f"one of {', '.join(LOSSES)}", repr(self.kind))
        check_factor("model.loss.timestep_power", self.timestep_power, 1, LARGEST_POWER)
        check_range("model.loss.discount", self.discount, 0, 1)


@dataclass(frozen=True, kw_only=True)
class InversionSettings:
    """Settings of an inversion.

    Attributes:
        components: number of components K.
        omega: fixed guidance weight of every component, or ``'learned'``.
        embeddings: options of the embeddings.
        weights: options of the guidance weights.
        modes: options of several sets of embeddings.
        adapter: options of the denoiser's adapter.
        budget: compute budget.
        loss: options of the loss.
        seed: seed of starts, noise and timesteps.
        form: form of concepts, from :data:`FORMS`, see :mod:`ftl_lightning.igm.forms.choice`. ``'auto'`` and the forms after it
            override modes and adapter; an adapter's rank and learning rate are kept if given.

    Raises:
        UserError: at construction, for an invalid value.
    """

    components: int = 2
    omega: float | Literal["learned"] = 1.2
    embeddings: EmbeddingOptions = field(default_factory=EmbeddingOptions)
    weights: WeightOptions = field(default_factory=WeightOptions)
    modes: ModeOptions = field(default_factory=ModeOptions)
    adapter: AdapterOptions = field(default_factory=AdapterOptions)
    budget: BudgetOptions = field(default_factory=BudgetOptions)
    loss: Loss = field(default_factory=Loss)
    seed: int = 0
    form: str = UNSAID

    def __post_init__(self) -> None:
        require(self.form in FORMS, "model.form", f"one of {', '.join(FORMS[1:])}", repr(self.form))
        check_count("model.components", self.components, 1, MOST)
        check_range("model.seed", self.seed, 0)
        if self.omega != "learned":
            check_factor("model.omega", self.omega)
        stops = self.form in (UNSAID, PAPER) and self.adapter.rank and self.budget.tolerance is not None
        require(not stops, "model.adapter.rank", "model.budget.tolerance null beside it", "a number")

    def for_own(self, choose: bool) -> Self:
        """Settings for a user's demonstrations: the form is ``'auto'`` unless form, modes or adapter are given.

        Args:
            choose: whether the form may be chosen; see ``chooses_form`` of the model.
        """
        unsaid = self.form == UNSAID and self.modes.sets == 1 and not self.adapter.rank
        return replace(self, form=AUTO) if unsaid and choose else self

    def from_one_start(self, **options: Any) -> Self:
        """Copy with a single start at the mean of the training embeddings, and other changes, see :meth:`changed`."""
        return self.changed(start=MEAN, restarts=1, screening=0, **options)

    def changed(self, **options: Any) -> Self:
        """Copy with options changed by their flat names (:data:`INVERSION`)."""
        return replaced(self, options, INVERSION)


GROUPS: Mapping[str, type] = MappingProxyType(
    {
        "embeddings": EmbeddingOptions,
        "weights": WeightOptions,
        "modes": ModeOptions,
        "adapter": AdapterOptions,
        "budget": BudgetOptions,
        "loss": Loss,
    }
)
"""Option groups by name."""
