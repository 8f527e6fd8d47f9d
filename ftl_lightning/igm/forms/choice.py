"""Forms of learned concepts, and selection of a form by leave-one-out error."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.references import VARIED, WARPED, Reference, Setting
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import KNOWN, NEARER, SKILL, Choice, Concept
from ftl_lightning.igm.forms.combination import Combination
from ftl_lightning.igm.forms.leave_one_out import learned_from, quickly, relative_losses
from ftl_lightning.igm.forms.modes import Modes, even_stretch
from ftl_lightning.igm.forms.quality import Quality, measured
from ftl_lightning.igm.forms.skill import SHARES, LeftOut
from ftl_lightning.igm.inversion import Inversion, Tell, Watch, invert
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.settings import (
    ADAPTED,
    AUTO,
    COMBINED,
    MIXED,
    MODES,
    NOT_LEARNED,
    ONE,
    PAPER,
    UNSAID,
    VARIATION,
    InversionSettings,
)
from ftl_lightning.services.errors import UserError

RANK, RATE, ADAPTER_STEPS = 1, 3e-3, 120
"""Rank, learning rate and maximum number of steps of adapters, if the settings give no rank."""
SKILLED: Mapping[str, Any] = {"adapter": 8, "adapter_learning_rate": 6e-3, "components": 1, "omega": 1.0, "samples": 16}
SKILLED_STEPS = 200
"""Settings and steps of the adapter that :func:`by_skill` learns."""
LEARNED = (COMBINED, ONE, ADAPTED)
"""Learned forms of :func:`by_skill`."""
MODE_SAMPLES, MODE_STEPS = 16, 400
"""Noised demonstrations a step, and maximum number of steps, of modes without an adapter."""
FOLDS, CLEAR, FEWER = 5, 0.4, 2
"""Maximum number of leave-one-out folds; relative loss of one set below which it suffices, so that folds only decide about
composition; number of folds then. Losses are relative to the unconditional loss.
"""
NEARLY, WARM_STEPS = 0.2, 40
"""Relative loss of one set below which it explains nearly everything: no folds are learned, and an adapter starts from a free
set, with this maximum number of steps. Chosen on navigation's validation suite.
"""
TOLERANCE = 0.01
"""Default tolerance of early stopping."""
OWN, BOTH, ALL = 0.8, 2.03, 3.27
"""One set suffices if its relative training loss is at most the first value; or if the sum of training and leave-one-out losses is
at most the second, or with sets in the span of the training embeddings, the sum including their leave-one-out loss at most the
third. Chosen on relations not seen in pretraining, see docs/findings.md#own-data.
"""
NARROW, WIDE = 0.65, 0.75
"""Spread of samples, relative to demonstrations: below the first value mixtures replace one set; mixtures above the second are
stretched less."""
Concepts = Mapping[str, Concept]
SPAN_LOSS = 1.03
"""Maximum ratio of leave-one-out losses, in the span of the training embeddings to free, to compose a concept from a set in
this span."""


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
    most = _adapter_steps(settings, steps) if settings.form == ADAPTED else steps
    first = invert(model, demonstrations, first_settings(settings), most, tell, watch, start)
    if settings.form in (UNSAID, PAPER):
        return first
    variation = 0.0 if model.variations is None else VARIATION
    if settings.form in NOT_LEARNED:
        usual = variation if settings.form == VARIED else 0.0
        return {name: _made(model, demonstrations.select(name), settings.form, concept, usual) for name, concept in first.items()}
    if settings.form == AUTO and model.examples is not None:
        return {name: by_skill(model, demonstrations.select(name), settings, steps, first[name], tell) for name in first}
    concepts = _formed(model, demonstrations, settings, steps, first, tell)
    return {name: replace(concept, variation=variation) for name, concept in concepts.items()}


def _formed(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, first: Concepts, tell: Tell
) -> Mapping[str, Concept]:
    """The concepts in the form of the settings, learned from demonstrations; ``first`` are those of one set."""
    if settings.form in (ONE, ADAPTED):
        return first
    if settings.form == MODES:
        return _with_modes(model, demonstrations, settings, steps, first, tell)
    if settings.form == MIXED:
        return _adapted(model, demonstrations, settings, steps, True, tell)
    if settings.form == COMBINED:
        combinations = {name: Combination.of(model, demonstrations.select(name), settings) for name in first}
        return {name: _combined(model, combinations[name], concept) for name, concept in first.items()}
    return _chosen(model, demonstrations, settings, steps, first, tell)


def first_settings(settings: InversionSettings) -> InversionSettings:
    """Settings of the first inversion: unchanged in the paper's form, else one set, with an adapter if it is the form."""
    if settings.form == ADAPTED:
        return _with_adapter(settings, False)
    return settings if settings.form in (UNSAID, PAPER) else _one_set(settings)


def _with_adapter(settings: InversionSettings, mixed: bool) -> InversionSettings:
    """One set and an adapter, or with ``mixed`` a mode of each demonstration that share an adapter."""
    rank, rate = (settings.adapter.rank, settings.adapter.learning_rate) if settings.adapter.rank else (RANK, RATE)
    changes = {"modes": "each" if mixed else 1, "adapter": rank, "adapter_learning_rate": rate, "tolerance": None}
    return settings.from_one_start(form=PAPER, **changes)


def _adapter_steps(settings: InversionSettings, steps: int) -> int:
    """Steps of an adapter: all for a rank of the settings."""
    return steps if settings.adapter.rank else min(steps, ADAPTER_STEPS)


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
    rows, names = range(len(demonstrations)), list(first)
    frames = model.frames_of(demonstrations)
    frames = None if frames is None else frames[[names.index(text) for text in demonstrations.concepts]]
    sets = learned_from(model, demonstrations, [[row] for row in rows], alone, min(steps, MODE_STEPS), tell, frames)
    formed = {}
    for name, concept in first.items():
        some = [row for row, text in enumerate(demonstrations.concepts) if text == name]
        modes = Modes(sets.embeddings[some].cpu(), sets.weights[some].cpu(), mixed=False)
        formed[name] = replace(concept, modes=modes if len(some) > 1 else None)
    return formed


def _adapted(
    model: Invertible,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    mixed: bool,
    tell: Tell,
    by_sample: bool = False,
    first: Concepts | None = None,
) -> dict[str, Concept]:
    """Concepts of one set and an adapter; with ``mixed``, of mixtures that share an adapter (several demonstrations only).

    With ``first``, learning starts from these sets and takes at most :data:`WARM_STEPS`.
    """
    one = _with_adapter(settings, mixed)
    most = min(steps, SKILLED_STEPS) if by_sample else _adapter_steps(settings, steps)
    start = Inversion(model, demonstrations, one, by_sample).to(model.device)
    if first is not None:
        most = min(most, WARM_STEPS)
        with torch.no_grad():
            start.embeddings.copy_(torch.stack([first[name].embeddings for name in start.concepts]))
            start.weights.copy_(torch.stack([first[name].weights for name in start.concepts]) / _scale(settings))
    concepts = invert(model, demonstrations, one, most, tell, start=start)
    for name, concept in concepts.items():
        if concept.modes:
            modes = replace(concept.modes, mixed=True, stretch=even_stretch(len(concept.modes)))
            concepts[name] = replace(concept, modes=modes)
    return concepts


def combined(model: Invertible, weights: Tensor, frames: Tensor | None = None) -> Composition:
    """Composition ``(K, ...)`` of the training concepts with weights ``(training concept,)`` other than 0; at least one of them.

    The frames are those of the training concepts, or ``frames (place, horizon)``.
    """
    used = weights.nonzero()[:, 0] if weights.any() else torch.zeros(1, dtype=torch.int64)
    known = model.compositions(used)
    frames = known.frames if frames is None else frames[None, None]
    every = None if frames is None else frames[:, 0].expand(len(used), -1, -1).cpu()
    return Composition(known.embeddings[:, 0].cpu(), weights[used].clone(), frames=every)


def _combined(model: Invertible, combination: Combination | None, first: Concept) -> Concept:
    """Concept of weights of training concepts; ``UserError`` for a model without a composed denoiser."""
    if combination is None:
        raise UserError("model.form: expected a diffusion model for a combination of training concepts, found another method")
    composition = combined(model, combination.weights)
    origin = replace(first.origin, weights="learned", loss=combination.loss)
    return Concept(composition.embeddings, composition.weights, origin, frames=first.frames)


def _made(model: Invertible, demonstrations: Demonstrations, form: str, first: Concept, variation: float = 0.0) -> Concept:
    """Concept that samples a reference of its demonstrations, with a variation; ``first`` is composed."""
    setting = Setting.of(demonstrations if model.examples is None else model.examples, model.horizon, model.places)
    reference = Reference.of(form, demonstrations, setting, model.horizon, (1 - variation) ** 0.5)
    return replace(first, reference=reference, variation=variation)


def by_skill(
    model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, steps: int, first: Concept, tell: Tell
) -> Concept:
    """The concept in the form with the highest skill, see :class:`~ftl_lightning.igm.forms.skill.LeftOut`.

    The best learned form is mixed with varied or warped demonstrations, which need no learning, in the share with the best score,
    which may be 0 or 1. Samples have the variation of training concepts where the score is better with it.

    Args:
        demonstrations: demonstrations of one concept.
        first: the concept as one set.
    """
    assert model.examples is not None
    if len(demonstrations) < 2:
        return replace(first, choice=Choice(ONE, "there is a single demonstration", {}))
    left, seed = LeftOut(model, demonstrations, model.examples), settings.seed
    usual = 0.0 if model.variations is None else VARIATION
    whole, without = {ONE: first}, dict[str, list[Composition]]()
    combination = Combination.of(model, demonstrations, settings)
    like = first.composition.uncomposed
    references = left.references(like, seed)
    if combination is not None:
        assert combination.folds is not None
        whole[COMBINED] = _combined(model, combination, first)
        folds = zip(left.rows, left.frames, strict=True)
        without[COMBINED] = [combined(model, combination.folds[row], frames) for row, frames in folds]
        alone = torch.zeros_like(combination.weights)
        alone[combination.best] = 1
        references[KNOWN] = left.drawn([combined(model, alone)] * len(left.rows), seed)
    parts = left.parts()
    sets = learned_from(model, demonstrations, left.others, quickly(settings), steps, tell)
    without[ONE] = [sets.row(fold) for fold in range(len(parts))]
    labelled = concatenate([replace(part, concepts=(f"{fold}",) * len(part)) for fold, part in enumerate([demonstrations, *parts])])
    adapted, *others = _adapted(model, labelled, settings.changed(**SKILLED), steps, False, tell, by_sample=True).values()
    whole[ADAPTED] = replace(adapted, origin=replace(first.origin, loss=adapted.origin.loss))
    without[ADAPTED] = [concept.composition for concept in others]
    drawn = {name: left.drawn(without[name], seed, usual) for name in LEARNED if name in without}
    form = min(drawn, key=lambda name: float(drawn[name].score.mean()))
    makers = (VARIED,) if left.setting.places else (VARIED, WARPED)  # a warp would leave the places
    made = {
        (name, share): references[name] if name in references and not share else left.made(name, like, seed, share)
        for share in dict.fromkeys((usual, 0.0))
        for name in makers
    }
    both = {usual: drawn[form], 0.0: left.drawn(without[form], seed) if usual else drawn[form]}
    images = any(values.dtype == torch.uint8 for values in demonstrations.observed.values())
    shares = SHARES[:1] if images else SHARES  # makers do not see images
    mixtures = {key: left.mixed(both[key[1]], each)[: len(shares)] for key, each in made.items()}  # (share, fold)
    maker, variation = min(mixtures, key=lambda key: float(mixtures[key].mean(dim=1).min()))
    mixture = mixtures[maker, variation]
    number = int(mixture.mean(dim=1).argmin())
    share, chosen = round(float(shares[number]), 1), replace(whole[form], variation=variation)
    if form == ONE and share < 1:  # the first one has been stopped early
        chosen = invert(model, demonstrations, _one_set(settings.changed(form=ONE)), steps, tell)[first.origin.name]
        chosen = replace(chosen, variation=variation)
    if share:
        chosen = replace(_made(model, demonstrations, maker, chosen, variation), share=share)
    every = drawn | references | {VARIED: made[VARIED, usual]}
    skills = {name: left.skill(value.score.mean()) for name, value in every.items()}
    rival = max((*references, VARIED), key=lambda name: skills[name])
    beside = f"the best reference, the {rival}, has {skills[rival]:.2f}"
    deformed = "deformed " if variation and maker != VARIED else ""  # varied demonstrations contain it
    called = form if not share else f"{deformed}{maker}" if share == 1 else f"{deformed}{form} and {maker}"
    skills[called] = left.skill(mixture[number].mean())
    numbers = {f"{SKILL}{name}": round(value, 4) for name, value in skills.items()}
    if (known := references.get(KNOWN)) is not None:
        nearer = {name: left.nearer(value, known) for name, value in every.items()}
        mixed = (1 - share, both[variation]), (share, made[maker, variation])
        nearer[called] = sum(part * left.nearer(value, known) for part, value in mixed)
        numbers |= {f"{NEARER}{name}": round(value, 4) for name, value in nearer.items()}
    beside += ", which is higher" if skills[rival] > skills[called] else ""
    measured = f"skill {skills[called]:.2f} ± {left.error(mixture[number]):.2f} on left-out demonstrations"
    because = f"{_because(measured, skills[form], form, called if share == 1 else maker, share)}; {beside}"
    composing = None if COMBINED not in whole or form == COMBINED else (whole[COMBINED].embeddings, whole[COMBINED].weights)
    keep = composing is not None and float(drawn[COMBINED].score.mean()) <= float(drawn[ONE].score.mean())
    return replace(chosen, choice=Choice(called, because, numbers), composing=composing if keep else None)


def _because(skill: str, alone: float, form: str, made: str, share: float) -> str:
    """Reason for a form of :func:`by_skill`: its ``skill`` in words, and that of the learned ``form`` ``alone``."""
    if share == 1:
        return f"no learned form adds to {made} ({skill}, {form} alone {alone:.2f})"
    return f"{skill}, {alone:.2f} without the {share:.0%} of samples that are {made}, not learned" if share else skill


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
        """Whether a set in the span of the training embeddings has about the leave-one-out loss of a free set."""
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
    most = {name: 0 if own < NEARLY else FEWER if own < CLEAR else FOLDS for name, (own,) in losses.items()}
    left = {name: rows[:: -(-len(rows) // most[name])] if most[name] and len(rows) > 2 else [] for name, rows in every.items()}
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
    alone = Composition(concept.embeddings[None], concept.weights[None] / _scale(settings)).to(model.device)
    return float(relative_losses(model, demonstrations, alone, settings).mean())


def _scale(settings: InversionSettings) -> float:
    """Factor of a concept's guidance weights after learning."""
    return settings.weights.scale if settings.omega == "learned" else 1.0


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
    enough = [name for name in several if name not in rest]
    warm = [name for name in enough if shares[name].own < NEARLY and settings.embeddings.off_span == 1]
    for names, start in ((warm, several), ([name for name in enough if name not in warm], None)):
        if names:
            for name, concept in _adapted(model, _of(demonstrations, names), settings, steps, False, tell, first=start).items():
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
    losses = f"{shares.own:.2f} of the unconditional loss"
    if shares.left_out is not None:
        losses = f"{shares.left_out:.2f} of the unconditional loss on left-out demonstrations, {shares.own:.2f} on its own"
    if not shares.suffices:
        return MODES, f"one set of embeddings does not fit the demonstrations (loss {losses}), so samples stay close to them"
    because, spread = f"one set of embeddings fits the demonstrations (loss {losses})", qualities[ADAPTED].spread
    if MIXED in qualities and (mixed := qualities[MIXED].spread) > spread:
        return MIXED, f"{because}; its samples spread {spread:.2f} of what the demonstrations do, mixtures {mixed:.2f}"
    return ADAPTED, f"{because}; samples spread {spread:.2f} of what the demonstrations do"
