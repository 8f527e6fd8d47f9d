"""Check of a concept's demonstrations: faults, scale, known training concepts, and leave-one-out losses."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from ftl_lightning.data.check import check
from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.finding import Finding
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.progress import bar
from ftl_lightning.services.text import counted
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.inversion import check_settings
from ftl_lightning.training.inversion_settings import InversionSettings
from ftl_lightning.training.leave_one_out import LeaveOneOut, leave_one_out
from ftl_lightning.training.longer import longer_than_plans
from ftl_lightning.training.relative_loss import relative_losses
from ftl_lightning.training.scale_check import scale_findings

MARGIN, MOST_OF = 0.97, 0.8
"""Maximum loss, relative to the unconditional (empty concept's) loss, of a demonstration that a training concept explains; minimum
share of explained demonstrations for a known task.
"""
MOST_FAULTS = 6
"""Maximum number of reported findings, most severe first."""


@dataclass(frozen=True)
class Known:
    """The training concept that explains demonstrations best.

    Attributes:
        text: text of the training concept.
        losses: loss of each demonstration ``(demo,)``, relative to the unconditional loss.
    """

    text: str
    losses: tuple[float, ...]

    @property
    def count(self) -> int:
        """Number of demonstrations that it explains."""
        return sum(loss <= MARGIN for loss in self.losses)

    @property
    def clear(self) -> bool:
        """Whether it explains nearly all demonstrations, and their mean loss."""
        mean = sum(self.losses) / len(self.losses)
        return self.count >= MOST_OF * len(self.losses) and mean <= MARGIN

    def __str__(self) -> str:
        mean = sum(self.losses) / len(self.losses)
        best = f"{self.text!r} ({self.count} of {len(self.losses)}, loss {mean:.2f} of the empty concept's)"
        if self.clear:
            return f"known: the model already explains them as {best}; if that is all you mean, no learning is needed"
        return f"known: no training concept explains them all; the best is {best}"


@dataclass(frozen=True)
class Check:
    """Result of checking a concept's demonstrations.

    Attributes:
        name: name of the concept.
        demonstrations: checked demonstrations.
        findings: faults and notes, errors and warnings first.
        known: the training concept that explains them best; ``None`` without a model.
        left_out: leave-one-out losses; ``None`` without learning.
    """

    name: str
    demonstrations: Demonstrations
    findings: tuple[Finding, ...]
    known: Known | None = None
    left_out: LeaveOneOut | None = None

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
        lines += [] if self.left_out is None else [f"  {line}" for line in self.left_out.lines() if line]
        return "\n".join(lines)


def known_as(
    model: ConceptModel, demonstrations: Demonstrations, settings: InversionSettings, tell: Callable[[int], None]
) -> Known:
    """The training concept with the lowest mean loss."""
    embeddings = model.training_embeddings[:, None, None]
    concepts = Composition(embeddings, torch.ones(embeddings.shape[:2], device=model.device))
    losses = relative_losses(model, demonstrations, concepts, settings, tell)
    best = int(losses.mean(dim=1).argmin())
    return Known(model.config.training_concepts[best], tuple(losses[best].tolist()))


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
        model: the frozen model.
        demonstrations: demonstrations of one concept that fit the model.
        settings: settings of the inversion.
        steps: maximum number of gradient steps on subsets; 0 to learn nothing.
        found: earlier findings.
        progress: show a bar.

    Raises:
        UserError: for a model without inversion.
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
