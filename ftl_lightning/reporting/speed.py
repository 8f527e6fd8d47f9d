"""Accuracy over seconds of learning: the file that ``benchmarks/speed.py`` writes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.reporting.listed import read_listed

SPEED = "speed.json"
"""Name of the file in a folder of results."""
PUBLISHED, ONE, TEN = "published procedure, one concept", "ours, one concept", "ours, ten concepts together"
"""The curves."""
WITHIN = 0.02
"""An accuracy so much below the final one counts as reached."""


@dataclass(frozen=True)
class Measured:
    """What was learned in some time.

    Attributes:
        curve: what it belongs to, such as :data:`PUBLISHED`.
        steps: of gradient descent; a mean over concepts where each stops by itself.
        seconds: they took.
        accuracy: mean over concepts of the share of plans that show the concept.
    """

    curve: str
    steps: float
    seconds: float
    accuracy: float


def reached(curves: Mapping[str, Sequence[Measured]]) -> float:
    """The accuracy that every curve reaches: the least final one, less :data:`WITHIN`."""
    return min(curve[-1].accuracy for curve in curves.values()) - WITHIN


def read_speed(path: str | Path) -> dict[str, list[Measured]]:
    """The curves of a file, or of the folder that holds it; none where there is no file.

    Raises:
        UserError: naming the file and the row, for one of something else.
    """
    path = Path(path)
    path = path / SPEED if path.is_dir() else path
    curves: dict[str, list[Measured]] = {}
    if not path.is_file() or path.suffix != ".json":
        return curves
    for measured in read_listed(path, "curves", Measured, "curves of steps, seconds and accuracy"):
        curves.setdefault(measured.curve, []).append(measured)
    return curves
