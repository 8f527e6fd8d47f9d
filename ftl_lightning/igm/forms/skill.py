"""Skill of samples on left-out demonstrations: an energy score, scaled by that of training behaviour and of fresh behaviour."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.energy import PathFeatures, ceiling
from ftl_lightning.data.features import InitialStates, moved
from ftl_lightning.data.places import first_windows
from ftl_lightning.data.references import NAMES, Reference, Setting
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.randomness import generator

FOLDS, SAMPLES = 5, 16
"""Maximum number of left-out demonstrations, and samples for each."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""Sampling of candidates."""


class LeftOut:
    """Scores of candidates on left-out demonstrations of one concept, in the network's normalised columns.

    The skill of samples is 0 for behaviour of all training concepts at random, and 1 for fresh demonstrations where nothing is
    observed; where something is observed, 1 is exact. It is a mean over the features of
    :class:`~ftl_lightning.data.energy.PathFeatures`, and may be below 0.

    Args:
        model: frozen model.
        demonstrations: demonstrations of one concept, two or more.
        training: demonstrations of training concepts.

    Attributes:
        rows: left-out demonstrations ``(fold,)``.
        setting: what the training concepts say about behaviour, for references.
    """

    def __init__(self, model: Invertible, demonstrations: Demonstrations, training: Demonstrations) -> None:
        self.model, self.demonstrations = model, demonstrations
        self.rows = list(range(0, len(demonstrations), -(-len(demonstrations) // FOLDS)))
        self.setting = Setting.of(training, model.horizon)
        real = self._encoded(first_windows(training, model.horizon), training.initial_states)
        self.features = PathFeatures(real)
        known = self._encoded(first_windows(demonstrations, model.horizon), demonstrations.initial_states)
        self.truth = known[self.rows]
        some = torch.randperm(len(real), generator=generator("cpu", 0, 8))[: 4 * SAMPLES]
        self.floor = self.features.scores(real[some].expand(len(self.rows), -1, -1, -1), self.truth)
        self.fresh = torch.zeros_like(self.floor[0]) if demonstrations.observed else ceiling(self.features, known)

    def parts(self) -> list[Demonstrations]:
        """The demonstrations without each left-out one, ``(fold,)``."""
        every = range(len(self.demonstrations))
        return [self.demonstrations.rows([row for row in every if row != out]) for out in self.rows]

    def skill(self, compositions: Sequence[Composition], seed: int) -> Tensor:
        """Skill ``(fold,)`` of the compositions that were learned without each left-out demonstration."""
        starts = self.demonstrations.initial_states.take(torch.tensor(self.rows).repeat_interleave(SAMPLES))
        draws = [generator("cpu", seed, 9, fold) for fold in range(len(self.rows))]
        sampling = replace(SAMPLING, steps=min(SAMPLING.steps, self.model.max_steps or SAMPLING.steps))
        together = [composition.to(self.model.device) for composition in compositions]
        plans = self.model.sample(together, SAMPLES, sampling, draws, moved(starts.observed, self.model.device)).cpu()
        scores = self.features.scores(self._encoded(plans.flatten(0, 1), starts).unflatten(0, plans.shape[:2]), self.truth)
        scale = (self.floor.mean(dim=0) - self.fresh).clamp(min=1e-6)
        return ((self.floor.mean(dim=0) - scores) / scale).mean(dim=1)

    def references(self, like: Composition, seed: int) -> dict[str, Tensor]:
        """Skill ``(fold,)`` of each reference that needs no learning, by name; ``like`` is any composition of the model."""
        parts, horizon = self.parts(), self.model.horizon
        return {
            name: self.skill([replace(like, made=Reference.of(name, part, self.setting, horizon)) for part in parts], seed)
            for name in NAMES
        }

    def _encoded(self, paths: Tensor, starts: InitialStates) -> Tensor:
        return self.model.encode(paths.to(self.model.device), moved(starts.observed, self.model.device)).cpu()
