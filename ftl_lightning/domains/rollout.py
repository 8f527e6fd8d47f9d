"""What happened when plans were executed."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates, Observed, take


@dataclass(frozen=True)
class Rollout:
    """Episodes.

    Attributes:
        starts: where they started.
        observed: features that were kept, by name ``(episode, steps + 1, *shape)``, padded with an episode's last.
        failed: ``(episode,)`` of bool: the policy had no finite action or the environment raised an error; the episode ended there.
        infos: what the environment told of each episode's last step, by name.
    """

    starts: InitialStates
    observed: Observed
    failed: Tensor
    infos: list[dict[str, Any]]

    def take(self, start: int, end: int) -> "Rollout":
        """Some of the episodes."""
        rows = slice(start, end)
        return Rollout(self.starts.take(rows), take(self.observed, rows), self.failed[rows], self.infos[rows])

    def split(self, counts: Sequence[int]) -> list["Rollout"]:
        """The same in parts of so many episodes."""
        ends = list(itertools.accumulate(counts))
        return [self.take(start, end) for start, end in zip([0, *ends], ends, strict=False)]
