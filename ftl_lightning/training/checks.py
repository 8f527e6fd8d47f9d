"""Checks of demonstrations and learned concepts against a model."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.check import Finding, axes, check
from ftl_lightning.data.demonstrations import Demonstrations, paths_of
from ftl_lightning.data.enough import SEVERAL, Enough, Outliers
from ftl_lightning.data.features import moved
from ftl_lightning.data.references import NAMES
from ftl_lightning.igm.concept import KNOWN, Concept
from ftl_lightning.igm.explanation import formula
from ftl_lightning.igm.forms.choice import LEARNED, combined, learn
from ftl_lightning.igm.forms.combination import Combination
from ftl_lightning.igm.forms.leave_one_out import LeaveOneOut, find_outlier, leave_one_out, relative_losses
from ftl_lightning.igm.inversion import Tell
from ftl_lightning.igm.settings import AUTO, InversionSettings
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.progress import bar
from ftl_lightning.services.shipped import MODELS
from ftl_lightning.services.text import alike, counted
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import find_model

MARGIN, MOST_OF = 0.97, 0.8
"""Maximum loss, relative to the unconditional loss, of a demonstration that a training concept fits; minimum
share of fitted demonstrations for a known task.
"""
MOST_FAULTS = 6
"""Maximum number of reported findings, most severe first."""
COVERED_BY_A_PLAN = 0.8
"""Minimum share of the longest demonstration in a plan, for windows of demonstrations to need no note."""
EXCESS = 0.05
"""Tolerated excess, as a share of half a column's pretraining range."""
DIFFERS = "differs from the others more than is usual within a concept; another concept?"
MANY, OUTSIDE = 0.25, 3.0
"""Warning thresholds: share of values outside the range, and maximum normalised value."""


@dataclass(frozen=True)
class Known:
    """The training concept that fits demonstrations best.

    Attributes:
        text: text of the training concept.
        losses: loss of each demonstration ``(demo,)``, relative to the unconditional loss.
        own: whether the model is of a user's data, where a low loss alone does not tell similar kinds apart.
    """

    text: str
    losses: tuple[float, ...]
    own: bool = False

    @property
    def count(self) -> int:
        """Number of demonstrations that it fits."""
        return sum(loss <= MARGIN for loss in self.losses)

    @property
    def clear(self) -> bool:
        """Whether it fits nearly all demonstrations, and their mean loss."""
        return self.count >= MOST_OF * len(self.losses) and sum(self.losses) / len(self.losses) <= MARGIN

    def __str__(self) -> str:
        mean = sum(self.losses) / len(self.losses)
        if self.own:
            return f"known: by its loss, {mean:.2f} of the unconditional loss, {self.text!r} is the nearest training concept"
        best = f"{self.text!r} ({self.count} of {len(self.losses)}, loss {mean:.2f} of the unconditional loss)"
        if self.clear:
            return f"known: the model already fits them as {best}; if that is all you mean, no learning is needed"
        return f"known: no training concept fits them all; the best is {best}"


@dataclass(frozen=True)
class Check:
    """Result of checking a concept's demonstrations.

    Attributes:
        name: name of the concept.
        demonstrations: checked demonstrations.
        findings: faults and notes, errors and warnings first.
        known: the training concept that fits them best; ``None`` without a model.
        left_out: leave-one-out losses; ``None`` without learning.
        combination: report on weighted sums of training concepts; empty without a model of a user's data.
        enough: whether the demonstrations suffice, by skill; ``None`` for fewer than three, or with a model of a shipped domain.
        by_loss: whether losses of left-out demonstrations decide instead.
    """

    name: str
    demonstrations: Demonstrations
    findings: tuple[Finding, ...]
    known: Known | None = None
    left_out: LeaveOneOut | None = None
    combination: str = ""
    enough: Enough | None = None
    by_loss: bool = True

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Likely faults."""
        return tuple(finding for finding in self.findings if finding.severity != "note")

    def __str__(self) -> str:
        lengths, columns = self.demonstrations.lengths, self.demonstrations.states.shape[2]
        shortest, longest = int(lengths.min()), int(lengths.max())
        steps = counted(longest, "step") if shortest == longest else f"{shortest} to {longest} steps"
        lines = [f"{self.name}: {counted(len(lengths), 'demonstration')} of {steps}, {counted(columns, 'column')}"]
        if not self.warnings:
            lines.append("  no faults: no gaps, jumps, stills, duplicates or outliers")
        findings = [f"  {'' if finding.severity == 'note' else f'{finding.severity}: '}{finding}" for finding in self.findings]
        rest = len(findings) - MOST_FAULTS
        lines += findings if rest <= 0 else [*findings[:MOST_FAULTS], f"  and {rest} more"]
        lines += [] if self.known is None else [f"  {self.known}"]
        lines += [f"  {self.combination}"] if self.combination else []
        lines += (
            []
            if self.left_out is None
            else [f"  {line}" for line in self.left_out.lines(self.by_loss and self.enough is None) if line]
        )
        lines += [] if self.enough is None else [f"  {self.enough}"]
        return "\n".join(lines)


def known_as(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, tell: Callable[[int], None]
) -> Known:
    """The training concept with the lowest mean loss."""
    losses = relative_losses(model, demonstrations, model.compositions(), settings, tell)
    best = int(losses.mean(dim=1).argmin())
    return Known(model.config.training_concepts[best], tuple(losses[best].tolist()), model.examples is not None)


def fit_findings(model: ConceptModel, demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """Findings about the length and scale of demonstrations."""
    longer, longest = longer_than_plans(demonstrations, model), int(demonstrations.lengths.max())
    findings = [Finding(longer, "note")] if longer else []
    if longest < model.window and not demonstrations.observed:
        message = f"demonstrations of up to {longest} steps are shorter than the model's plans of {model.window}"
        findings.append(Finding(f"{message}; their last state is repeated", "note"))
    return (*findings, *scale_findings(model, demonstrations))


def warnings_of(model: ConceptModel, demonstrations: Demonstrations) -> tuple[str, ...]:
    """Lines about likely faults of one concept's demonstrations."""
    findings = (*check(demonstrations), *scale_findings(model, demonstrations))
    return tuple(str(finding) for finding in findings if finding.severity != "note")


def notes_of(model: ConceptModel, demonstrations: Demonstrations) -> Iterator[str]:
    """Lines about names that are alike, demonstrations that are longer than plans, and likely faults of each concept's
    demonstrations.
    """
    yield from alike(demonstrations.concepts)
    yield from map(str, axes(demonstrations))
    if longer := longer_than_plans(demonstrations, model):
        yield longer
    rows_of = demonstrations.rows_of
    for name, rows in rows_of.items():
        for note in warnings_of(model, demonstrations.rows(rows)):
            yield note if len(rows_of) == 1 else f"{name}: {note}"


def check_with(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int = 0,
    found: tuple[Finding, ...] = (),
    progress: bool = False,
) -> Check:
    """Check demonstrations of one concept with a model; ``UserError`` for a model without inversion.

    Args:
        demonstrations: demonstrations of one concept that fit the model.
        steps: maximum number of gradient steps on subsets; 0 to learn nothing.
    """
    model.check_settings(settings)
    name = demonstrations.concepts[0]
    faults = (*found, *check(demonstrations), *fit_findings(model, demonstrations))
    nothing = nullcontext(lambda *_: None)
    titled, total = f"{name}: training concepts", len(model.config.training_concepts)
    with bar(titled, total, lines=False) if progress else nothing as advance:
        known = known_as(model, demonstrations, settings, advance)
    own, left, learned, outlier = model.examples, None, None, None
    if own is not None and (outlier := Outliers(own, model.horizon, model.places).outlier(demonstrations)) is not None:
        faults = (*faults, Finding(DIFFERS, rows=(outlier,)))
    if steps and len(demonstrations) > 1:
        find = find_outlier if own is None else lambda losses: outlier
        with bar(f"{name}: learning from some", steps) if progress else nothing as advance:
            left = leave_one_out(model, demonstrations, settings, steps, lambda loss: advance(1, f"loss {loss:.3g}"), find)
        with bar(f"{name}: forms", None, lines=False) if progress else nothing as advance:
            learned = None if own is None else _best_learned(model, demonstrations, settings, steps, lambda loss: advance(1))
    enough = None if own is None else Enough.of(demonstrations, model.horizon, own, learned, faulty(faults), model.places)
    ordered = tuple(sorted(faults, key=lambda finding: finding.severity == "note"))
    return Check(name, demonstrations, ordered, known, left, combination_line(model, demonstrations, settings), enough, own is None)


def several_concepts(model: ConceptModel, demonstrations: Demonstrations, outliers: Outliers) -> list[str]:
    """Warnings that demonstrations do not belong to one concept, with a model of a user's data."""
    enough = Enough.of(demonstrations, model.horizon, model.examples, followed=model.places)
    if enough is not None and enough.several:
        return [SEVERAL.capitalize()]
    outlier = outliers.outlier(demonstrations)
    return [] if outlier is None else [f"Demonstration {outlier + 1} {DIFFERS}"]


def faulty(findings: Iterable[Finding]) -> set[int]:
    """Demonstrations that are likely faulty; of copies, all but the first."""
    return {row for finding in findings if finding.severity != "note" for row in finding.rows[len(finding.rows) > 1 :]}


def _best_learned(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, steps: int, tell: Tell
) -> tuple[str, float] | None:
    """The learned form with the highest skill, if it is better than every reference, and its skill."""
    (concept,) = learn(model, demonstrations, settings.changed(form=AUTO), steps, tell).values()
    skills = {} if concept.choice is None else concept.choice.skills
    named = [name for name in skills if name in (*LEARNED, *NAMES, KNOWN)]
    best = max(named, key=lambda name: skills[name], default="")
    return (best, skills[best]) if best in LEARNED else None


def combination_line(model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings) -> str:
    """Report on the best weighted sum of training concepts, by the loss of left-out demonstrations; for a user's data."""
    combination = None if model.examples is None else Combination.of(model, demonstrations, settings)
    if combination is None or combination.left_out is None:
        return ""
    sets = combined(model, combination.weights)
    text = formula(sets.embeddings, sets.weights, model.config.training_concepts, model.training_embeddings.cpu())
    loss = float(combination.left_out.mean())
    verdict = "fits" if loss <= MARGIN else "does not fit"
    unseen = f"demonstrations that its weights were not learned from (loss {loss:.2f} of the unconditional loss)"
    return f"sum: {short(text, 120)} {verdict} {unseen}"


def longer_than_plans(demonstrations: Demonstrations, model: ConceptModel) -> str:
    """Note about the use of demonstrations that are longer than the model's plans; empty without any.

    None is needed for closed-loop domains with observations at every time, where a plan may start at any time, and in domains where
    a plan covers at least :data:`COVERED_BY_A_PLAN` of the longest demonstration.
    """
    window, plans = model.window, model.domain.plans
    longest, shortest = int(demonstrations.lengths.max()), int(demonstrations.lengths.min())
    if longest <= window:
        return ""
    start = f"demonstrations of {'' if longest == shortest else 'up to '}{longest} steps are"
    if first := set(demonstrations.observed) - set(demonstrations.per_step):
        names = ", ".join(map(repr, sorted(first)))
        return (
            f"{start} cut to the model's horizon of {window}: the first {window} steps are learned from, "
            f"as {names} is known at the first time alone"
        )
    executed = bool(demonstrations.observed) and model.domain.closed_loop is not None and plans.exponent(window) == 1
    if executed or (model.examples is None and window >= COVERED_BY_A_PLAN * longest):
        return ""
    # The same exponent decides where windows start, see Demonstrations.starts.
    where = "anywhere" if plans.exponent(window) == 1 else "anywhere, mostly early"
    return (
        f"{start} longer than the model's horizon of {window}: they are learned from in windows of {window} steps, which start "
        f"{where}; a plan has {model.config.horizon} steps"
    )


@torch.no_grad()
def scale_findings(model: ConceptModel, demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """Warn if many values of states or observed vectors are outside the pretraining range, or some are far outside."""
    return tuple(_scale(model, demonstrations))


def outside(model: ConceptModel, demonstrations: Demonstrations) -> Tensor:
    """Normalised states ``(state, time)``, in consecutive windows from each demonstration's start."""
    rows, starts = [], []
    for row, length in enumerate(demonstrations.lengths.tolist()):
        first = set(demonstrations.observed) - set(demonstrations.per_step)
        begins = [0] if first else list(range(0, max(length - model.window, 0) + 1, max(model.window, 1)))
        rows += [row] * len(begins)
        starts += begins
    states, observed = demonstrations.windows(torch.tensor(rows), torch.tensor(starts), model.window)
    frames = model.frames_of(replace(demonstrations, concepts=("",) * len(demonstrations)))
    encoded: Tensor = model.encode(states.to(model.device), moved(observed, model.device), frames)
    return encoded.flatten(0, 1).T.cpu()


def _scale(model: ConceptModel, demonstrations: Demonstrations) -> Iterator[Finding]:
    columns, view = model.domain.plans.columns, model.view
    values = outside(model, demonstrations).abs()
    columns = view.columns if view is not None and view.columns else columns
    named = view is None or view.same_columns or bool(view.columns)
    names = columns if named and len(columns) == len(values) else [f"{column} of the model's view" for column in range(len(values))]
    yield from _range_finding("states", values, names)
    vectors = model.vectors(moved(demonstrations.initial_states.observed, model.device))
    if vectors is not None:
        numbers = [f"number {number}" for number in range(vectors.shape[1])]
        yield from _range_finding("observed vectors", vectors.abs().T.cpu(), numbers)
    if named and len(columns) == len(values):
        low, high = model.normalization.low.cpu(), model.normalization.high.cpu()
        every = torch.cat(paths_of(demonstrations))
        every = view.encode(every, {}) if view is not None and view.columns else every
        resolution = max(model.domain.plans.resolution, 1e-3)
        differs = (every - low).abs().amax(dim=0) > resolution * low.abs().clamp(min=1)
        lost = [name for name, hidden in zip(columns, ((high <= low) & differs).tolist(), strict=True) if hidden]
        if lost:
            text = short(", ".join(lost), 60)
            yield Finding(f"scale: what is different here was constant in pretraining, so the model does not see it: {text}")


def _range_finding(what: str, values: Tensor, names: "list[str] | tuple[str, ...]") -> Iterator[Finding]:
    beyond = values > 1 + EXCESS
    share, worst = float(beyond.float().mean()), beyond.float().mean(dim=1)
    column = int(worst.argmax()) if float(values.max()) <= OUTSIDE else int(values.amax(dim=1).argmax())
    most = float(values[column].max())
    message = f"scale: {100 * share:.0f} % of the {what} are outside of the range seen in pretraining"
    if beyond.any():
        message += f", most in {short(names[column], 40)} ({100 * float(worst[column]):.0f} %, up to {most:.1f} times the range)"
    yield Finding(message, "warning" if share > MANY or most > OUTSIDE else "note")


def _model_of(model_hash: str) -> str:
    """Where a concept's model is, or what to do."""
    try:
        return f"its model is {find_model(model_hash, (Path('pretrained'), Path('logs'), MODELS))}"
    except UserError:
        return "give its own model, or learn it again"


def check_concept(model: ConceptModel, concept: Concept, path: str | Path) -> None:
    """Refuse a learned concept of another model; ``UserError`` if encoder, domain, pretrained model or sizes differ."""
    of_model = {"encoder": model.config.encoder, "domain": model.config.domain, "pretrained": model.hash}
    for key, expected in of_model.items():
        value, wanted = getattr(concept.origin, key), f"{expected!r} (the pretrained model's)"
        if value != expected:
            advice = _model_of(concept.origin.pretrained)
            raise UserError(f"{path}: key {key!r}: expected {wanted}, found {short(value)!r}; {advice}")
    with about(path):
        model.check_sizes(concept)
