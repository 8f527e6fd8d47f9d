"""Four families of behaviour that resemble user data: no simulator, no initial states, concepts that are words or numbers.

Each family is a domain. A sample is right if the nearest of many samples of all kinds belongs to the goal.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.apps.testing import more_strokes
from ftl_lightning.apps.testing.families import beats, pictures, reaches
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Metric, Plans
from ftl_lightning.domains.generated import Generated
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.services.randomness import FRESH_SEED

TEMPLATES, TEMPLATE_SEED = 80, 7_000_000
"""Number of templates per kind for judging, and their reserved seed."""
CHANCE, ORACLE = "random kind (chance)", "generator (oracle)"
Draw = Callable[[str, int, int], NDArray[np.float32]]
"""``(kind, count, seed) -> (count, time, column)``."""
Kind = Callable[[NDArray[np.float32]], Sequence[str]]
"""``(samples (sample, time, column)) -> kind of each sample``."""


@dataclass(frozen=True)
class Nearest:
    """Classify samples by the nearest template; columns are scaled by their spread.

    Attributes:
        draw: draws templates.
        kinds: known kinds.
    """

    draw: Draw
    kinds: tuple[str, ...]

    @functools.cached_property
    def _templates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Templates ``(kind * template, time * column)`` in units of their spread, and the spread ``(column,)``."""
        known = np.concatenate([self.draw(kind, TEMPLATES, TEMPLATE_SEED) for kind in self.kinds]).astype(np.float64)
        # Columns of single states share a scale, as some are constant.
        scale = known.reshape(-1, known.shape[2]).std(axis=0) if known.shape[1] > 1 else np.ones(known.shape[2])
        return (known / scale).reshape(len(known), -1), scale

    def __call__(self, samples: NDArray[np.float32]) -> Sequence[str]:
        """The kind of each sample ``(sample, time, column)``; empty for non-finite samples."""
        templates, scale = self._templates
        flat = (samples / scale).reshape(len(samples), -1)
        return [self._nearest(templates, row) if np.isfinite(row).all() else "" for row in flat]

    def _nearest(self, templates: NDArray[np.float64], sample: NDArray[np.float64]) -> str:
        return self.kinds[int(np.square(templates - sample).sum(axis=1).argmin()) // TEMPLATES]


@dataclass(frozen=True)
class Strokes:
    """Classify pen strokes, invariant to position and size."""

    @functools.cached_property
    def _judge(self) -> more_strokes.Judge:
        return more_strokes.Judge.of()

    def __call__(self, samples: NDArray[np.float32]) -> Sequence[str]:
        """The kind of each stroke ``(sample, 40, 2)``; empty for non-finite strokes."""
        finite = [bool(np.isfinite(stroke).all()) for stroke in samples]
        kinds = self._judge.kind(np.nan_to_num(samples, nan=0, posinf=0, neginf=0))
        return [kind if good else "" for kind, good in zip(kinds, finite, strict=True)]


def family(name: str, plans: Plans, draw: Draw, kinds: tuple[Sequence[str], Sequence[str], Sequence[str]], judge: Kind) -> Domain:
    """The domain of a family.

    Args:
        name: name of the domain.
        plans: columns and horizon of the behaviour.
        draw: draws behaviour of a kind.
        kinds: kinds for training, for validation and for the test.
        judge: classifies samples by kind.
    """
    training, validation, test = (tuple(names) for names in kinds)
    every = (*training, *validation, *test)

    def right(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        return torch.tensor([kind == goal for kind in judge(states.numpy())], dtype=torch.bool)

    def tensor(kind: str, count: int, seed: int) -> Tensor:
        return torch.from_numpy(draw(kind, count, seed))

    def chance(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
        # Balanced over kinds, to reduce variance.
        return torch.cat([tensor(every[index % len(every)], 1, FRESH_SEED + seed + index) for index in range(count)])

    def oracle(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
        return tensor(goal, count, 2 * FRESH_SEED + seed)

    def new(kinds: Sequence[str]) -> Suite:
        return Suite(tuple(EvaluationTask("new concept", kind, (kind,)) for kind in kinds))

    source = Generated(name, plans, training, tensor)
    return Domain(
        name=name,
        plans=plans,
        concepts=Concepts(training, {"training": training_suite(training), "validation": new(validation), "paper": new(test)}),
        source=lambda root: source,
        metrics={ACCURACY: Metric(right)},
        references={CHANCE: chance, ORACLE: oracle},
    )


def _numbered(name: str, word: str, plans: Plans, draw: Draw) -> Domain:
    """A family of eight kinds for training, four for validation and four for the test."""
    training, validation, test = (
        [f"{word} {number}" for number in numbers] for numbers in (range(8), range(200, 204), range(100, 104))
    )
    return family(name, plans, draw, (training, validation, test), Nearest(draw, (*training, *validation, *test)))


STROKES = family(
    "benchmark_strokes",
    Plans(40, ("x", "y"), ("cm", "cm")),
    more_strokes.drawn,
    (more_strokes.KNOWN, more_strokes.VALIDATION, more_strokes.TEST),
    Strokes(),
)
PICTURES = _numbered(
    "benchmark_pictures",
    "picture",
    Plans(1, tuple(f"row {row} column {column}" for row in range(8) for column in range(8)), ("grey",) * 64),
    pictures,
)
REACHES = _numbered("benchmark_reaches", "reach", Plans(50, ("x", "y", "z", "opening"), ("m", "m", "m", "mm")), reaches)
BEATS = _numbered("benchmark_beats", "beat", Plans(120, ("potential",), ("mV",)), beats)
