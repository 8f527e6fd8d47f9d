"""Descriptions of motion: training concepts, new concepts learned from few demonstrations, their actions, and segments of trials.

Training concepts are descriptions of trials by the database (``cmu-mocap-index.csv``, compiled by B. Hahne), as :func:`cleaned`.
"""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from ftl_lightning.domains.tasks import EvaluationTask, Suite
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.files import read_text

HELD_OUT = ("13_29", "13_30", "13_31", "14_14", "14_20", "79_01", "80_71", "126_03", "126_04", "126_05")
"""Trials excluded from pretraining as a whole, since they show a new concept."""
DEMONSTRATORS = ("13", "79", "80", "126")  # Subjects who demonstrate new concepts, excluded from the training of the judge
with (Path(__file__).parent / "actions.csv").open(encoding="utf-8", newline="") as _file:
    ACTION_OF: Mapping[str, str | None] = {row["description"]: row["action"] or None for row in csv.DictReader(_file)}
"""Training concepts and their actions; ``None`` for other actions, or several in sequence."""
TRAINING_CONCEPTS = tuple(ACTION_OF)
PAPER_CONCEPTS = ("jumping jacks",)  # New concepts of the paper in most copies of the database
STAND_INS = ("arm circle",)  # Replacements of the paper's two other new concepts
DATABASE_CONCEPTS = ("chop wood", "breaststroke")  # New concepts of the paper in few copies of the database
TEST_CONCEPTS = (*PAPER_CONCEPTS, *STAND_INS)
VALIDATION_CONCEPTS = ("knee raise", "squat")
MORE_CONCEPTS = ("twist", "toe touch one hand", "toe touch two hands", "up down")
"""Further actions of the held-out trials; a single person each shows the last three."""
NEW_CONCEPTS = (*TEST_CONCEPTS, *VALIDATION_CONCEPTS, *DATABASE_CONCEPTS, *MORE_CONCEPTS)
AND = " + "  # Separator of the concepts of a goal
COMPOSED_WITH = ("walk", "jump")
_RENAMED = {"zombiewalk": "zombie walk", "heiansyodan": "heian shodan"}
_SIDES = {"left": "right", "right": "left"}


def cleaned(description: str) -> str:
    """Description in lower case, with single spaces for underscores."""
    text = " ".join(description.lower().replace("_", " ").split())
    return _RENAMED.get(text, text)


def mirrored_text(text: str) -> str:
    """Description of the mirror image: left and right exchanged."""
    return re.sub(r"\b(left|right)\b", lambda side: _SIDES[side[0]], text)


def _alone(concepts: tuple[str, ...], setting: str = "new concept") -> tuple[EvaluationTask, ...]:
    """New concepts from new poses."""
    return tuple(EvaluationTask(setting, text, (text,)) for text in concepts)


def _new(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """New concepts from new poses, and from initial poses of the demonstrations."""
    return (
        *_alone(concepts),
        *(EvaluationTask("new concept, demonstrated poses", text, (text,), initial="demonstrated") for text in concepts),
    )


def _composed(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """Compositions with uniform weights on the whole body."""
    pairs = product(concepts, COMPOSED_WITH)
    return tuple(EvaluationTask("new + training", AND.join(pair), pair[:1], pair[1:]) for pair in pairs)


def _by_parts(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """Compositions of concepts on separate parts of the body."""
    setting, arms, legs = "new + training, by parts of the body", ("arms", "trunk"), ("legs",)
    composed = _composed(concepts)
    return tuple(replace(task, setting=setting, on=((task.learned[0], arms), (task.texts[0], legs))) for task in composed)


def _protocol(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """Protocol of the paper: from the demonstrations' last states, alone and composed with training concepts."""
    composed = (replace(task, setting="new + training, last states", initial="last") for task in _composed(concepts))
    return (*(EvaluationTask("new concept, last states", text, (text,), initial="last") for text in concepts), *composed)


SUITES = {
    "paper": Suite(_new(TEST_CONCEPTS)),
    "protocol": Suite(_protocol(TEST_CONCEPTS)),
    "composition": Suite((*_composed(TEST_CONCEPTS), *_by_parts(TEST_CONCEPTS))),
    "whole": Suite(_composed(TEST_CONCEPTS)),
    "database": Suite(_new(DATABASE_CONCEPTS)),
    "validation": Suite(_new(VALIDATION_CONCEPTS)),
    "more": Suite(_alone((*TEST_CONCEPTS, *VALIDATION_CONCEPTS, *MORE_CONCEPTS), "new concept, eight actions")),
}
"""``paper`` and ``protocol``, with the initial states of the paper, are for final evaluation; ``validation`` is for tuning.
``more`` has every action that pretraining does not show, those of ``validation`` among them. ``database`` needs
:data:`DATABASE_CONCEPTS` in the user's copy; ``whole`` is for methods that cannot compose by parts."""


OTHER = "other"  # No action: motions of a single person, standing people, and windows without motion (a frozen frame, trembling)

_NAMES = (
    "walk", "run", "jump", "kick", "punch", "signals", "jumping jacks", "twist", "knee raise", "arm circle", "squat", "toe touch",
    "ballet", "basketball", "cartwheel", "charleston", "climb", "lambada", "pose", "swordplay",
)  # fmt: skip
CLASSES = (*_NAMES, OTHER)  # Classes of a judge

TESTED = CLASSES[: CLASSES.index("toe touch") + 1]
"""Classes of two subjects or more, on which a judge can be tested with new people."""

_LABELS = {"jog": "run", "leg kick": "kick", "toe touch one hand": "toe touch", "toe touch two hands": "toe touch"}
"""Labels of segments that are no training concepts."""
_CLASS_OF = {name: name for name in _NAMES} | _LABELS | {text: name for text, name in ACTION_OF.items() if name is not None}

STAND = "stand"  # Class of the legs in actions of arms and trunk
STANDING = ("punch", "signals", "twist", "arm circle", "toe touch", "swordplay")  # Actions of arms and trunk
STEPPING = ("walk", "run", "kick", "knee raise", "squat", "basketball")  # Actions of the legs, independent of the arms
REVERSIBLE = ("jumping jacks", "twist", "knee raise", "arm circle", "squat", "toe touch")
"""Periodic actions, invariant to time reversal."""
LEG_CLASSES = (*(name for name in CLASSES if name not in STANDING), STAND)  # Classes of a judge of the legs


def action(text: str) -> str | None:
    """Class of a description; ``None`` for no class, or several in sequence."""
    return _CLASS_OF.get(cleaned(text))


def actions(goal: str) -> tuple[str, ...]:
    """Classes of a goal: for two joined actions, arms and trunk first, then the legs; empty if the goal cannot be judged."""
    classes = [action(part) for part in goal.split(AND)]
    return tuple(name for name in classes if name is not None) if None not in classes and len(classes) <= 2 else ()


def judged(goal: str) -> bool:
    """Whether a goal can be judged, by the judge or by a rule."""
    return bool(actions(goal)) or goal in MORE_CONCEPTS


def of_legs(name: str) -> str:
    """Class of the legs in an action."""
    return STAND if name in STANDING else name


SEGMENTS = "segments.csv"
SHIPPED = Path(__file__).parent / SEGMENTS
HEADER = ("trial_id", "label", "start30", "stop30")


@dataclass(frozen=True)
class Segment:
    """Part of a trial with a single action, annotated by hand.

    Shipped segments are from M. C. Hughes (mocap6dataset, ``truelabels``: a label per tenth of a second; subjects 13 and 14) and
    F. Zhou (aca, ``moc``: the middle value; subject 86). ``segments.csv`` in a folder of recordings replaces them.
    """

    trial_id: str  # such as 13_29
    label: str  # the action
    start: int  # frame at 30 per second
    stop: int | None  # frame after the last; None for the end of the trial


WHOLE_TRIALS = tuple(
    Segment(trial, label, 0, None)
    for label, trials in (("chop wood", ("79_01", "80_71")), ("breaststroke", ("126_03", "126_04", "126_05")))
    for trial in trials
)
"""Trials that show a new action from start to end."""


def read_segments(path: Path) -> tuple[Segment, ...]:
    """Segments of a file with the columns ``trial_id,label,start30,stop30``, and :data:`WHOLE_TRIALS`; errors name the line."""
    try:
        lines = list(csv.reader(read_text(path, "table of segments").splitlines()))
    except csv.Error as error:
        raise UserError(f"{path}: expected a table of segments (CSV), found a file that cannot be read ({error})") from error
    header = lines[0] if lines else []
    require(tuple(header) == HEADER, f"{path}: line 1", ",".join(HEADER), ",".join(header) or "nothing")
    segments = []
    for number, fields in enumerate(lines[1:], start=2):
        numbers = [int(field) for field in fields[2:] if field.strip().isdigit()]
        valid = len(fields) == len(HEADER) and len(numbers) == 2 and numbers[0] < numbers[1]
        expected = "a trial, a label, a first frame and a later frame"
        require(valid or not fields, f"{path}: line {number}", expected, repr(",".join(fields)))
        if fields:
            segments.append(Segment(fields[0].strip(), fields[1].strip(), *numbers))
    labels = {segment.label for segment in segments}
    return (*segments, *(segment for segment in WHOLE_TRIALS if segment.label not in labels))
