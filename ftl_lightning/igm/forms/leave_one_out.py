"""Losses of demonstrations under concepts, relative to the unconditional loss, and leave-one-out losses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ftl_lightning.data.check import numbered
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.inversion import Inversion, Tell, invert
from ftl_lightning.igm.model import Draws, Invertible
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import PAPER, InversionSettings, Loss
from ftl_lightning.services.randomness import generator

MOST = 12
"""Maximum number of demonstrations; several concepts are learned for each."""
SAMPLES, TOLERANCE = 16, 0.03
"""Fast learning: noised demonstrations a step, and stopping tolerance."""
OUTLYING, HARMED = 1.7, 1.2
"""Minimum ratios of an outlier's left-out loss to the largest other loss, and to the unconditional loss."""
COVERED = 0.95
"""Relative loss below which a demonstration is explained."""
FAR = 10.0
"""Minimum ratio of the training loss to the loss of generated behaviour for a task far from pretraining."""
FALLING = 0.05
"""Minimum relative fall of the left-out loss for one more demonstration, for more to be likely to help."""
TOGETHER = 4096
"""Maximum number of noised demonstrations in a batch."""
GENERATED = Sampling("dpm_solver", 10)
"""Sampling of the behaviour in :func:`generated_loss`."""
COMPARED = 8
"""Maximum number of training concepts in :func:`generated_loss`."""


@dataclass(frozen=True)
class _Noised:
    """Windows ``(demo * sample, window, state)`` by demonstration, what is ``seen`` there, and noise shared by all concepts."""

    model: Invertible
    loss: Loss
    states: Tensor
    seen: Observed
    draws: Draws | None
    demonstrations: int

    @classmethod
    def of(cls, model: Invertible, demonstrations: Demonstrations, settings: InversionSettings, samples: int) -> "_Noised":
        """Draw ``samples`` noised windows of each demonstration."""
        count, device = len(demonstrations), model.device
        draw = generator(device, settings.seed, 4)
        draws = model.draws(samples, settings.loss.timestep_power, draw)
        if draws is not None:
            draws = Draws(draws.t.repeat(count), draws.noise.repeat(count, 1, 1))
        share = torch.rand(samples, generator=draw, device=device).cpu().repeat(count)
        rows = torch.arange(count).repeat_interleave(samples)
        states, seen = model.windows(demonstrations, rows, share, draw)
        return cls(model, settings.loss, states, seen, draws, count)

    def losses(self, concepts: Composition, states: Tensor | None = None) -> Tensor:
        """Mean losses ``(concept, demo)`` on the CPU, of the windows or of ``states`` in their place."""
        runs = len(concepts.weights)
        repeated = {name: values.repeat(runs, *[1] * (values.dim() - 1)) for name, values in self.seen.items()}
        shown = self.states.repeat(runs, 1, 1) if states is None else states
        losses = self.model.losses(shown, repeated, concepts, self.draws, self.loss)
        return losses.unflatten(1, (self.demonstrations, -1)).mean(dim=2).cpu()

    def empty(self, concepts: Composition) -> Tensor:
        """Unconditional losses ``(1, demo)`` in mean frames; only the shape of ``concepts`` is used."""
        nothing = Composition(concepts.embeddings[:1], torch.zeros_like(concepts.weights[:1]))
        return self.losses(nothing).clamp(min=1e-12)


@torch.no_grad()
def relative_losses(
    model: Invertible,
    demonstrations: Demonstrations,
    concepts: Composition,
    settings: InversionSettings,
    tell: Callable[[int], None] = lambda count: None,
) -> Tensor:
    """Losses ``(concept, demo)`` on the CPU, relative to the unconditional loss; below 1 if a concept explains a demonstration.

    Noise, timesteps and starts of windows are shared by all demonstrations and concepts.

    Args:
        concepts: ``(concept, K, ...)``, on the model's device.
        settings: kind of loss, timesteps, and samples a step; each demonstration gets twice as many noised samples.
        tell: called with the number of concepts after each batch.
    """
    noised = _Noised.of(model, demonstrations, settings, _samples(settings))
    empty = noised.empty(concepts)
    losses, size = [], max(1, TOGETHER // len(noised.states))
    for first in range(0, len(concepts.weights), size):
        chosen = slice(first, first + size)
        losses.append(noised.losses(concepts.row(chosen)))
        tell(len(losses[-1]))
    return torch.cat(losses) / empty


@torch.no_grad()
def generated_loss(model: Invertible, demonstrations: Demonstrations, settings: InversionSettings) -> float:
    """Loss of generated behaviour, in the units of :func:`relative_losses`: a lower bound of losses.

    Behaviour of training concepts is generated from the windows' initial states. A concept learned as well as in pretraining has
    about this loss. The median over at most :data:`COMPARED` training concepts is returned.
    """
    whole = len(model.training_embeddings)
    chosen = torch.linspace(0, whole - 1, min(COMPARED, whole)).round().long()
    noised = _Noised.of(model, demonstrations, settings, _samples(settings))
    means = []
    for number in chosen.tolist():
        concept = model.compositions(slice(number, number + 1))
        draws = [generator(model.device, settings.seed, 5, number)]
        plans = model.sample([concept.row(0)], len(noised.states), GENERATED, draws, noised.seen)[0]
        means.append(noised.losses(concept, plans).mean())
    empty = noised.empty(model.compositions(slice(1)))
    return float(torch.stack(means).median() / empty.mean())


def _samples(settings: InversionSettings) -> int:
    """Number of noised samples of each demonstration."""
    return max(2 * settings.budget.samples, 16)


@dataclass(frozen=True)
class LeaveOneOut:
    """Losses of demonstrations relative to the unconditional loss on the same noise; lower is better.

    Attributes:
        left_out: left-out loss of each demonstration ``(demo,)``, under the concept learned from all others.
        learned_from: training loss of each demonstration ``(demo,)``, the mean over concepts that leave another one out.
        curve: mean left-out loss by the number of training demonstrations, without the outlier.
        outlier: index of the demonstration that differs from the others; ``None`` without any.
        generated: loss of generated behaviour, see :func:`generated_loss`.
    """

    left_out: tuple[float, ...]
    learned_from: tuple[float, ...]
    curve: dict[int, float]
    outlier: int | None
    generated: float

    @property
    def distance(self) -> float:
        """Ratio of the training loss, without the outlier, to the loss of generated behaviour.

        The left-out loss is also large for too few demonstrations.
        """
        kept = [loss for row, loss in enumerate(self.learned_from) if row != self.outlier]
        return sum(kept) / len(kept) / max(self.generated, 1e-12)

    @property
    def far(self) -> bool:
        """Whether the task is far from pretraining: concepts do not even explain their training demonstrations."""
        return self.distance >= FAR

    @property
    def covered(self) -> int:
        """Number of demonstrations explained by the concept learned from the others."""
        return sum(loss < COVERED for loss in self.left_out)

    @property
    def falling(self) -> bool:
        """Whether the last demonstrations still lowered the left-out loss."""
        (fewer, before), (more, after) = ([(0, 1.0), *self.curve.items()])[-2:]
        return before - after > FALLING * (more - fewer) * before

    def lines(self, judged: bool = True) -> list[str]:
        """Report, one line for each result; ``judged`` is whether losses decide if the demonstrations suffice."""
        count = len(self.left_out)
        out, inside = sum(self.left_out) / count, sum(self.learned_from) / count
        summary = f"left out: the concept learned from the others explains {self.covered} of {count}"
        missed = [row for row, loss in enumerate(self.left_out) if loss >= COVERED]
        summary += f", not {numbered(missed)}" if 0 < len(missed) < count else ""
        summary += f" (relative loss {out:.2f}{f', in learning {inside:.2f}' if count > 2 else ''})"
        outlier = "outlier: none is explained much worse than the others"
        if self.outlier is not None:
            loss, others = self.left_out[self.outlier], [loss for row, loss in enumerate(self.left_out) if row != self.outlier]
            worst = f", loss {loss:.2f} when it is left out (others at most {max(others):.2f})" if loss > max(others) else ""
            outlier = f"outlier: demonstration {self.outlier + 1}{worst}; another concept, or a mistake?"
        curve = ", ".join(f"{loss:.2f} from {size}" for size, loss in self.curve.items())
        verdict = "still falls: more are likely to help" if self.falling else "hardly falls any more: these suffice"
        if not self.falling and [1.0, *self.curve.values()][-1] >= COVERED:
            verdict = "hardly falls, and those left out are not explained: look at samples"
        more = f"more: loss of those left out {curve}{f'; it {verdict}' if judged else ''}" if curve else ""
        times = f"where it is learned from them, they have {self.distance:.1f} times the loss of what the model generates"
        near = f"distance: {times} (from {FAR:.0f} on: far from anything pretrained)"
        far = f"far: {times}: nothing pretrained is like this; look at samples, they may do something else"
        return [summary, *([outlier] if count > 2 else []), more, far if self.far else near]


def subsets(count: int) -> list[tuple[int, ...]]:
    """Subsets of 1, 2, 3 and ``count - 1`` demonstrations, each demonstration equally often."""
    sizes = sorted({size for size in (1, 2, 3, count - 1) if 0 < size < count})
    return [tuple(sorted((start + step) % count for step in range(size))) for size in sizes for start in range(count)]


def learned_from(
    model: Invertible,
    demonstrations: Demonstrations,
    chosen: Sequence[Sequence[int]],
    settings: InversionSettings,
    steps: int,
    tell: Tell = lambda loss: None,
    frames: Tensor | None = None,
) -> Composition:
    """Learn one set of embeddings for each subset, in one batch: ``(subset, K, ...)`` on the model's device.

    Args:
        settings: settings in the paper's form.
        frames: frames of each subset ``(subset, place, horizon)``; ``None`` for those of its demonstrations.
    """
    parts = [replace(demonstrations.rows(list(rows)), concepts=(f"{number}",) * len(rows)) for number, rows in enumerate(chosen)]
    start = Inversion(model, concatenate(parts), settings, frames=frames).to(model.device)
    sets = [concept.composition for concept in invert(model, start.demonstrations, settings, steps, tell, start=start).values()]
    every = Composition(
        torch.stack([each.embeddings for each in sets]),
        torch.stack([each.weights for each in sets]),
        frames=None if start.frames is None else torch.stack([each.frames for each in sets if each.frames is not None]),
    )
    return every.to(model.device)


def quickly(settings: InversionSettings) -> InversionSettings:
    """Settings for fast learning of sets that only need comparable losses."""
    return settings.from_one_start(
        form=PAPER,
        modes=1,
        adapter=0,
        samples=min(settings.budget.samples, SAMPLES),
        tolerance=max(settings.budget.tolerance or 0, TOLERANCE),
        guidance_scale=1.0,  # only generation uses it
    )


def find_outlier(losses: Tensor) -> int | None:
    """Index of the demonstration with a left-out loss ``(demo,)`` far above the other losses; ``None`` without any."""
    if len(losses) < 3:
        return None
    worst = int(losses.argmax())
    others = torch.cat((losses[:worst], losses[worst + 1 :]))
    return worst if losses[worst] > max(OUTLYING * float(others.max()), HARMED) else None


def leave_one_out(
    model: Invertible,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Tell = lambda loss: None,
    find: Callable[[Tensor], int | None] = find_outlier,
) -> LeaveOneOut:
    """Learn the concept from subsets, in one batch, and measure each on the left-out demonstrations.

    Args:
        demonstrations: two or more of one concept; the first :data:`MOST` are used.
        settings: settings of the inversion; modes, adapters and restarts are ignored.
        find: index of the outlier by the left-out losses ``(demo,)``, or ``None``.
    """
    count = min(len(demonstrations), MOST)
    used, chosen = demonstrations.rows(list(range(count))), subsets(count)
    losses = relative_losses(model, used, learned_from(model, used, chosen, quickly(settings), steps, tell), settings)
    without = torch.tensor([[row not in rows for row in range(count)] for rows in chosen])
    sizes = torch.tensor([len(rows) for rows in chosen])
    last = sizes == count - 1
    outside = torch.where(without[last], losses[last], 0).sum(dim=0)
    inside = torch.where(~without[last], losses[last], 0).sum(dim=0) / max(count - 1, 1)
    outlier = find(outside)
    kept = without.clone()
    if outlier is not None:
        kept[:, outlier] = False
        kept[~without[:, outlier]] = False  # concepts learned from it
    curve = {
        size: float(losses[sizes == size][kept[sizes == size]].mean())
        for size in sorted(set(sizes.tolist()))
        if kept[sizes == size].any()
    }
    return LeaveOneOut(tuple(outside.tolist()), tuple(inside.tolist()), curve, outlier, generated_loss(model, used, settings))
