"""Segments of single actions in trials with several, annotated by hand.

Shipped segments are from M. C. Hughes (mocap6dataset, ``truelabels``: a label per tenth of a second; subjects 13 and 14) and
F. Zhou (aca, ``moc``: the middle value; subject 86), in frames at 30 per second. ``segments.csv`` in a folder replaces them.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.services.errors import UserError
from ftl_lightning.services.files import read_text

SEGMENTS = "segments.csv"
HEADER = ("trial_id", "label", "start30", "stop30")


@dataclass(frozen=True)
class Segment:
    """Part of a trial with a single action.

    Attributes:
        trial_id: such as ``13_29``.
        label: the action.
        start, stop: frames at 30 per second, the last excluded; ``stop`` is ``None`` for the end of the trial.
    """

    trial_id: str
    label: str
    start: int
    stop: int | None


WHOLE = tuple(
    Segment(trial, label, 0, None)
    for label, trials in (("chop wood", ("79_01", "80_71")), ("breaststroke", ("126_03", "126_04", "126_05")))
    for trial in trials
)
"""Trials that show a new action from start to end."""


def shipped_segments() -> tuple[Segment, ...]:
    """Segments of the package."""
    return read_segments(Path(__file__).parent / SEGMENTS)


def read_segments(path: Path) -> tuple[Segment, ...]:
    """Segments of a file with the columns ``trial_id,label,start30,stop30``, and :data:`WHOLE`.

    Raises:
        UserError: with path and line.
    """
    try:
        lines = list(csv.reader(read_text(path, "table of segments").splitlines()))
    except csv.Error as error:
        raise UserError(f"{path}: expected a table of segments (CSV), found a file that cannot be read ({error})") from error
    if not lines or tuple(lines[0]) != HEADER:
        raise UserError(f"{path}: line 1: expected {','.join(HEADER)}, found {','.join(lines[0]) if lines else 'nothing'}")
    segments = []
    for number, fields in enumerate(lines[1:], start=2):
        if not fields:
            continue
        if (
            len(fields) != len(HEADER)
            or not all(field.strip().isdigit() for field in fields[2:])
            or int(fields[2]) >= int(fields[3])
        ):
            line = ",".join(fields)
            raise UserError(f"{path}: line {number}: expected a trial, a label, a first frame and a later one, found {line!r}")
        segments.append(Segment(fields[0].strip(), fields[1].strip(), int(fields[2]), int(fields[3])))
    labels = {segment.label for segment in segments}
    return (*segments, *(segment for segment in WHOLE if segment.label not in labels))
