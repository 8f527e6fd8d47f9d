"""The forms that a concept may have, and how one is chosen by what its demonstrations say."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ftl_lightning.concepts.concept import Choice, Concept
from ftl_lightning.concepts.modes import even_stretch
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.demonstrations.features import moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion import compared, invert
from ftl_lightning.learning.inversion_settings import ADAPTED, MIXED, MODES, ONE, PAPER, UNSAID, InversionSettings
from ftl_lightning.learning.quality import Quality
from ftl_lightning.learning.text_concept_model import TextConceptModel
from ftl_lightning.seeding import generator, task_key

RANK, RATE, ADAPTER_STEPS = 1, 3e-3, 120
"""Of adapters and of their learning, where the settings name none."""
SPAN = "span"
"""One set in the span of the training concepts, which composes best."""
MODE_SAMPLES = 16
"""Noised demonstrations a step of a mode that is learned without an adapter."""
FOLDS, FOLD_SAMPLES = 5, 16
"""Concepts that leave a demonstration out, at most, and noised demonstrations a step of each."""
GENERATED = 40
"""Samples of a form that are measured."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""How they are generated: quickly, and as widely as the model does."""
LEFT_OUT, OWN = 1.17, 0.8
"""One set suffices if its loss on left-out demonstrations is at most the first, or that on its own at most the second, as shares of
the empty concept's. Chosen on relations that pretraining does not show, see docs/experiments-forms.md."""
NARROW = 0.7
"""Mixtures take the place of one set whose samples spread less than this share of the demonstrations."""

STRAY = 1.65
"""A concept is composed from its set in the span of the training concepts, unless samples of that stray farther than so many
standard deviations from those of the chosen form, in root mean square, in any column at any time."""
LEAST = 0.05
"""Standard deviation that is told apart, of columns between -1 and 1."""

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
    first = invert(model, demonstrations, first_settings(settings), steps, tell)
    return formed(model, demonstrations, settings, steps, first, tell)


def first_settings(settings: InversionSettings) -> InversionSettings:
    """What is learned first: what the settings say in the paper's form, else one set without an adapter."""
    if settings.form in (UNSAID, PAPER):
        return settings
    return replace(settings, form=PAPER).changed(modes=1, adapter=0)


def formed(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    first: dict[str, Concept],
    tell: Tell = lambda loss: None,
) -> dict[str, Concept]:
    """Concepts in the form that the settings name, and where that is to be chosen, in the one that the demonstrations ask for.

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
    span: Mapping[str, Concept] = {}
    if isinstance(model, TextConceptModel):
        changes = {"modes": 1, "adapter": 0, "off_span": 0.0, "restarts": 1}
        span = invert(model, demonstrations, replace(settings, form=PAPER).changed(**changes), steps, tell)
    enough = [name for name, share in shares.items() if share.suffices]
    forms = {name: {ONE: concept} for name, concept in first.items()}
    if enough and model.adaptable():
        some = demonstrations.rows([row for row, name in enumerate(demonstrations.concepts) if name in enough])
        for name, more in _adapted(model, some, settings, steps, tell).items():
            forms[name] |= more
    if len(enough) < len(shares):
        some = demonstrations.rows([row for row, name in enumerate(demonstrations.concepts) if name not in enough])
        for name, concept in _with_modes(model, some, settings, steps, tell).items():
            forms[name] |= {MODES: concept}
    return _chosen(model, demonstrations, settings.seed, forms, shares, span)


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
    """

    own: float
    left_out: float | None

    @property
    def suffices(self) -> bool:
        """Whether one set says enough of what the demonstrations have in common."""
        return self.own <= OWN or (self.left_out is not None and self.left_out <= LEFT_OUT)


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
    rest: dict[str, list[str]] = {}
    for name in first:
        own = demonstrations.select(name)
        for row in range(0, len(own), -(-len(own) // FOLDS)) if len(own) > 2 else ():
            text = f"{name} without demonstration {row + 1}"
            known.append(_named(own, [other for other in range(len(own)) if other != row], text))
            held.append(_named(own, [row], text))
            rest.setdefault(name, []).append(text)
    own_shares = compared(model, demonstrations, first)
    if not known:
        return {name: _Shares(own_shares[name], None) for name in first}
    one = replace(settings, form=PAPER).changed(modes=1, adapter=0, samples=FOLD_SAMPLES, restarts=1)
    folds = invert(model, concatenate(known), one, steps, tell)
    left_out = compared(model, concatenate(held), folds)
    means = {name: sum(left_out[text] for text in texts) / len(texts) for name, texts in rest.items()}
    return {name: _Shares(own_shares[name], means.get(name)) for name in first}


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
        inside = {SPAN: span[name]} if name in span else {}
        samples, known = generated(model, own, {**candidates, **inside}, seed)
        qualities = {form: Quality.of(samples[form], known) for form in candidates}
        form, because = _choice(shares[name], qualities)
        numbers = {"loss, own": shares[name].own}
        numbers |= {} if (left := shares[name].left_out) is None else {"loss, left out": left}
        numbers |= {f"{key}, {kind}": value for kind, one in qualities.items() for key, value in one.numbers.items()}
        composing = None
        if inside:
            numbers["stray, span"] = stray(samples[SPAN], samples[form])
            if numbers["stray, span"] <= STRAY:
                composing, because = (span[name].embeddings, span[name].weights), f"{because}; composed in the training span"
        choice = Choice(form, because, {key: round(value, 4) for key, value in numbers.items()})
        found[name] = replace(candidates[form], choice=choice, composing=composing)
    return found


def stray(samples: Tensor, others: Tensor) -> float:
    """How far samples ``(sample, horizon, state)`` are at most, in any column at any time, from the mean of others, in the others'
    standard deviations, in root mean square; 1 for samples that are like the others.
    """
    spread = others.std(dim=0).clamp(min=LEAST)
    return float(((samples - others.mean(dim=0)).square().mean(dim=0).sqrt() / spread).max())


def _choice(shares: _Shares, qualities: Mapping[str, Quality]) -> tuple[str, str]:
    """The form, and why."""
    told = f"{shares.own:.2f} of the empty concept's"
    if shares.left_out is not None:
        told = f"{shares.left_out:.2f} of the empty concept's on left-out demonstrations, {shares.own:.2f} on its own"
    if not shares.suffices:
        return MODES, f"one set of embeddings does not explain the demonstrations (loss {told}), so samples stay close to them"
    because = f"one set of embeddings explains the demonstrations (loss {told})"
    if ADAPTED not in qualities:
        return ONE, because
    spread, mixed = qualities[ADAPTED].spread, qualities[MIXED].spread
    if spread < min(NARROW, mixed):
        return MIXED, f"{because}; its samples spread {spread:.2f} of what the demonstrations do, mixtures {mixed:.2f}"
    return ADAPTED, f"{because}; samples spread {spread:.2f} of what the demonstrations do"


def generated(
    model: ConceptModel, demonstrations: Demonstrations, concepts: Mapping[str, Concept], seed: int
) -> tuple[dict[str, Tensor], Tensor]:
    """Samples of some concepts by name, and demonstrations, as the model's network sees them, which compares columns of any unit.

    Args:
        model: that generates them.
        demonstrations: from whose initial states samples start.
        concepts: by name.
        seed: of the samples.

    Returns:
        ``(GENERATED, horizon, state)`` each, and ``(demo, horizon, state)``.
    """
    names, horizon = list(concepts), model.config.horizon
    rows = torch.arange(GENERATED) % len(demonstrations)
    seen = moved(demonstrations.rows(rows.tolist()).initial_states.observed, model.device)
    together = {key: value.repeat(len(names), *(1,) * (value.dim() - 1)) for key, value in seen.items()}
    draws = [generator("cpu", seed, 4, task_key(name)) for name in names]
    sampling = replace(SAMPLING, steps=min(SAMPLING.steps, model.max_steps or SAMPLING.steps))
    plans = model.sample([concepts[name].composition.to(model.device) for name in names], GENERATED, sampling, draws, together)
    every = torch.arange(len(demonstrations))
    states, observed = demonstrations.windows(every, torch.zeros_like(every), horizon)
    known = model.encode(states.to(model.device), moved(observed, model.device)).cpu()
    return {name: model.encode(own, seen).cpu() for name, own in zip(names, plans, strict=True)}, known
