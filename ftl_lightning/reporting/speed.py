"""Accuracy over seconds of learning: the file that ``benchmarks/speed/speed.py`` writes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.reporting.listed import read_listed

SPEED = "speed.json"
"""Name of the file in a folder of results."""
PUBLISHED, ONE, TEN = "published procedure, one concept", "ours, one concept", "ours, ten concepts together"
"""Names of the curves."""
WITHIN = 0.02
"""Tolerance below the final accuracy that counts as reached."""


@dataclass(frozen=True)
class Measured:
    """A point of a curve.

    Attributes:
        curve: name of the curve, such as :data:`PUBLISHED`.
        steps: gradient steps; mean over concepts if each stops by itself.
        seconds: learning time.
        accuracy: mean over concepts of the share of plans that show the concept.
    """

    curve: str
    steps: float
    seconds: float
    accuracy: float


def reached(curves: Mapping[str, Sequence[Measured]]) -> float:
    """The accuracy that every curve reaches: minimum of final accuracies, minus :data:`WITHIN`."""
    return min(curve[-1].accuracy for curve in curves.values()) - WITHIN


def read_speed(path: str | Path) -> dict[str, list[Measured]]:
    """Read the curves of a file, or of its folder; empty if there is no file.

    Raises:
        UserError: for an invalid file, naming file and row.
    """
    path = Path(path)
    path = path / SPEED if path.is_dir() else path
    curves: dict[str, list[Measured]] = {}
    if not path.is_file() or path.suffix != ".json":
        return curves
    for measured in read_listed(path, "curves", Measured, "curves of steps, seconds and accuracy"):
        curves.setdefault(measured.curve, []).append(measured)
    return curves
