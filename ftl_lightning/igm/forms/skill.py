"""Skill of samples on left-out demonstrations: an energy score, scaled by that of training behaviour and of fresh behaviour."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import PathFeatures, among, apart, ceiling
from ftl_lightning.data.features import moved
from ftl_lightning.data.places import first_windows, frames_of, shift
from ftl_lightning.data.references import NAMES, SHIFTED, Reference, Setting
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.forms.quality import encoded
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.randomness import generator

FOLDS, SAMPLES = 5, 16
"""Maximum number of left-out demonstrations, and samples for each."""
LEAST = 0.05
"""Score that is added to both in the ratio of a skill: behaviour that hardly varies is not judged by its rounding."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""Sampling of candidates."""


SHARES = torch.arange(11, dtype=torch.float64) / 10
"""Shares of samples that are made without the model, in mixtures."""


@dataclass(frozen=True)
class Drawn:
    """Samples for each left-out demonstration, and their mean distances, in units of the score.

    Attributes:
        values: features ``(fold, sample, n)`` of each kind.
        apart: mean distance from the left-out demonstration ``(fold,)``.
        among: mean distance between two samples ``(fold,)``.
    """

    values: Sequence[Tensor]
    apart: Tensor
    among: Tensor

    @property
    def score(self) -> Tensor:
        """Energy score ``(fold,)``."""
        return self.apart - self.among / 2


class LeftOut:
    """Scores of candidates on left-out demonstrations of one concept, in the network's normalised columns.

    A score is the mean of the energy scores of all features of :class:`~ftl_lightning.data.distances.PathFeatures`, each relative
    to that of behaviour of all training concepts at random. The skill of samples is the score of fresh demonstrations divided by
    that of the samples: 1 for fresh demonstrations, 0.5 for twice their score.

    Args:
        model: frozen model.
        demonstrations: demonstrations of one concept, two or more.
        training: demonstrations of training concepts.

    Attributes:
        rows: left-out demonstrations ``(fold,)``.
        others: rows of the other demonstrations, for each left-out one.
        frames: frames ``(place, horizon)`` of the others, for each left-out demonstration; ``None`` for a model without places.
        fresh: energy score of fresh demonstrations ``(feature,)``, from the distances among the demonstrations; where places are
            observed, from those among the demonstrations moved to the places of each.
        setting: what the training concepts say about behaviour, for references.
        known: features ``(demo, n)`` of the demonstrations, of each kind.
    """

    def __init__(self, model: Invertible, demonstrations: Demonstrations, training: Demonstrations) -> None:
        self.model, self.demonstrations = model, demonstrations
        self.rows = list(range(0, len(demonstrations), -(-len(demonstrations) // FOLDS)))
        self.others = [[row for row in range(len(demonstrations)) if row != out] for out in self.rows]
        self.frames = [None if (frames := model.frames_of(part)) is None else frames[0].cpu() for part in self.parts()]
        self.setting = Setting.of(training, model.horizon, model.places)
        real = encoded(self.model, first_windows(training, model.horizon), training.initial_states)
        self.features = PathFeatures(real, self._within(training))
        known = encoded(self.model, first_windows(demonstrations, model.horizon), demonstrations.initial_states)
        self.known = self.features(known)
        self.truth = known[self.rows]
        some = torch.randperm(len(real), generator=generator("cpu", 0, 8))[: 4 * SAMPLES]
        self.unit = self.features.scores(real[some].expand(len(self.rows), -1, -1, -1), self.truth).mean(dim=0).clamp(min=1e-9)
        self.fresh = self._fresh(known) / self.unit

    def _within(self, training: Demonstrations) -> Tensor:
        """Standard deviation within training concepts ``(horizon, state)``, without what places explain."""
        paths, horizon = first_windows(training, self.model.horizon), self.model.horizon
        names = list(dict.fromkeys(training.concepts))
        rows = torch.tensor([names.index(text) for text in training.concepts])
        starts = training.initial_states
        if self.setting.places:
            shares = frames_of(training, horizon, self.setting.places)[rows]
            paths = paths - shift(shares, self.setting.places, starts.observed, paths.shape[2])
        rest = encoded(self.model, paths, starts)
        means = torch.stack([rest[rows == number].mean(dim=0) for number in range(len(names))])
        degrees = max(len(rows) - len(names), 1)
        return ((rest - means[rows]).square().sum(dim=0) / degrees).sqrt()

    def _fresh(self, known: Tensor) -> Tensor:
        """Energy score of fresh demonstrations ``(feature,)``."""
        if not self.setting.places:
            return ceiling(self.features, known)
        moved, whole = Reference.of(SHIFTED, self.demonstrations, self.setting, self.model.horizon), len(self.demonstrations)
        every = []
        for row in range(whole):
            starts = self.demonstrations.initial_states.take(torch.full((whole,), row))
            every.append(ceiling(self.features, encoded(self.model, moved.each(starts.observed), starts)))
        return torch.stack(every).mean(dim=0)

    def skill(self, score: Tensor | float) -> float:
        """Skill of a mean score."""
        return 1 / (float(score) + float((LEAST / (self.fresh + LEAST)).mean()))

    def error(self, scores: Tensor) -> float:
        """Standard error of the skill over left-out demonstrations, from scores ``(fold,)``, two or more (delta method)."""
        return self.skill(scores.mean()) ** 2 * float(scores.std() / len(scores) ** 0.5)

    def parts(self) -> list[Demonstrations]:
        """The demonstrations without each left-out one, ``(fold,)``."""
        return [self.demonstrations.rows(rows) for rows in self.others]

    def drawn(self, compositions: Sequence[Composition], seed: int, variation: float = 0.0) -> Drawn:
        """Samples of the compositions ``(fold,)`` that were learned without each left-out demonstration, with a variation."""
        starts = self.demonstrations.initial_states.take(torch.tensor(self.rows).repeat_interleave(SAMPLES))
        draws = [generator("cpu", seed, 9, fold) for fold in range(len(self.rows))]
        sampling = replace(SAMPLING, steps=min(SAMPLING.steps, self.model.max_steps or SAMPLING.steps))
        together = [replace(composition, variation=variation).to(self.model.device) for composition in compositions]
        plans = self.model.sample(together, SAMPLES, sampling, draws, moved(starts.observed, self.model.device)).cpu()
        values = [each.unflatten(0, plans.shape[:2]) for each in self.features(encoded(self.model, plans.flatten(0, 1), starts))]
        far = [apart(samples, real) for samples, real in zip(values, self.features(self.truth), strict=True)]
        return Drawn(values, self._mean(far), self._mean([among(samples) for samples in values]))

    def _mean(self, distances: Sequence[Tensor]) -> Tensor:
        """Mean over features of distances ``(fold, ...)``, each relative to the score of fresh demonstrations."""
        scaled = [distance / unit for distance, unit in zip(distances, self.features.units, strict=True)]
        return (torch.stack(scaled, dim=-1) / self.unit / (self.fresh + LEAST)).mean(dim=-1)

    def nearer(self, drawn: Drawn, training: Drawn) -> float:
        """Share of samples that are nearer to a demonstration than to each of as many samples of a ``training`` concept."""
        known = [values.expand(len(self.rows), -1, -1) for values in self.known]
        count = min(known[0].shape[1], SAMPLES)
        own, other = (
            self._mean([torch.cdist(some, each[:, :count]) for some, each in zip(drawn.values, others, strict=True)]).amin(dim=2)
            for others in (known, training.values)
        )
        return float((own < other).float().mean())

    def mixed(self, learned: Drawn, made: Drawn) -> Tensor:
        """Scores ``(share, fold)`` of mixtures in which the :data:`SHARES` of the samples are of ``made``."""
        both = zip(learned.values, made.values, strict=True)
        between = self._mean([torch.cdist(first, second).mean(dim=(1, 2)) for first, second in both])
        share = SHARES[:, None]
        spread = (1 - share).square() * learned.among + share.square() * made.among + 2 * share * (1 - share) * between
        return (1 - share) * learned.apart + share * made.apart - spread / 2

    def references(self, like: Composition, seed: int) -> dict[str, Drawn]:
        """Samples of each reference that needs no learning, by name; ``like`` is any composition of the model."""
        return {name: self.made(name, like, seed) for name in NAMES}

    def made(self, name: str, like: Composition, seed: int, variation: float = 0.0) -> Drawn:
        """Samples of a reference or of varied demonstrations, with a variation; ``like`` as in :meth:`references`."""
        of = partial(Reference.of, name, setting=self.setting, horizon=self.model.horizon, spread=(1 - variation) ** 0.5)
        return self.drawn([replace(like, made=of(part)) for part in self.parts()], seed, variation)
