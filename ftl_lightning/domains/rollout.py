"""Results of executing plans."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ftl_lightning.data.features import InitialStates, Observed, take


@dataclass(frozen=True)
class Rollout:
    """Episodes.

    Attributes:
        starts: initial states.
        observed: kept features by name ``(episode, steps + 1, *shape)``, padded with an episode's last observation.
        failed: ``(episode,)`` of bool: the episode ended as the policy had no finite action or the environment raised an error.
        infos: the environment's info of each episode's last step.
    """

    starts: InitialStates
    observed: Observed
    failed: Tensor
    infos: list[dict[str, Any]]

    def take(self, start: int, end: int) -> "Rollout":
        """Episodes from ``start`` to ``end``."""
        rows = slice(start, end)
        return Rollout(self.starts.take(rows), take(self.observed, rows), self.failed[rows], self.infos[rows])

    def split(self, counts: Sequence[int]) -> list["Rollout"]:
        """Split into parts of ``counts`` episodes."""
        ends = list(itertools.accumulate(counts))
        return [self.take(start, end) for start, end in zip([0, *ends], ends, strict=False)]
