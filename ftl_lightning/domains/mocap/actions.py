"""Which action a text names, as data: the classes that a judge tells apart.

The texts are descriptions of the CMU motion capture database, whose actions stand in
:data:`~ftl_lightning.domains.mocap.tasks.ACTION_OF`, and labels of segments.
"""

from ftl_lightning.domains.mocap.tasks import ACTION_OF, cleaned, goal_parts

OTHER = "other"
"""None of the actions: what one person did once, people who stand still, and windows without motion (a frozen frame, trembling)."""

_NAMES = (
    "walk",
    "run",
    "jump",
    "kick",
    "punch",
    "signals",
    "jumping jacks",
    "twist",
    "knee raise",
    "arm circle",
    "squat",
    "toe touch",
    "ballet",
    "basketball",
    "cartwheel",
    "charleston",
    "climb",
    "lambada",
    "pose",
    "swordplay",
)
CLASSES = (*_NAMES, OTHER)
"""What a judge tells apart."""

TESTED = CLASSES[: CLASSES.index("toe touch") + 1]
"""Classes of two subjects or more: what a judge can be tested on with people whom it has not seen."""

_LABELS = {"jog": "run", "leg kick": "kick", "toe touch one hand": "toe touch", "toe touch two hands": "toe touch"}
"""Labels of segments that are no training concepts."""
_CLASS_OF = {name: name for name in _NAMES} | _LABELS | {text: name for text, name in ACTION_OF.items() if name is not None}

STAND = "stand"
"""What the legs do in actions of arms and trunk."""
STANDING = ("punch", "signals", "twist", "arm circle", "toe touch", "swordplay")
"""Actions of arms and trunk."""
STEPPING = ("walk", "run", "kick", "knee raise", "squat", "basketball")
"""Actions of the legs, whatever the arms do."""
REVERSIBLE = ("jumping jacks", "twist", "knee raise", "arm circle", "squat", "toe touch")
"""Periodic actions: played backwards they are the same action."""
LEG_CLASSES = (*(name for name in CLASSES if name not in STANDING), STAND)
"""What a judge tells apart by the legs alone."""


def action(text: str) -> str | None:
    """The class of a description; ``None`` where it is of none, or of several one after the other."""
    return _CLASS_OF.get(cleaned(text))


def actions(goal: str) -> tuple[str, ...]:
    """The class that a goal asks for; of two joined, that of arms and trunk first, then that of the legs.

    Returns:
        Nothing where behaviour cannot be judged by the goal.
    """
    found = [action(part) for part in goal_parts(goal)]
    return tuple(name for name in found if name is not None) if None not in found and len(found) <= 2 else ()


def judged(goal: str) -> bool:
    """Whether behaviour can be judged by a goal."""
    return bool(actions(goal))


def of_legs(name: str) -> str:
    """What the legs do in an action of this class."""
    return STAND if name in STANDING else name
