"""A source of demonstrations that a function draws anew from a seed."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.domains.domain import Plans, Split
from ftl_lightning.seeding import VALIDATION_SEED


@dataclass(frozen=True)
class Generated:
    """Demonstrations drawn anew from a seed, in a domain without observed features: behaviour starts nowhere.

    Attributes:
        name: of the domain.
        plans: of the domain, whose columns the states have.
        training: training concepts.
        states: ``(task, count, seed) -> (demo, time, state)`` float32, or one ``(time, state)`` for each demonstration where they
            differ in length. The same three must give the same bytes.
    """

    name: str
    plans: Plans
    training: tuple[str, ...]
    states: Callable[[str, int, int], Iterable[Tensor]]

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of each training concept; those of ``'validation'`` come from seeds of their own."""
        return self._drawn(self.training, count, seed if name == "train" else VALIDATION_SEED + seed)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """``count`` demonstrations of a task, in this process."""
        return self._drawn((task,), count, seed)

    def starts(self, task: str, count: int, seed: int) -> None:
        """There are none."""

    def _drawn(self, tasks: Sequence[str], count: int, seed: int) -> Demonstrations:
        states, lengths = padded([one for task in tasks for one in self.states(task, count, seed)])
        return Demonstrations(
            states=states,
            lengths=lengths,
            domain=self.name,
            state_names=self.plans.columns,
            state_units=self.plans.units,
            concepts=tuple(task for task in tasks for _ in range(count)),
            provenance={"generator": self.name, "seed": seed, "count_per_task": count},
        )
