"""Which action a text names, as data: the classes that a judge tells apart.

The texts are descriptions of the CMU motion capture database, as :func:`~ftl_lightning.domains.mocap.tasks.cleaned`, and labels of
segments.
"""

from collections.abc import Mapping

from ftl_lightning.domains.mocap.tasks import cleaned, goal_parts

OTHER = "other"
"""None of the actions: what one person did once, people who stand still, and windows without motion (a frozen frame, trembling)."""

_ACTIONS: Mapping[str, tuple[str, ...]] = {
    "walk": (
        "brisk walk",
        "navigate - walk forward, backward, sideways",
        "slow walk",
        "slow walk/stride",
        "walk on uneven terrain",
        "walk, 90-degree left turn",
        "walk, 90-degree right turn",
        "walk, exaggerated stride",
        "walk, veer left",
        "walk, veer right",
        "walk/stride",
        "zombie walk",
    ),
    "run": ("jog", "run/jog"),
    "jump": (
        "forward jump",
        "jump up and down, hop on one foot",
        "jump, balance",
        "playground - forward jumps, turn around",
        "start hop stop",
    ),
    "kick": ("leg kick", "soccer - kick ball"),
    "punch": ("punch/strike",),
    "signals": ("basketball signals", "direct traffic, wave, point"),
    "jumping jacks": (),
    "twist": (),
    "knee raise": (),
    "arm circle": (),
    "squat": (),
    "toe touch": ("toe touch one hand", "toe touch two hands"),
    "ballet": (
        "dance - arms held high, pointe tendue a terre, upper body rotation",
        "dance - attitude/arabesque, jete en tourant, bending back",
        "dance - coupe dessous, grand jete en tourant",
        "dance - coupe dessous, jete en tourant",
        "dance - expressive arms, pirouette",
        "dance - glissade devant, glissade derriere, attitude/arabesque",
        "dance - quasi-cou-de-pied, raised leg above hip-height, jete en tourant",
        "dance - retire derriere, attitude/arabesque",
        "dance - rond de jambe in the air, jete, turn",
        "dance - sideways arabesque, folding arms, bending back",
        "dance - sideways arabesque, turn step, folding arms",
        "dance - sideways steps, pirouette",
        "dance - small jetes, attitude/arabesque, shifted-axis pirouette, turn",
        "dance - small jetes, pirouette",
    ),
    "basketball": (
        "basketball - backward dribble",
        "basketball - crossover dribble, shoot",
        "basketball - dribble, shoot",
        "basketball - forward dribble",
        "basketball - forward dribble, 90-degree left turns",
        "basketball - forward dribble, 90-degree right turns",
        "basketball - forward dribble, 90-degree right turns, crossover dribble",
        "basketball - low, fast free style dribble, dribble through legs",
        "basketball - sideways dribble",
    ),
    "cartwheel": ("cartwheels", "dance - cartwheel-like start, pirouettes, jete"),
    "charleston": ("charleston side by side female", "charleston side by side male"),
    "climb": (
        "playground - climb",
        "playground - climb, go under",
        "playground - climb, go under, jump down",
        "playground - climb, hang, hold self up with arms straight, swing, drop, sit, dangle legs, go under",
        "playground - climb, hang, lean over, jump down",
        "playground - climb, hang, swing",
        "playground - climb, jump down, dangle, legs push off against",
        "playground - climb, pull up, dangle, sit, lower self to ground",
        "playground - climb, sit, dangle legs, descend",
        "playground - climb, sit, dangle legs, jump down",
        "playground - climb, sit, dangle legs, rock back, lower self to ground",
        "playground - climb, swing, lean back, drop",
    ),
    "lambada": ("lambada dance",),
    "pose": (
        "balance on one leg, outstretched arms",
        "dance - arms held high, side arabesque",
        "dance - fold in from side arabesque, curl inwards",
        "dance - lean back on bent leg, balance, bend elbow by ear",
        "dance - lean forward, bring back leg forward, arching arms",
        "static dance pose - folded in, head lowered, leg bent",
    ),
    "swordplay": (),
}
"""What each class is called besides its own name. Dances are no class together: each kind was danced by one subject alone."""

CLASSES = (*_ACTIONS, OTHER)
"""What a judge tells apart."""

TESTED = CLASSES[: CLASSES.index("toe touch") + 1]
"""Classes of two subjects or more: what a judge can be tested on with people whom it has not seen."""

_CLASS_OF = {name: name for name in _ACTIONS} | {text: name for name, texts in _ACTIONS.items() for text in texts}

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
