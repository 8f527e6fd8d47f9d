"""Descriptions: what is pretrained on, what is learned from a few demonstrations, what is held out.

Training concepts are descriptions of trials by the database (``cmu-mocap-index.csv``, compiled by B. Hahne from mocap.cs.cmu.edu),
as :func:`cleaned`. Of the others no trial is pretrained on.
"""

import re

from ftl_lightning.domains.tasks import EvaluationTask, Suite

HELD_OUT = ("13_29", "13_30", "13_31", "14_14", "14_20", "79_01", "80_71", "126_03", "126_04", "126_05")
"""Trials that pretraining never sees: those that show a new concept, whole."""
DEMONSTRATORS = ("13", "79", "80", "126")
"""Subjects who demonstrate new concepts. A judge is trained on others."""
TRAINING_CONCEPTS = (
    "acrobatics - spin/twirl, hang on ropes",
    "backflip",
    "balance on one leg, outstretched arms",
    "basketball - backward dribble",
    "basketball - crossover dribble, shoot",
    "basketball - dribble, shoot",
    "basketball - forward dribble",
    "basketball - forward dribble, 90-degree left turns",
    "basketball - forward dribble, 90-degree right turns",
    "basketball - forward dribble, 90-degree right turns, crossover dribble",
    "basketball - low, fast free style dribble, dribble through legs",
    "basketball - sideways dribble",
    "basketball signals",
    "bend over, scoop up, rise, lift arm",
    "brisk walk",
    "cartwheel",
    "cartwheels",
    "charleston side by side female",
    "charleston side by side male",
    "dance - arms held high, pointe tendue a terre, upper body rotation",
    "dance - arms held high, side arabesque",
    "dance - attitude/arabesque, jete en tourant, bending back",
    "dance - cartwheel-like start, pirouettes, jete",
    "dance - coupe dessous, grand jete en tourant",
    "dance - coupe dessous, jete en tourant",
    "dance - expressive arms, pirouette",
    "dance - fold in from side arabesque, curl inwards",
    "dance - glissade devant, glissade derriere, attitude/arabesque",
    "dance - lean back on bent leg, balance, bend elbow by ear",
    "dance - lean forward, bring back leg forward, arching arms",
    "dance - quasi-cou-de-pied, raised leg above hip-height, jete en tourant",
    "dance - retire derriere, attitude/arabesque",
    "dance - rond de jambe in the air, jete, turn",
    "dance - sideways arabesque, folding arms, bending back",
    "dance - sideways arabesque, turn step, folding arms",
    "dance - sideways steps, pirouette",
    "dance - small jetes, attitude/arabesque, shifted-axis pirouette, turn",
    "dance - small jetes, pirouette",
    "direct traffic, wave, point",
    "forward jump",
    "heian shodan",
    "jump",
    "jump up and down, hop on one foot",
    "jump, balance",
    "jumps kicks and punches",
    "lambada dance",
    "navigate - walk forward, backward, sideways",
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
    "playground - forward jumps, turn around",
    "punch/strike",
    "run",
    "run, leap",
    "run/jog",
    "slow walk",
    "slow walk/stride",
    "soccer - kick ball",
    "start hop stop",
    "static dance pose - folded in, head lowered, leg bent",
    "swordplay",
    "walk",
    "walk on uneven terrain",
    "walk, 90-degree left turn",
    "walk, 90-degree right turn",
    "walk, exaggerated stride",
    "walk, veer left",
    "walk, veer right",
    "walk/stride",
    "walking, sitting, looking, stand up",
    "wash self",
    "wash windows",
    "zombie walk",
)
PAPER_CONCEPTS = ("jumping jacks", "arm circle")
VALIDATION_CONCEPTS = ("knee raise",)
DATABASE_CONCEPTS = ("chop wood", "breaststroke")
"""New concepts of the paper whose trials few copies of the database hold."""
NEW_CONCEPTS = (*PAPER_CONCEPTS, *VALIDATION_CONCEPTS, *DATABASE_CONCEPTS)
AND = " + "
"""Between the parts of a goal that asks for several concepts at once."""
COMPOSED_WITH = ("walk", "jump")
_RENAMED = {"zombiewalk": "zombie walk", "heiansyodan": "heian shodan"}
_SIDES = {"left": "right", "right": "left"}


def cleaned(description: str) -> str:
    """A description of the database in lower case, with spaces for underscores and one at a time."""
    text = " ".join(description.lower().replace("_", " ").split())
    return _RENAMED.get(text, text)


def mirrored_text(text: str) -> str:
    """The description of the mirror image: left and right exchanged."""
    return re.sub(r"\b(left|right)\b", lambda side: _SIDES[side[0]], text)


def goal_parts(goal: str) -> tuple[str, ...]:
    """The concepts of a goal, mostly one."""
    return tuple(goal.split(AND))


def _new(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """From new poses, and from those that the demonstrations start in."""
    return (
        *(EvaluationTask("new concept", text, (text,)) for text in concepts),
        *(EvaluationTask("new concept, demonstrated poses", text, (text,), initial="demonstrated") for text in concepts),
    )


def _pairs(concepts: tuple[str, ...]) -> list[tuple[str, str]]:
    return [(text, other) for text in concepts for other in COMPOSED_WITH]


def _composed(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """With the same weights on the whole body."""
    return tuple(EvaluationTask("new + training", AND.join(pair), pair[:1], pair[1:]) for pair in _pairs(concepts))


def _by_parts(concepts: tuple[str, ...]) -> tuple[EvaluationTask, ...]:
    """With each concept on its own parts of the body."""
    return tuple(
        EvaluationTask(
            "new + training, by parts of the body",
            AND.join(pair),
            pair[:1],
            pair[1:],
            on=((pair[0], ("arms", "trunk")), (pair[1], ("legs",))),
        )
        for pair in _pairs(concepts)
    )


SUITES = {
    "paper": Suite(_new(PAPER_CONCEPTS)),
    "composition": Suite((*_composed(PAPER_CONCEPTS), *_by_parts(PAPER_CONCEPTS))),
    "whole": Suite(_composed(PAPER_CONCEPTS)),
    "database": Suite(_new(DATABASE_CONCEPTS)),
    "validation": Suite(_new(VALIDATION_CONCEPTS)),
}
"""``'paper'`` is for final evaluation alone, ``'validation'`` for tuning; ``'database'`` needs the trials of
:data:`DATABASE_CONCEPTS` in the user's copy. ``'whole'`` is the part of ``'composition'`` for methods that cannot compose by parts
of the body."""
