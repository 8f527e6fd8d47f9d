"""Forms of learned concepts, and selection of a form by leave-one-out error."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Choice, Concept
from ftl_lightning.igm.forms.leave_one_out import learned_from, quickly, relative_losses
from ftl_lightning.igm.forms.modes import Modes, even_stretch
from ftl_lightning.igm.forms.quality import Quality, measured
from ftl_lightning.igm.inversion import Inversion, Tell, Watch, invert
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.settings import ADAPTED, AUTO, MIXED, MODES, ONE, PAPER, UNSAID, InversionSettings

RANK, RATE, ADAPTER_STEPS = 1, 3e-3, 120
"""Default rank, learning rate and steps of adapters."""
MODE_SAMPLES, MODE_STEPS = 16, 400
"""Noised demonstrations a step, and maximum number of steps, of modes without an adapter."""
FOLDS, CLEAR, FEWER = 5, 0.4, 2
"""Maximum number of leave-one-out folds; relative loss of one set below which it suffices, so that folds only decide about
composition; number of folds then. Losses are relative to the unconditional (empty concept's) loss.
"""
TOLERANCE = 0.01
"""Default tolerance of early stopping."""
OWN, BOTH, ALL = 0.8, 2.03, 3.27
"""One set suffices if its relative training loss is at most the first value; or if the sum of training and leave-one-out losses is
at most the second, or with sets in the span, the sum including the span's leave-one-out loss at most the third. Chosen on relations
not seen in pretraining, see docs/experiments-forms.md.
"""
NARROW, WIDE = 0.65, 0.75
"""Spread of samples, relative to demonstrations: below the first value mixtures replace one set; mixtures above the second are
stretched less."""
Concepts = Mapping[str, Concept]
SPAN_LOSS = 1.03
"""Maximum ratio of leave-one-out losses, in the span of the training concepts to free, to compose a concept from a set in the
span."""


def learn(
    model: Invertible,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Tell = lambda loss: None,
    watch: Watch | None = None,
    start: Inversion | None = None,
) -> dict[str, Concept]:
    """Learn every concept of the demonstrations in the form of the settings; for ``'auto'``, selected by leave-one-out error.

    Args:
        model, demonstrations, settings, steps, tell: see :func:`~ftl_lightning.igm.inversion.invert`.
        watch, start: of the first inversion, with :func:`first_settings`.
    """
    model.check_settings(settings)
    first = invert(model, demonstrations, first_settings(settings), steps, tell, watch, start)
    if settings.form in (UNSAID, PAPER, ONE):
        return first
    if settings.form == MODES:
        return _with_modes(model, demonstrations, settings, steps, first, tell)
    if settings.form in (ADAPTED, MIXED):
        return _adapted(model, demonstrations, settings, steps, settings.form == MIXED, tell)
    return _chosen(model, demonstrations, settings, steps, first, tell)


def first_settings(settings: InversionSettings) -> InversionSettings:
    """Settings of the first inversion: unchanged in the paper's form, else one set without an adapter."""
    return settings if settings.form in (UNSAID, PAPER) else _one_set(settings)


def _one_set(settings: InversionSettings, **changes: Any) -> InversionSettings:
    """One set without an adapter; with early stopping for ``'auto'``, which needs its loss alone."""
    if settings.form == AUTO and settings.budget.tolerance is None:
        changes["tolerance"] = TOLERANCE
    return settings.changed(form=PAPER, modes=1, adapter=0, **changes)


def _with_modes(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, first: Concepts, tell: Tell
) -> dict[str, Concept]:
    """The first concepts with a mode for each demonstration, learned without early stopping, since samples depend on modes."""
    alone = settings.from_one_start(form=PAPER, modes=1, adapter=0, samples=MODE_SAMPLES, tolerance=None)
    sets = learned_from(model, demonstrations, [[row] for row in range(len(demonstrations))], alone, min(steps, MODE_STEPS), tell)
    formed = {}
    for name, concept in first.items():
        rows = [row for row, text in enumerate(demonstrations.concepts) if text == name]
        modes = Modes(sets.embeddings[rows].cpu(), sets.weights[rows].cpu(), mixed=False)
        formed[name] = replace(concept, modes=modes if len(rows) > 1 else None)
    return formed


def _adapted(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, mixed: bool, tell: Tell
) -> dict[str, Concept]:
    """Concepts of one set and an adapter; with ``mixed``, of mixtures that share an adapter (several demonstrations only)."""
    adapter = settings.adapter
    rank, rate = (adapter.rank, adapter.learning_rate) if adapter.rank else (RANK, RATE)
    changes = {"modes": "each" if mixed else 1, "adapter": rank, "adapter_learning_rate": rate, "tolerance": None}
    concepts = invert(model, demonstrations, settings.from_one_start(form=PAPER, **changes), min(steps, ADAPTER_STEPS), tell)
    for name, concept in concepts.items():
        if concept.modes:
            modes = replace(concept.modes, mixed=True, stretch=even_stretch(len(concept.modes)))
            concepts[name] = replace(concept, modes=modes)
    return concepts


@dataclass(frozen=True)
class _Shares:
    """Relative training, mean leave-one-out (``None`` for under three) and in-span (``None`` without texts) losses of a set."""

    own: float
    left_out: float | None = None
    in_span: float | None = None

    @property
    def suffices(self) -> bool:
        """Whether one set of embeddings suffices."""
        if self.own <= OWN or self.left_out is None:
            return self.own <= OWN
        both = self.own + self.left_out
        return both <= BOTH if self.in_span is None else both + self.in_span <= ALL

    @property
    def composes(self) -> bool:
        """Whether a set in the span has about the leave-one-out loss of a free set."""
        return self.left_out is not None and self.in_span is not None and self.in_span <= SPAN_LOSS * self.left_out

    @property
    def numbers(self) -> dict[str, float]:
        """Available losses by name."""
        named = {"loss, own": self.own, "loss, left out": self.left_out, "loss, left out, in span": self.in_span}
        return {name: value for name, value in named.items() if value is not None}


def _loss_shares(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, first: Concepts, tell: Tell
) -> dict[str, _Shares]:
    """Training and leave-one-out losses of one set for every concept."""
    every = {name: [row for row, text in enumerate(demonstrations.concepts) if text == name] for name in first}
    losses = {name: [_own_loss(model, _of(demonstrations, [name]), first[name], settings)] for name in first}
    left = {
        name: rows[:: -(-len(rows) // (FEWER if losses[name][0] < CLEAR else FOLDS))] if len(rows) > 2 else []
        for name, rows in every.items()
    }
    folds = [[row for row in every[name] if row != out] for name, rows in left.items() for out in rows]
    for off_span in (settings.embeddings.off_span, 0.0)[: 1 + model.text_space] if folds else ():
        learned = learned_from(model, demonstrations, folds, quickly(settings).changed(off_span=off_span), steps, tell)
        number = 0
        for name, rows in left.items():
            part = slice(number, number + len(rows))
            sets = Composition(learned.embeddings[part], learned.weights[part])
            if rows:
                losses[name].append(float(relative_losses(model, demonstrations.rows(rows), sets, settings).diagonal().mean()))
            number += len(rows)
    return {name: _Shares(*measured) for name, measured in losses.items()}


def _own_loss(model: Invertible, demonstrations: Demonstrations, concept: Concept, settings: InversionSettings) -> float:
    """Relative training loss of one set of embeddings."""
    weights = concept.weights if settings.omega != "learned" else concept.weights / settings.weights.scale
    alone = Composition(concept.embeddings[None], weights[None]).to(model.device)
    return float(relative_losses(model, demonstrations, alone, settings).mean())


def _of(demonstrations: Demonstrations, concepts: Collection[str]) -> Demonstrations:
    """The demonstrations of some concepts."""
    return demonstrations.rows([row for row, name in enumerate(demonstrations.concepts) if name in concepts])


def _chosen(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, first: Concepts, tell: Tell
) -> dict[str, Concept]:
    """Every concept in its selected form, with its measurements and its embeddings for composition."""
    demonstrated = {name: demonstrations.select(name) for name in first}
    chosen = {
        name: replace(concept, choice=Choice(ONE, "there is a single demonstration", {}))
        for name, concept in first.items()
        if len(demonstrated[name]) < 2
    }
    several = {name: concept for name, concept in first.items() if name not in chosen}
    if not several:
        return chosen
    shares = _loss_shares(model, _of(demonstrations, several), settings, steps, several, tell)
    forms: dict[str, dict[str, Concept]] = {name: {} for name in several}
    if rest := {name: concept for name, concept in several.items() if not shares[name].suffices}:
        for name, concept in _with_modes(model, _of(demonstrations, rest), settings, steps, rest, tell).items():
            forms[name][MODES] = concept
    if enough := [name for name in several if name not in rest]:
        for name, concept in _adapted(model, _of(demonstrations, enough), settings, steps, False, tell).items():
            forms[name][ADAPTED] = concept
    qualities = {name: measured(model, demonstrated[name], forms[name], settings.seed) for name in several}
    if narrow := [name for name in enough if qualities[name][ADAPTED].spread < NARROW]:
        for name, concept in _adapted(model, _of(demonstrations, narrow), settings, steps, True, tell).items():
            forms[name][MIXED], qualities[name][MIXED] = _narrowed(model, demonstrated[name], concept, settings.seed)
    span: Concepts = {}
    if composable := [name for name, share in shares.items() if share.composes]:
        span = invert(model, _of(demonstrations, composable), _one_set(settings.from_one_start(), off_span=0.0), steps, tell)
    for name in several:
        form, because = _choice(shares[name], qualities[name])
        composing = None
        if name in span:
            composing, because = (span[name].embeddings, span[name].weights), f"{because}; composed in the training span"
        numbers = {f"{key}, {kind}": value for kind, quality in qualities[name].items() for key, value in quality.numbers.items()}
        rounded = {key: round(value, 4) for key, value in (shares[name].numbers | numbers).items()}
        chosen[name] = replace(forms[name][form], choice=Choice(form, because, rounded), composing=composing)
    return {name: chosen[name] for name in first}


def _narrowed(model: Invertible, demonstrations: Demonstrations, concept: Concept, seed: int) -> tuple[Concept, Quality]:
    """Mixtures, stretched less if they spread too widely, and their quality."""
    quality = measured(model, demonstrations, {MIXED: concept}, seed)[MIXED]
    if quality.spread <= WIDE or concept.modes is None:
        return concept, quality
    stretch = max(WIDE / quality.spread * concept.modes.stretch, 1.0)  # at least plain mixtures
    concept = replace(concept, modes=replace(concept.modes, stretch=stretch))
    return concept, measured(model, demonstrations, {MIXED: concept}, seed)[MIXED]


def _choice(shares: _Shares, qualities: Mapping[str, Quality]) -> tuple[str, str]:
    """The selected form and its reason."""
    losses = f"{shares.own:.2f} of the empty concept's"
    if shares.left_out is not None:
        losses = f"{shares.left_out:.2f} of the empty concept's on left-out demonstrations, {shares.own:.2f} on its own"
    if not shares.suffices:
        return MODES, f"one set of embeddings does not explain the demonstrations (loss {losses}), so samples stay close to them"
    because, spread = f"one set of embeddings explains the demonstrations (loss {losses})", qualities[ADAPTED].spread
    if MIXED in qualities and (mixed := qualities[MIXED].spread) > spread:
        return MIXED, f"{because}; its samples spread {spread:.2f} of what the demonstrations do, mixtures {mixed:.2f}"
    return ADAPTED, f"{because}; samples spread {spread:.2f} of what the demonstrations do"
