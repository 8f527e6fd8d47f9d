"""Scripted experts: each says where the hand should go next, from where the objects are."""

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.tabletop.distractors import scattered
from ftl_lightning.domains.tabletop.interface import IMAGE, MAX_STEPS, OPEN, POSE
from ftl_lightning.domains.tabletop.pushing import CLEAR, Manner, Place, around, pushed
from ftl_lightning.domains.tabletop.scenes import (
    APART,
    BOOK,
    BOWL,
    CIRCLE,
    COLUMNS,
    HEIGHT,
    TARGET,
    WHITE,
    gap,
    outline,
    support,
    within,
)
from ftl_lightning.domains.tabletop.success import judged
from ftl_lightning.domains.tabletop.tasks import AROUND_BOWL, PUSH_ON_BOOK, PUSHES, TO_BOOK, TO_WHITE

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

CLOSED = 0.0
PUSH_HEIGHT = 0.014
"""Metres of the hand above what the circle stands on while it pushes."""
GRASP_HEIGHT = 0.016
ASIDE = 0.006
"""Metres beside the line at which a push begins at most."""
SPEED = 0.008
"""Metres a step of a push."""
SLOWER = 1.4
"""On the book pushes are slower by this factor, which gives more moments to learn from."""
STRAIGHT_SPEED = 0.009
TREMBLE = 0.0003
"""Metres, standard deviation of what each step of the hand is off."""
SLIPS, SLIP = 0.04, (0.006, 0.018)
"""How often the hand slips in a step of a push, and by how many metres: only demonstrations that leave the way show how to come
back to it (Laskey et al., 2017). A hand that always wanders shows it too, but hides the way under its noise."""
RETURN = 0.8
"""Share of what the hand is off its way that is left a step later."""
MISLAID = 0.6
"""How often the circle lies elsewhere where a push begins anew."""
LYING, RISING, OVER = 0.5, 0.4, 0.03
"""How often the hand is low there, how often else it is beside the circle, and metres above the height of pushing from which on it
may be over it."""
ASTRAY, REACHED = ((0.32, 0.70), (-0.28, 0.28)), ((0.26, 0.77), (-0.35, 0.35))
"""x and y of circle and hand there."""
OPENED = 0.5
"""How often a hand that picks is open there."""
HIGHEST = 0.16
"""Metres above the height of pushing at which a hand that picks is at most there."""
AROUND, ROOM, FARTHEST_PUSH = (0.034, 0.08), 0.012, 0.33
"""Metres from circle to hand, from the circle to other things at least, and to the triangle at most, there."""
APART_FROM = 0.12
"""Metres between a thing and the circle that is put down beside it, centre to centre: the fingers, which open, need room."""

Moves = Generator[Place, None, None]
"""Places ``(4,)`` to go to, one a step: x, y, z and opening."""


@dataclass(frozen=True)
class Style:
    """What varies between two demonstrations, drawn once for each.

    Attributes:
        speed: factor of all speeds.
        behind, aside: metres behind the circle, and to the left of the line to where it goes, at which a push begins.
        hover: height in metres at which the hand travels.
        grasp, place: metres, beside the circle's centre and beside where it is put.
    """

    speed: float
    behind: float
    aside: float
    hover: float
    grasp: Place
    place: Place


def style(rng: np.random.Generator) -> Style:
    """At random."""
    return Style(
        speed=float(rng.uniform(0.8, 1.2)),
        behind=float(rng.uniform(0.06, 0.07)),
        aside=float(rng.uniform(-ASIDE, ASIDE)),
        hover=float(rng.uniform(0.11, 0.16)),
        grasp=rng.uniform(-0.004, 0.004, 2),
        place=rng.uniform(-1, 1, 2),
    )


class _Expert:
    """What an expert knows: the world as it is, its style, and where it went last."""

    def __init__(self, env: "TableTopEnvironment", task: str, how: Style) -> None:
        self.env, self.task, self.how = env, task, how
        self.at = env.command.copy()

    def circle(self) -> Place:
        return self.env.places()[CIRCLE]

    def go(self, place: Place, speed: float, opening: float) -> Moves:
        """Straight there, with a soft start and end; metres a step at most. A hand that is off this way comes back to it."""
        start, goal = self.at[:3].copy(), np.asarray(place, dtype=np.float64)
        before = start
        steps = max(2, math.ceil(1.3 * float(np.linalg.norm(goal - start)) / (speed * self.how.speed)))
        for number in range(1, steps + 1):
            share = number / steps
            share -= 0.3 * math.sin(2 * math.pi * share) / (2 * math.pi)
            off, before = self.env.command[:3] - before, start + share * (goal - start)
            self.at = np.array([*before, opening])
            yield self.at + np.array([*(RETURN * off), 0.0])

    def wait(self, steps: int, opening: float) -> Moves:
        self.at = np.array([*self.at[:3], opening])
        for _ in range(steps):
            yield self.at + np.array([*(RETURN * (self.env.command[:3] - self.at[:3])), 0.0])


def moves(env: "TableTopEnvironment", task: str, how: Style, height: float | None = None, feedback: bool = True) -> Moves:
    """What the expert of a task does in the scene in which the environment is.

    Args:
        env: reset; it is looked at, not stepped.
        task: known.
        how: the demonstration's style.
        height: of pushes, in metres above the table; by default above what the circle stands on.
        feedback: whether pushes look where the circle is; else they go straight to where the triangle is in the beginning.
    """
    expert = _Expert(env, task, how)
    if task not in PUSHES:
        return _pick(expert)
    above = support(env.scene, CIRCLE) + PUSH_HEIGHT if height is None else height
    return _push(expert, above) if feedback else _straight(expert, above)


def _pick(expert: _Expert) -> Moves:
    scene, how = expert.env.scene, expert.how
    if expert.at[2] < expert.circle()[2] + CLEAR:  # a grasp has missed; fingers that open here might move the circle
        yield from expert.go(np.array([*expert.at[:2], expert.circle()[2] + CLEAR]), 0.014, float(expert.at[3]))
    circle = expert.circle()
    target, surface = _target(expert)
    over = circle[:2] + how.grasp
    yield from expert.go(np.array([*over, circle[2] + how.hover]), 0.016, OPEN)
    yield from expert.go(np.array([*over, support(scene, CIRCLE) + GRASP_HEIGHT]), 0.012, OPEN)
    yield from expert.wait(4, CLOSED)
    yield from expert.go(np.array([*over, HEIGHT[WHITE] + how.hover]), 0.014, CLOSED)
    target = target - (expert.circle()[:2] - expert.at[:2])
    yield from expert.go(np.array([*target, HEIGHT[WHITE] + how.hover]), 0.016, CLOSED)
    yield from expert.go(np.array([*target, surface + GRASP_HEIGHT + 0.003]), 0.012, CLOSED)
    yield from expert.wait(3, OPEN)
    yield from expert.go(np.array([*target, surface + how.hover]), 0.014, OPEN)
    yield from expert.wait(6, OPEN)


def _target(expert: _Expert) -> tuple[Place, float]:
    """Where the circle is put, and how high that is."""
    scene, how = expert.env.scene, expert.how
    if expert.task in (TO_BOOK, TO_WHITE):
        name, spread = (BOOK, 0.02) if expert.task == TO_BOOK else (WHITE, 0.012)
        return scene[COLUMNS[name]][1:3].astype(np.float64) + spread * how.place, HEIGHT[name]
    # On the side of the thing where it lay: which one that is does not change when the scene is turned.
    thing = scene[COLUMNS[TARGET[expert.task]]][1:3].astype(np.float64)
    along = expert.circle()[:2] - thing
    along /= np.linalg.norm(along)
    return thing + (APART_FROM + 0.005 * how.place[0]) * along + 0.01 * how.place[1] * np.array([-along[1], along[0]]), 0.0


def _behind(expert: _Expert, goal: Place) -> Place:
    """Where a push of the circle towards a goal begins that is made without looking."""
    circle = expert.circle()[:2]
    return circle - expert.how.behind * (goal - circle) / np.linalg.norm(goal - circle)


def _goal(expert: _Expert) -> Place:
    return expert.env.places()[TARGET[expert.task]][:2]


def _push(expert: _Expert, height: float) -> Moves:
    """Bring the circle to what the task names, looking where it goes."""
    how = expert.how
    speed = SPEED * how.speed / (SLOWER if expert.task == PUSH_ON_BOOK else 1.0)
    manner = Manner(height, speed, how.speed, how.behind, how.aside)
    bowl = expert.env.scene[COLUMNS[BOWL]][1:3].astype(np.float64)
    while True:
        circle, goal = expert.circle()[:2], _goal(expert)
        if expert.task == AROUND_BOWL:
            goal = around(circle, goal, bowl)
        expert.at = np.array([*pushed(expert.env.command[:3], circle, goal, manner), CLOSED])
        yield expert.at


def _straight(expert: _Expert, height: float) -> Moves:
    """Push on the line from the circle to what the task names as they lie in the beginning."""
    goal = _goal(expert).copy()
    begin = _behind(expert, goal)
    yield from expert.go(np.array([*begin, height + 0.06]), 0.016, CLOSED)
    yield from expert.go(np.array([*begin, height]), 0.011, CLOSED)
    along = (goal - begin) / np.linalg.norm(goal - begin)
    for _ in range(MAX_STEPS):
        expert.at = np.array([*(expert.at[:2] + STRAIGHT_SPEED * along), height, CLOSED])
        yield expert.at


@dataclass(frozen=True)
class Episode:
    """What an expert did.

    Attributes:
        commands: ``(time, 4)``, where the hand was told to be; the first is where it starts.
        actions: ``(steps, 4)``, what the environment was given; of an action that is too far away it goes the first part alone.
        images: ``(time, 3, 64, 64)`` uint8.
        poses: ``(time, 8)``, as measured.
        success: whether it did the task.
        places: ``(time, 5, 4)``, what is where in the pictures; known where distractors are scattered.
    """

    commands: NDArray[np.float32]
    actions: NDArray[np.float32]
    images: NDArray[np.uint8]
    poses: NDArray[np.float32]
    success: bool
    places: NDArray[np.float32] | None = None


Begin = Callable[["TableTopEnvironment", str, np.random.Generator], dict[str, NDArray[Any]]]
"""``(environment, task, what is random) -> what is seen where a demonstration begins``."""
PAST = 8
"""Steps that a push goes on after it has succeeded: who sees distances a little wrong would stop before the triangle."""
STAY = 4
"""Steps that the hand stays after a task is done, so that plans end at rest."""


def perform(
    env: "TableTopEnvironment",
    task: str,
    scene: NDArray[np.float32],
    rng: np.random.Generator,
    height: float | None = None,
    feedback: bool = True,
    scatter: bool = False,
    begin: Begin | None = None,
) -> Episode:
    """One episode of the expert of a task.

    Args:
        env: any; it is reset.
        task: known.
        scene: of it.
        rng: draws its style and its noise.
        height, feedback: see :func:`moves`.
        scatter: whether distractors lie elsewhere in each picture, see :mod:`ftl_lightning.domains.tabletop.distractors`.
        begin: what happens in the scene before the demonstration begins, such as :func:`led_astray`; nothing for ``None``.

    Raises:
        UserError: for a scene that cannot be built.
    """
    seen, told = env.reset(options={"scene": scene})
    if begin is not None:
        seen = begin(env, task, rng)
    how = style(rng)
    commands, images, poses = [env.command.copy()], [seen[IMAGE]], [seen[POSE]]
    actions: list[NDArray[np.float32]] = []
    ended, success = None, False
    for command in moves(env, task, how, height, feedback):
        off = TREMBLE * rng.standard_normal(3)
        angle, size, slips = rng.uniform(-math.pi, math.pi), rng.uniform(*SLIP), rng.random() < SLIPS
        if slips and task in PUSHES and feedback:  # who does not look cannot come back
            off[:2] += size * np.array([math.cos(angle), math.sin(angle)])
        actions.append((command + np.array([*off, 0.0])).astype(np.float32))
        seen, _, terminated, truncated, told = env.step(actions[-1])
        commands.append(env.command.copy())
        images.append(seen[IMAGE])
        poses.append(seen[POSE])
        done = judged(task, env.scene, told)
        if ended is None and (terminated or truncated or (done and task in PUSHES)):
            ended, success = len(actions), done
        if ended is not None and len(actions) >= ended + (PAST if success and task in PUSHES else 0):
            break
    places = None
    if scatter:
        pictures, places = scattered(env, task, told["trace"], rng)
        images, places = list(pictures), _stayed(list(places))
    return Episode(
        _stayed(commands).astype(np.float32),
        np.stack(actions),
        _stayed(images),
        _stayed(poses).astype(np.float32),
        success,
        places,
    )


def _stayed(values: list[Any]) -> NDArray[Any]:
    return np.stack([*values, *[values[-1]] * STAY])


def led_astray(env: "TableTopEnvironment", task: str, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
    """What is seen where a task begins anew after it went wrong: the hand at any side of the circle, low or above it, and the
    circle, in :data:`MISLAID` of the episodes, elsewhere on the table, also beyond where it begins else. A hand that picks may
    be open above the circle, or closed and empty anywhere.

    Args:
        env: reset to a scene of the task, which is changed.
        task: known.
        rng: draws both.
    """
    circle, others = env.places()[CIRCLE], {name: env.outline(name) for name in env.bodies.objects if name != CIRCLE}
    below, picks = support(env.scene, CIRCLE), task not in PUSHES
    highest = HIGHEST if picks else CLEAR
    on_book = below > 0
    surface = others.pop(BOOK) if on_book else None
    while True:
        place = circle[:2]
        if rng.random() < MISLAID:
            place = place + rng.uniform(-0.03, 0.03, 2) if on_book else np.array([rng.uniform(*limits) for limits in ASTRAY])
        shape = outline(CIRCLE, float(place[0]), float(place[1]), 0.0)
        if surface is not None and not within(shape, surface):
            continue
        opened = picks and rng.random() < OPENED
        low, rising = not opened and rng.random() < LYING, not opened and rng.random() < RISING
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(AROUND[0] if low or rising else 0.0, AROUND[1])
        hand = place + distance * np.array([math.cos(angle), math.sin(angle)])
        height = below + PUSH_HEIGHT + (0.0 if low else rng.uniform(0, OVER) if rising else rng.uniform(OVER, highest))
        finger = outline(CIRCLE, float(hand[0]), float(hand[1]), 0.0)
        free = all(gap(shape, other) >= ROOM and gap(finger, other) >= APART for other in others.values())
        far = not picks and np.linalg.norm(place - env.places()[TARGET[task]][:2]) > FARTHEST_PUSH
        if free and not far and all(low < value < high for value, (low, high) in zip(hand, REACHED, strict=True)):
            return env.put(np.array([*hand, height]), place, OPEN if opened else CLOSED)
