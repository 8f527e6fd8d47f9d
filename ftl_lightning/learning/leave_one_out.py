"""How well a concept that is learned from some demonstrations explains those that were left out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.demonstrations.finding import numbered
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion import invert
from ftl_lightning.learning.inversion_settings import PAPER, InversionSettings
from ftl_lightning.learning.relative_loss import generated_loss, relative_losses

MOST = 12
"""Demonstrations of which this is asked: of each, several concepts are learned."""
SAMPLES, TOLERANCE = 16, 0.03
"""Of learning quickly from a subset: noised demonstrations of a step, and when to stop."""
ODD, HARMED = 1.7, 1.2
"""An odd demonstration's left-out loss is so many times the largest of the others, and of the empty concept's."""
COVERED = 0.95
"""Of the empty concept's loss: a demonstration is explained by a concept whose loss is less."""
FAR = 10.0
"""A task is far from anything pretrained where the loss of those learned from is so many times that of what the model generates."""
FALLING = 0.05
"""Share that the loss of those left out falls by for one more demonstration, from which on more are likely to help."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Losses of demonstrations relative to the empty concept's on the same noise; 1 is no better than nothing, less is better.

    Attributes:
        left_out: of each demonstration, under the concept that was learned from all others ``(demo,)``.
        learned_from: of each, the mean under the concepts that were learned from it and all others but one ``(demo,)``.
        curve: the mean of those left out by the number of demonstrations that were learned from, without the odd one.
        odd: the demonstration that differs from the others, from 0; ``None`` where none does.
        generated: of what the model generates itself, see :func:`~ftl_lightning.learning.relative_loss.generated_loss`.
    """

    left_out: tuple[float, ...]
    learned_from: tuple[float, ...]
    curve: dict[int, float]
    odd: int | None
    generated: float

    @property
    def distance(self) -> float:
        """How many times the loss of what the model generates the loss of those learned from is, without the odd one.

        That of those left out is also large where demonstrations are too few to tell what is meant.
        """
        kept = [loss for row, loss in enumerate(self.learned_from) if row != self.odd]
        return sum(kept) / len(kept) / max(self.generated, 1e-12)

    @property
    def far(self) -> bool:
        """Whether the model has seen nothing like them: no concept explains even those that it is learned from."""
        return self.distance >= FAR

    @property
    def covered(self) -> int:
        """How many demonstrations are explained by the concept that was learned from the others."""
        return sum(loss < COVERED for loss in self.left_out)

    @property
    def falling(self) -> bool:
        """Whether the last demonstrations still lowered the loss of those left out."""
        (fewer, before), (more, after) = ([(0, 1.0), *self.curve.items()])[-2:]
        return before - after > FALLING * (more - fewer) * before

    def lines(self) -> list[str]:
        """In plain words."""
        count = len(self.left_out)
        out, own = sum(self.left_out) / count, sum(self.learned_from) / count
        told = f"left out: the concept learned from the others explains {self.covered} of {count}"
        missed = [row for row, loss in enumerate(self.left_out) if loss >= COVERED]
        told += f", not {numbered(missed)}" if 0 < len(missed) < count else ""
        told += f" (loss {out:.2f} of the empty"
        told += f" concept's, {own:.2f} where it is learned from, too)" if count > 2 else " concept's)"
        odd = "odd: none is explained much worse than the others"
        if self.odd is not None:
            others = max(loss for row, loss in enumerate(self.left_out) if row != self.odd)
            odd = f"odd: demonstration {self.odd + 1}, loss {self.left_out[self.odd]:.2f} when it is left out (others at most"
            odd += f" {others:.2f}); another concept, or a mistake?"
        curve = ", ".join(f"{loss:.2f} from {size}" for size, loss in self.curve.items())
        verdict = "still falls: more are likely to help" if self.falling else "hardly falls any more: these suffice"
        if not self.falling and [1.0, *self.curve.values()][-1] >= COVERED:
            verdict = "hardly falls, and those left out are not explained: look at samples"
        more = f"more: loss of those left out {curve}; it {verdict}" if curve else ""
        times = f"where it is learned from them, they have {self.distance:.1f} times the loss of what the model generates"
        near = f"distance: {times} (from {FAR:.0f} on: far from anything pretrained)"
        far = f"far: {times}: nothing pretrained is like this; look at samples, they may do something else"
        return [told, *([odd] if count > 2 else []), more, far if self.far else near]


def subsets(count: int) -> list[tuple[int, ...]]:
    """Of so many demonstrations: those of one, two, three and all but one, each demonstration as often as any other."""
    sizes = sorted({size for size in (1, 2, 3, count - 1) if 0 < size < count})
    return [tuple(sorted((start + step) % count for step in range(size))) for size in sizes for start in range(count)]


def learned_from(
    model: ConceptModel,
    demonstrations: Demonstrations,
    chosen: Sequence[Sequence[int]],
    settings: InversionSettings,
    steps: int,
    tell: Callable[[float], None] = lambda loss: None,
) -> Composition:
    """One set of embeddings from each of some subsets, all in one batch: ``(subset, K, ...)`` on the model's device.

    Args:
        model: through which concepts are learned.
        demonstrations: of one concept or several.
        chosen: rows of each subset.
        settings: how, in the paper's form.
        steps: of gradient descent, at most.
        tell: called with the mean loss after each step.
    """
    parts = [replace(demonstrations.rows(list(rows)), concepts=(f"{number}",) * len(rows)) for number, rows in enumerate(chosen)]
    learned = list(invert(model, concatenate(parts), settings, steps, tell).values())
    every = Composition(torch.stack([one.embeddings for one in learned]), torch.stack([one.weights for one in learned]))
    return every.to(model.device)


def quickly(settings: InversionSettings) -> InversionSettings:
    """The same for sets of embeddings that only have to tell good from bad."""
    return settings.from_one_start(
        form=PAPER,
        modes=1,
        adapter=0,
        samples=min(settings.budget.samples, SAMPLES),
        tolerance=max(settings.budget.tolerance or 0, TOLERANCE),
        guidance_scale=1.0,  # it is for generating, not for explaining
    )


def leave_one_out(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Callable[[float], None] = lambda loss: None,
) -> LeaveOneOut:
    """Learn the concept from subsets, all in one batch, and measure each on what was left out.

    Args:
        model: through which concepts are learned.
        demonstrations: two or more of one concept; the first :data:`MOST` count.
        settings: how concepts are learned; of modes, adapters and restarts none is used.
        steps: of gradient descent, at most.
        tell: called with the mean loss after each step.
    """
    count = min(len(demonstrations), MOST)
    own, chosen = demonstrations.rows(list(range(count))), subsets(count)
    losses = relative_losses(model, own, learned_from(model, own, chosen, quickly(settings), steps, tell), settings)
    without = torch.tensor([[row not in rows for row in range(count)] for rows in chosen])
    sizes = torch.tensor([len(rows) for rows in chosen])
    last = sizes == count - 1
    outside = torch.where(without[last], losses[last], 0).sum(dim=0)
    inside = torch.where(~without[last], losses[last], 0).sum(dim=0) / max(count - 1, 1)
    odd = odd_one(outside)
    kept = without.clone()
    if odd is not None:
        kept[:, odd] = False
        kept[~without[:, odd]] = False  # what was learned from it
    curve = {
        size: float(losses[sizes == size][kept[sizes == size]].mean())
        for size in sorted(set(sizes.tolist()))
        if kept[sizes == size].any()
    }
    return LeaveOneOut(tuple(outside.tolist()), tuple(inside.tolist()), curve, odd, generated_loss(model, own, settings))


def odd_one(losses: Tensor) -> int | None:
    """The demonstration whose left-out loss ``(demo,)`` is far above those of the others."""
    if len(losses) < 3:
        return None
    worst = int(losses.argmax())
    others = torch.cat((losses[:worst], losses[worst + 1 :]))
    return worst if losses[worst] > max(ODD * float(others.max()), HARMED) else None
