"""Whether demonstrations of a concept suffice, and which of them is odd: faults, scale, what the model knows, what is left out."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.check import check
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.finding import Finding
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion import check_settings
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.learning.leave_one_out import LeaveOneOut, leave_one_out
from ftl_lightning.learning.longer import longer_than_plans
from ftl_lightning.learning.relative_loss import relative_losses
from ftl_lightning.learning.scale_check import scale_findings
from ftl_lightning.progress import bar
from ftl_lightning.representation import counted

MARGIN, MOST_OF = 0.97, 0.8
"""A training concept explains a demonstration where its loss is at most so much of the empty concept's; it is known where it
explains this share of them, and their mean.
"""
MOST_FAULTS = 6
"""Findings that are told of a concept, the gravest first."""


@dataclass(frozen=True)
class Known:
    """The training concept that explains demonstrations best.

    Attributes:
        text: of the training concept.
        losses: of each demonstration by the empty concept's ``(demo,)``.
    """

    text: str
    losses: tuple[float, ...]

    @property
    def count(self) -> int:
        """How many it explains better than the empty concept by a clear margin."""
        return sum(loss <= MARGIN for loss in self.losses)

    @property
    def clear(self) -> bool:
        """Whether it explains (nearly) all."""
        mean = sum(self.losses) / len(self.losses)
        return self.count >= MOST_OF * len(self.losses) and mean <= MARGIN

    def __str__(self) -> str:
        mean = sum(self.losses) / len(self.losses)
        told = f"{self.text!r} ({self.count} of {len(self.losses)}, loss {mean:.2f} of the empty concept's)"
        if self.clear:
            return f"known: the model already explains them as {told}; if that is all you mean, no learning is needed"
        return f"known: no training concept explains them all; the best is {told}"


@dataclass(frozen=True)
class Check:
    """What a check found in demonstrations of a concept.

    Attributes:
        name: of the concept.
        demonstrations: that were checked.
        findings: faults and notes, errors and warnings first.
        known: the training concept that explains them best; ``None`` where no model was asked.
        left_out: what concepts that are learned from some explain of the others; ``None`` where nothing was learned.
    """

    name: str
    demonstrations: Demonstrations
    findings: tuple[Finding, ...]
    known: Known | None = None
    left_out: LeaveOneOut | None = None

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What is likely a fault."""
        return tuple(finding for finding in self.findings if finding.severity != "note")

    def __str__(self) -> str:
        lengths, columns = self.demonstrations.lengths, self.demonstrations.states.shape[2]
        shortest, longest = int(lengths.min()), int(lengths.max())
        steps = counted(longest, "step") if shortest == longest else f"{shortest} to {longest} steps"
        lines = [f"{self.name}: {counted(len(lengths), 'demonstration')} of {steps}, {counted(columns, 'column')}"]
        if not self.warnings:
            lines.append("  no faults: no gaps, jumps, stills, duplicates or outliers")
        told = [f"  {'' if one.severity == 'note' else f'{one.severity}: '}{one}" for one in self.findings]
        rest = len(told) - MOST_FAULTS
        lines += told if rest <= 0 else [*told[:MOST_FAULTS], f"  and {rest} more"]
        lines += [] if self.known is None else [f"  {self.known}"]
        lines += [] if self.left_out is None else [f"  {line}" for line in self.left_out.lines() if line]
        return "\n".join(lines)


def known_as(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, tell: Callable[[int], None]
) -> Known:
    """The training concept that explains demonstrations best, by its mean loss."""
    embeddings = model.training_embeddings[:, None, None]
    concepts = Composition(embeddings, torch.ones(embeddings.shape[:2], device=model.device))
    losses = relative_losses(model, demonstrations, concepts, settings, tell)
    best = int(losses.mean(dim=1).argmin())
    return Known(model.config.training_concepts[best], tuple(losses[best].tolist()))


def fit_findings(model: ConceptModel, demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """Whether demonstrations are as long as the model's plans, and on its scale."""
    longer, longest = longer_than_plans(demonstrations, model), int(demonstrations.lengths.max())
    found = [Finding(longer, "note")] if longer else []
    if longest < model.window and not demonstrations.observed:
        told = f"demonstrations of up to {longest} steps are shorter than the model's plans of {model.window}"
        found.append(Finding(f"{told}; their last state is repeated", "note"))
    return (*found, *scale_findings(model, demonstrations))


def warnings_of(model: ConceptModel, demonstrations: Demonstrations) -> tuple[str, ...]:
    """One line for each likely fault of demonstrations of one concept, before it is learned."""
    found = (*check(demonstrations), *scale_findings(model, demonstrations))
    return tuple(str(finding) for finding in found if finding.severity != "note")


def check_with(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int = 0,
    found: tuple[Finding, ...] = (),
    progress: bool = False,
) -> Check:
    """Check demonstrations of one concept with a model.

    Args:
        model: that concepts are learned through.
        demonstrations: that fit it, of one concept.
        settings: how concepts are learned.
        steps: of learning from subsets, at most; 0 to learn nothing.
        found: before.
        progress: show a bar.

    Raises:
        UserError: for a model through which no concepts are learned.
    """
    check_settings(model, settings)
    name = demonstrations.concepts[0]
    faults = (*found, *check(demonstrations), *fit_findings(model, demonstrations))
    nothing = nullcontext(lambda *_: None)
    titled, total = f"{name}: training concepts", len(model.config.training_concepts)
    with bar(titled, total, lines=False) if progress else nothing as advance:
        known = known_as(model, demonstrations, settings, advance)
    left: LeaveOneOut | None = None
    if steps and len(demonstrations) > 1:
        with bar(f"{name}: learning from some", steps) if progress else nothing as advance:
            left = leave_one_out(model, demonstrations, settings, steps, lambda loss: advance(1, f"loss {loss:.3g}"))
    ordered = tuple(sorted(faults, key=lambda finding: finding.severity == "note"))
    return Check(name, demonstrations, ordered, known, left)
