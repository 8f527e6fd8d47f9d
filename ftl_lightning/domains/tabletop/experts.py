"""Scripted experts: policies that command the next hand position from the object positions.

A low hand behind the circle pushes. Any other hand rises, travels above the table, and descends behind the circle: the same rule
starts a push and restarts it when the circle has slipped away.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.recorder import reached
from ftl_lightning.domains.tabletop.interface import AROUND_BOWL, BESIDE, LIFT, MAX_STEPS, OPEN, PUSH_ON_BOOK, PUSHES
from ftl_lightning.domains.tabletop.scenes import (
    APART,
    BESIDE_AT,
    BOOK,
    BOWL,
    CIRCLE,
    COLUMNS,
    HEIGHT,
    RING,
    TARGET,
    TRIANGLE,
    WHITE,
    gap,
    outline,
    support,
    within,
)

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

Place = NDArray[np.float64]

WIDEST = 0.8  # Maximum angle in radians of a pushing hand from the line behind the circle, seen from the circle
FARTHEST = 0.12  # Maximum distance in metres of a pushing hand from the circle's centre
STEERING = 3.0
"""Steering gain: turn of the hand's direction per radian of its angle; above 1, the hand returns to the line behind the circle."""
LOW = 0.006  # Height in metres above push height below which a hand is low
CLEAR = 0.065  # Travel height in metres above push height, above all objects
NEAR, FUNNEL = 0.015, 0.03
"""Radius in metres around the point of descent in which the hand may be low, and width of the ring in which it descends."""
ACROSS, DOWN, UP = 0.016, 0.011, 0.014  # Maximum metres per step sideways, down and up
AHEAD = 0.05  # Distance in metres of the circle's next goal on the path around the bowl


@dataclass(frozen=True)
class Manner:
    """Style of a push."""

    height: float  # of the hand, in metres above the table
    speed: float  # metres per step while pushing
    haste: float = 1.0  # factor of the travel speed
    behind: float = 0.065  # start of the push in metres, behind the circle
    aside: float = 0.0  # start of the push in metres, left of the line to its goal


def pushed(hand: Place, circle: Place, goal: Place, manner: Manner) -> Place:
    """Next hand position ``(3,)`` of a push: ``hand (3,)``, centre of the ``circle (2,)`` and its ``goal (2,)`` in metres.

    For a hand at angle a behind the circle, the hand's direction differs by :data:`STEERING` times a from the circle's; a gain of 2
    is a dipole field (Igarashi et al., 2010).
    """
    along, to = complex(*(goal - circle)), complex(*(circle - hand[:2]))
    distance = abs(to)
    along /= max(abs(along), 1e-6)
    angle = math.atan2((to / along).imag, (to / along).real)
    if hand[2] <= manner.height + LOW and abs(angle) <= WIDEST and distance <= FARTHEST:
        direction = along * complex(math.cos(STEERING * angle), math.sin(STEERING * angle))
        step = manner.speed * np.array([direction.real, direction.imag])
        return np.array([*(hand[:2] + step), manner.height])
    behind = complex(-manner.behind, manner.aside) * along
    return _travelled(hand, circle + np.array([behind.real, behind.imag]), manner)


def _travelled(hand: Place, begin: Place, manner: Manner) -> Place:
    """Next position of a hand that descends at ``begin`` ``(2,)``: up first, down only above it."""
    offset = begin - hand[:2]
    distance = float(np.linalg.norm(offset))
    target = manner.height + CLEAR * min(1.0, max(0.0, (distance - NEAR) / FUNNEL))
    free = min(1.0, max(0.0, 1 - (target - hand[2]) / FUNNEL))  # a low hand rises before it moves
    step = min(distance, free * min(ACROSS * manner.haste, 0.35 * distance + 0.0005))
    rise = float(np.clip(target - hand[2], -DOWN * manner.haste, UP * manner.haste))
    return np.array([*(hand[:2] + step * offset / max(distance, 1e-9)), hand[2] + rise])


def around(circle: Place, goal: Place, bowl: Place) -> Place:
    """Next goal ``(2,)`` of the circle :data:`AHEAD` on the path: straight to the ring around the bowl, along its shorter side."""
    line = goal - circle
    distance = max(float(np.linalg.norm(line)), 1e-6)
    along = line / distance
    offset = bowl - circle
    beside, passed = float(along[0] * offset[1] - along[1] * offset[0]), float(along @ offset)
    if abs(beside) >= RING or not 0 < passed < distance:
        return goal
    side = 1.0 if beside > 0 else -1.0  # counter-clockwise is 1
    first, last = (_tangent(bowl, place, turn) for place, turn in ((circle, -side), (goal, side)))
    sweep = (side * (last - first)) % (2 * math.pi)
    angles = first + side * np.linspace(0, sweep, max(2, int(RING * sweep / 0.005)))
    arc = bowl + RING * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    path = np.concatenate((circle[None], arc, goal[None]))
    return np.array([np.interp(AHEAD, reached(path), column) for column in path.T])


def _tangent(centre: Place, place: Place, turn: float) -> float:
    """Angle on the ring around a centre of the tangent from a point."""
    offset = place - centre
    distance = max(float(np.linalg.norm(offset)), RING + 1e-6)
    return math.atan2(offset[1], offset[0]) - turn * math.acos(RING / distance)


PAST = 8  # Steps of a push after success: a policy with small position errors must not stop before the triangle
STAY = 4  # Steps at rest after a task, so that plans end at rest
CLOSED = 0.0
PUSH_HEIGHT = 0.014  # Hand height in metres above the surface under the circle during a push
GRASP_HEIGHT = 0.016
ASIDE = 0.006  # Maximum lateral offset in metres at the start of a push
SPEED = 0.008  # Push speed in metres per step
SLOWER = 1.4  # Speed divisor of pushes on the book, which adds time steps to learn from
STRAIGHT_SPEED = 0.009
TREMBLE = 0.0003  # Standard deviation of the hand noise per step, in metres
SLIPS, SLIP = 0.04, (0.006, 0.018)
"""Slip probability per step of a push, and range of sizes in metres: recovery is learned from slips (Laskey et al., 2017)."""
RETURN = 0.8  # Share of the hand's deviation from its path that remains a step later
MISLAID = 0.6  # Recoveries: probability that the circle is displaced
LYING, RISING, OVER = 0.5, 0.4, 0.03
"""Recoveries: probability of a low hand; of a higher hand beside the circle; else minimum metres above push height, over it."""
ASTRAY, REACHED = ((0.32, 0.70), (-0.28, 0.28)), ((0.26, 0.77), (-0.35, 0.35))  # Recoveries: x and y ranges of circle and hand
OPENED, HIGHEST = 0.5, 0.16  # Recoveries of picks: probability of an open hand, and maximum hand height in metres above push height
AROUND, ROOM, LONGEST_PUSH = (0.034, 0.08), 0.012, 0.33
"""Recoveries, in metres: range from hand to circle, minimum gap from circle to other objects, maximum from circle to target."""
SPREAD = {BOOK: 0.02, WHITE: 0.012, BOWL: 0.005, TRIANGLE: 0.003, CIRCLE: 0.0}
"""Maximum offset in metres of a circle that a pick places on an object."""

Moves = Generator[Place, None, None]  # Commands (4,) per step: x, y, z and gripper opening


@dataclass(frozen=True)
class Style:
    """Variation between demonstrations, drawn once per demonstration."""

    speed: float  # factor of all speeds
    behind: float  # start of a push in metres, see Manner
    aside: float
    hover: float  # travel height in metres
    grasp: Place  # x and y of the grasp relative to the circle's centre, in metres
    release: Place  # x and y of the final position relative to the goal, -1 to 1 times the spread of the task


def style(rng: np.random.Generator) -> Style:
    """Draw a style."""
    return Style(
        speed=float(rng.uniform(0.8, 1.2)),
        behind=float(rng.uniform(0.06, 0.07)),
        aside=float(rng.uniform(-ASIDE, ASIDE)),
        hover=float(rng.uniform(0.11, 0.16)),
        grasp=rng.uniform(-0.004, 0.004, 2),
        release=rng.uniform(-1, 1, 2),
    )


class _Expert:
    """State of an expert: environment, style and last command."""

    def __init__(self, env: "TableTopEnvironment", task: str, how: Style) -> None:
        self.env, self.task, self.how = env, task, how
        self.at = env.command.copy()

    def circle(self) -> Place:
        return self.env.places()[CIRCLE]

    def goal(self) -> Place:
        return self.env.places()[TARGET[self.task]][:2]

    def go(self, place: Place, speed: float, opening: float) -> Moves:
        """Move straight, with smooth start and end, at most ``speed`` metres per step. Deviations from the line decay."""
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
    """Generate the commands of a task's expert in the current scene; the environment, after reset, is not stepped.

    Args:
        height: push height in metres above the table; by default above the surface under the circle.
        feedback: whether pushes observe the circle; otherwise they go straight to the triangle's initial position.
    """
    expert = _Expert(env, task, how)
    if task not in PUSHES:
        return _pick(expert)
    above = support(env.scene, CIRCLE) + PUSH_HEIGHT if height is None else height
    return _push(expert, above) if feedback else _straight(expert, above)


def _pick(expert: _Expert) -> Moves:
    scene, how = expert.env.scene, expert.how
    if expert.at[2] < expert.circle()[2] + CLEAR:  # missed grasp: opening fingers might move the circle
        yield from expert.go(np.array([*expert.at[:2], expert.circle()[2] + CLEAR]), 0.014, float(expert.at[3]))
    circle = expert.circle()
    target, surface = _target(expert)
    over = circle[:2] + how.grasp
    yield from expert.go(np.array([*over, circle[2] + how.hover]), 0.016, OPEN)
    yield from expert.go(np.array([*over, support(scene, CIRCLE) + GRASP_HEIGHT]), 0.012, OPEN)
    yield from expert.wait(4, CLOSED)
    yield from expert.go(np.array([*over, HEIGHT[WHITE] + how.hover]), 0.014, CLOSED)
    if expert.task == LIFT:
        yield from expert.wait(6, CLOSED)
        return
    target = target - (expert.circle()[:2] - expert.at[:2])
    yield from expert.go(np.array([*target, HEIGHT[WHITE] + how.hover]), 0.016, CLOSED)
    yield from expert.go(np.array([*target, surface + GRASP_HEIGHT + 0.003]), 0.012, CLOSED)
    yield from expert.wait(3, OPEN)
    yield from expert.go(np.array([*target, surface + how.hover]), 0.014, OPEN)
    yield from expert.wait(6, OPEN)


def _target(expert: _Expert) -> tuple[Place, float]:
    """Return the goal of the circle and its surface height."""
    scene, how = expert.env.scene, expert.how
    name = TARGET[expert.task]
    if expert.task not in BESIDE:
        return scene[COLUMNS[name]][1:3].astype(np.float64) + SPREAD[name] * how.release, HEIGHT[name]
    # The side of the object where the circle lay, which is invariant to rotations of the scene.
    thing = scene[COLUMNS[name]][1:3].astype(np.float64)
    along = expert.circle()[:2] - thing
    along /= np.linalg.norm(along)
    return thing + (BESIDE_AT[name] + 0.005 * how.release[0]) * along + 0.01 * how.release[1] * np.array([-along[1], along[0]]), 0.0


def _push(expert: _Expert, height: float) -> Moves:
    """Push the circle to the task's target, with feedback."""
    how = expert.how
    speed = SPEED * how.speed / (SLOWER if expert.task == PUSH_ON_BOOK else 1.0)
    manner = Manner(height, speed, how.speed, how.behind, how.aside)
    bowl = expert.env.scene[COLUMNS[BOWL]][1:3].astype(np.float64)
    while True:
        circle, goal = expert.circle()[:2], expert.goal()
        if expert.task == AROUND_BOWL:
            goal = around(circle, goal, bowl)
        expert.at = np.array([*pushed(expert.env.command[:3], circle, goal, manner), CLOSED])
        yield expert.at


def _straight(expert: _Expert, height: float) -> Moves:
    """Push along the initial line from the circle to the task's target."""
    circle, goal = expert.circle()[:2], expert.goal()
    begin = circle - expert.how.behind * (goal - circle) / np.linalg.norm(goal - circle)
    yield from expert.go(np.array([*begin, height + 0.06]), 0.016, CLOSED)
    yield from expert.go(np.array([*begin, height]), 0.011, CLOSED)
    along = (goal - begin) / np.linalg.norm(goal - begin)
    for _ in range(MAX_STEPS):
        expert.at = np.array([*(expert.at[:2] + STRAIGHT_SPEED * along), height, CLOSED])
        yield expert.at


def led_astray(env: "TableTopEnvironment", task: str, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Start a recovery from a failure: the hand on any side of the circle, low or above it; in picks empty, open or closed.

    With probability :data:`MISLAID` the circle is displaced, also outside its initial range. Open hands are above the circle.
    """
    circle, others = env.places()[CIRCLE], {name: env.outline(name) for name in env.bodies.objects if name != CIRCLE}
    below, picks = support(env.scene, CIRCLE), task not in PUSHES
    surface, highest = others.pop(BOOK) if below > 0 else None, HIGHEST if picks else CLEAR
    while True:
        place = circle[:2]
        if rng.random() < MISLAID:
            place = place + rng.uniform(-0.03, 0.03, 2) if below > 0 else np.array([rng.uniform(*limits) for limits in ASTRAY])
        shape = outline(CIRCLE, float(place[0]), float(place[1]), 0.0)
        if surface is not None and not within(shape, surface):
            continue
        opened = picks and rng.random() < OPENED
        low, rising = not opened and rng.random() < LYING, not opened and rng.random() < RISING
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(AROUND[0] if low or rising else 0.0, AROUND[1])
        hand = place + distance * np.array([math.cos(angle), math.sin(angle)])
        height = below + PUSH_HEIGHT + (0.0 if low else rng.uniform(0, OVER) if rising else rng.uniform(OVER, highest))
        finger = outline(CIRCLE, float(hand[0]), float(hand[1]), 0.0)
        free = all(gap(shape, obstacle) >= ROOM and gap(finger, obstacle) >= APART for obstacle in others.values())
        too_far = not picks and np.linalg.norm(place - env.places()[TARGET[task]][:2]) > LONGEST_PUSH
        if free and not too_far and all(low < value < high for value, (low, high) in zip(hand, REACHED, strict=True)):
            return env.put(np.array([*hand, height]), place, OPEN if opened else CLOSED)
