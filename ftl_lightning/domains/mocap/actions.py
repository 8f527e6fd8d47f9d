"""Actions of texts: the classes of a judge.

Texts are descriptions of the CMU motion capture database, with actions in :data:`~ftl_lightning.domains.mocap.tasks.ACTION_OF`,
and labels of segments.
"""

from ftl_lightning.domains.mocap.tasks import ACTION_OF, cleaned, goal_parts

OTHER = "other"
"""No action: motions of a single person, standing people, and windows without motion (a frozen frame, trembling)."""

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
"""Classes of a judge."""

TESTED = CLASSES[: CLASSES.index("toe touch") + 1]
"""Classes of two subjects or more, on which a judge can be tested with new people."""

_LABELS = {"jog": "run", "leg kick": "kick", "toe touch one hand": "toe touch", "toe touch two hands": "toe touch"}
"""Labels of segments that are no training concepts."""
_CLASS_OF = {name: name for name in _NAMES} | _LABELS | {text: name for text, name in ACTION_OF.items() if name is not None}

STAND = "stand"
"""Class of the legs in actions of arms and trunk."""
STANDING = ("punch", "signals", "twist", "arm circle", "toe touch", "swordplay")
"""Actions of arms and trunk."""
STEPPING = ("walk", "run", "kick", "knee raise", "squat", "basketball")
"""Actions of the legs, independent of the arms."""
REVERSIBLE = ("jumping jacks", "twist", "knee raise", "arm circle", "squat", "toe touch")
"""Periodic actions, invariant to time reversal."""
LEG_CLASSES = (*(name for name in CLASSES if name not in STANDING), STAND)
"""Classes of a judge of the legs."""


def action(text: str) -> str | None:
    """Class of a description; ``None`` for no class, or several in sequence."""
    return _CLASS_OF.get(cleaned(text))


def actions(goal: str) -> tuple[str, ...]:
    """Classes of a goal; for two joined actions, arms and trunk first, then the legs.

    Returns:
        An empty tuple if the goal cannot be judged.
    """
    classes = [action(part) for part in goal_parts(goal)]
    return tuple(name for name in classes if name is not None) if None not in classes and len(classes) <= 2 else ()


def judged(goal: str) -> bool:
    """Whether a goal can be judged."""
    return bool(actions(goal))


def of_legs(name: str) -> str:
    """Class of the legs in an action."""
    return STAND if name in STANDING else name
