"""The forms that a concept may have, and how one is chosen by what its demonstrations say."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from ftl_lightning.concepts.concept import Choice, Concept
from ftl_lightning.concepts.modes import even_stretch
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion import check_settings, compared, invert
from ftl_lightning.learning.inversion_settings import ADAPTED, AUTO, MIXED, MODES, ONE, PAPER, UNSAID, InversionSettings
from ftl_lightning.learning.quality import Quality, measured
from ftl_lightning.learning.text_concept_model import TextConceptModel

RANK, RATE, ADAPTER_STEPS = 1, 3e-3, 120
"""Of adapters and of their learning, where the settings name none."""
MODE_SAMPLES = 16
"""Noised demonstrations a step of a mode that is learned without an adapter."""
FOLDS, FOLD_SAMPLES, FOLD_STEPS = 5, 16, 150
"""Concepts that leave a demonstration out, at most, and noised demonstrations a step and steps of each."""
TOLERANCE = 0.01
"""Of the stopping rule, where the settings have none."""
BOTH, OWN = 2.03, 0.8
"""One set suffices if its losses on its own and on left-out demonstrations, as shares of the empty concept's, are together at most
the first, or that on its own at most the second. Chosen on relations that pretraining does not show, see docs/experiments-forms.md.
"""
NARROW, WIDE = 0.85, 0.9
"""Mixtures take the place of one set whose samples spread less than the first of what the demonstrations do; those that spread more
than the second are stretched less."""
SPAN_LOSS = 1.03
"""A concept is composed from a set in the span of the training concepts if sets there have at most so many times the loss of free
ones on left-out demonstrations."""

Tell = Callable[[float], None]


def learn(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Tell = lambda loss: None,
) -> dict[str, Concept]:
    """Learn every concept of some demonstrations in the form that the settings name, without a trainer.

    Args:
        model: frozen.
        demonstrations: with concept texts, which name the concepts.
        settings: how.
        steps: of gradient descent.
        tell: called with the mean loss after each step.
    """
    check_settings(model, settings)
    first = invert(model, demonstrations, first_settings(settings), steps, tell)
    return formed(model, demonstrations, settings, steps, first, tell)


def first_settings(settings: InversionSettings) -> InversionSettings:
    """What is learned first: what the settings say in the paper's form, else one set without an adapter."""
    if settings.form in (UNSAID, PAPER):
        return settings
    return _one_set(settings)


@torch.enable_grad()
def formed(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    first: dict[str, Concept],
    tell: Tell = lambda loss: None,
) -> dict[str, Concept]:
    """Concepts in the form that the settings name, and where that is to be chosen, in the one that the demonstrations ask for.

    Gradients are made here, whatever the caller's mode is: a trainer turns them off at the end of learning.

    Args:
        model, demonstrations, settings, steps, tell: as of :func:`learn`.
        first: what was learned by :func:`first_settings`.
    """
    if settings.form in (UNSAID, PAPER, ONE):
        return first
    if settings.form == MODES:
        return _with_modes(model, demonstrations, settings, steps, tell)
    if settings.form in (ADAPTED, MIXED):
        adapted = _adapted(model, demonstrations, settings, steps, tell)
        return {name: forms[settings.form] for name, forms in adapted.items()}
    shares = _loss_shares(model, demonstrations, settings, steps, first, tell)
    enough = [name for name, share in shares.items() if share.suffices]
    span: Mapping[str, Concept] = {}
    if composable := [name for name, share in shares.items() if share.composes]:
        inside = _one_set(settings, off_span=0.0, restarts=1)
        span = invert(model, _of(demonstrations, composable), inside, steps, tell)
    forms = {name: {ONE: concept} for name, concept in first.items()}
    if enough:
        for name, more in _adapted(model, _of(demonstrations, enough), settings, steps, tell).items():
            forms[name] |= more
    if rest := [name for name in shares if name not in enough]:
        for name, concept in _with_modes(model, _of(demonstrations, rest), settings, steps, tell).items():
            forms[name] |= {MODES: concept}
    return _chosen(model, demonstrations, settings.seed, forms, shares, span)


def _one_set(settings: InversionSettings, **changes: Any) -> InversionSettings:
    """One set without an adapter; where the form is to be chosen it is learned for its loss alone, and stops by itself."""
    if settings.form == AUTO and settings.budget.tolerance is None:
        changes["tolerance"] = TOLERANCE
    return replace(settings, form=PAPER).changed(modes=1, adapter=0, **changes)


def _with_modes(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, steps: int, tell: Tell
) -> dict[str, Concept]:
    """Concepts of one set for each demonstration, learned in all steps: what a sample is like depends on them alone."""
    changes = {"modes": "each", "mode_samples": MODE_SAMPLES, "adapter": 0, "tolerance": None, "restarts": 1}
    return invert(model, demonstrations, replace(settings, form=PAPER).changed(**changes), steps, tell)


def _adapted(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, steps: int, tell: Tell
) -> dict[str, dict[str, Concept]]:
    """Of every concept the forms with an adapter, by name. Of a single demonstration there are no modes to mix."""
    own = settings.adapter
    rank, rate = (own.rank, own.learning_rate) if own.rank else (RANK, RATE)
    changes = {"modes": "each", "adapter": rank, "adapter_learning_rate": rate, "tolerance": None, "restarts": 1}
    adapted = replace(settings, form=PAPER).changed(**changes)
    found = {}
    for name, concept in invert(model, demonstrations, adapted, min(steps, ADAPTER_STEPS), tell).items():
        modes = concept.modes
        mixed = modes and replace(modes, mixed=True, stretch=even_stretch(len(modes)))
        found[name] = {ADAPTED: replace(concept, modes=None), MIXED: replace(concept, modes=mixed)}
    return found


@dataclass(frozen=True)
class _Shares:
    """Losses of one set of embeddings, as shares of the empty concept's on the same demonstrations.

    Attributes:
        own: on the demonstrations that it was learned from.
        left_out: on demonstrations that it was not learned from, the mean over them; ``None`` of fewer than three.
        in_span: the same of sets in the span of the training concepts; ``None`` for a model whose concepts are no texts, too.
    """

    own: float
    left_out: float | None = None
    in_span: float | None = None

    @property
    def suffices(self) -> bool:
        """Whether one set says enough of what the demonstrations have in common."""
        return self.own <= OWN or (self.left_out is not None and self.own + self.left_out <= BOTH)

    @property
    def composes(self) -> bool:
        """Whether a set in the span explains left-out demonstrations about as well as a free one."""
        return self.left_out is not None and self.in_span is not None and self.in_span <= SPAN_LOSS * self.left_out

    @property
    def numbers(self) -> dict[str, float]:
        """By name, so far as there are."""
        named = {"loss, own": self.own, "loss, left out": self.left_out, "loss, left out, in span": self.in_span}
        return {name: value for name, value in named.items() if value is not None}


def _loss_shares(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    first: Mapping[str, Concept],
    tell: Tell,
) -> dict[str, _Shares]:
    """What one set of every concept says of its own demonstrations and of left-out ones."""
    known: list[Demonstrations] = []
    held: list[Demonstrations] = []
    texts: dict[str, list[str]] = {name: [] for name in first}
    for name in first:
        own = demonstrations.select(name)
        for row in range(0, len(own), -(-len(own) // FOLDS)) if len(own) > 2 else ():
            text = f"{name} without demonstration {row + 1}"
            known.append(_named(own, [other for other in range(len(own)) if other != row], text))
            held.append(_named(own, [row], text))
            texts[name].append(text)
    left_out: list[dict[str, float]] = []
    for off_span in (settings.embeddings.off_span, 0.0)[: 1 + isinstance(model, TextConceptModel)] if known else ():
        learning = _one_set(settings, samples=FOLD_SAMPLES, restarts=1, off_span=off_span)
        folds = invert(model, concatenate(known), learning, min(steps, FOLD_STEPS), tell)
        left_out.append(compared(model, concatenate(held), folds, settings.loss.kind))
    own_shares = compared(model, demonstrations, first, settings.loss.kind)
    return {
        name: _Shares(own_shares[name], *(sum(found[text] for text in some) / len(some) for found in left_out if some))
        for name, some in texts.items()
    }


def _of(demonstrations: Demonstrations, concepts: Sequence[str]) -> Demonstrations:
    """The demonstrations of some concepts."""
    return demonstrations.rows([row for row, name in enumerate(demonstrations.concepts) if name in concepts])


def _named(demonstrations: Demonstrations, rows: Sequence[int], text: str) -> Demonstrations:
    """Some demonstrations under another concept's name."""
    return replace(demonstrations.rows(rows), concepts=(text,) * len(rows))


def _chosen(
    model: ConceptModel,
    demonstrations: Demonstrations,
    seed: int,
    forms: Mapping[str, Mapping[str, Concept]],
    shares: Mapping[str, _Shares],
    span: Mapping[str, Concept],
) -> dict[str, Concept]:
    """Of every concept the form that its demonstrations ask for, with what was measured, and what it is composed from."""
    found = {}
    for name, candidates in forms.items():
        own = demonstrations.select(name)
        if len(own) < 2:
            found[name] = replace(candidates[ONE], choice=Choice(ONE, "there is a single demonstration", {}))
            continue
        qualities = measured(model, own, candidates, seed)
        if MIXED in candidates and (wide := qualities[MIXED].spread) > WIDE:
            candidates = {**candidates, MIXED: _stretched(candidates[MIXED], WIDE / wide)}
            qualities |= measured(model, own, {MIXED: candidates[MIXED]}, seed)
        form, because = _choice(shares[name], qualities)
        numbers = shares[name].numbers
        numbers |= {f"{key}, {kind}": value for kind, one in qualities.items() for key, value in one.numbers.items()}
        composing = None
        if shares[name].composes and name in span:
            composing, because = (span[name].embeddings, span[name].weights), f"{because}; composed in the training span"
        choice = Choice(form, because, {key: round(value, 4) for key, value in numbers.items()})
        found[name] = replace(candidates[form], choice=choice, composing=composing)
    return found


def _stretched(concept: Concept, factor: float) -> Concept:
    """A concept of modes whose mixtures are stretched so many times as much, though not below plain ones."""
    modes = concept.modes
    return replace(concept, modes=modes and replace(modes, stretch=max(factor * modes.stretch, 1.0)))


def _choice(shares: _Shares, qualities: Mapping[str, Quality]) -> tuple[str, str]:
    """The form, and why."""
    told = f"{shares.own:.2f} of the empty concept's"
    if shares.left_out is not None:
        told = f"{shares.left_out:.2f} of the empty concept's on left-out demonstrations, {shares.own:.2f} on its own"
    if not shares.suffices:
        return MODES, f"one set of embeddings does not explain the demonstrations (loss {told}), so samples stay close to them"
    because = f"one set of embeddings explains the demonstrations (loss {told})"
    spread, mixed = qualities[ADAPTED].spread, qualities[MIXED].spread
    if spread < min(NARROW, mixed):
        return MIXED, f"{because}; its samples spread {spread:.2f} of what the demonstrations do, mixtures {mixed:.2f}"
    return ADAPTED, f"{because}; samples spread {spread:.2f} of what the demonstrations do"
