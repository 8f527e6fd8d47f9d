"""How an expert pushes: where the hand goes next, from where things are now alone.

The hand pushes while it is low and behind the circle. Wherever else it is, it goes up, over the table, and comes down behind the
circle. So the same rule begins a push and begins it again when the circle has slipped away, and nothing has to be remembered.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.tabletop.scenes import RING

Place = NDArray[np.float64]

WIDEST = 0.8
"""Radians from the line behind the circle, seen from the circle, up to which the hand pushes on."""
FARTHEST = 0.12
"""Metres from the circle's centre up to which a low hand pushes on."""
STEERING = 3.0
"""Radians that the hand's direction differs from the circle's for each radian that the hand is off the line behind it: 1 goes
straight for the circle's centre, more gets back to that line."""
LOW = 0.006
"""Metres above the height of pushing below which a hand counts as low."""
CLEAR = 0.065
"""Metres above the height of pushing at which the hand travels: above everything on the table."""
NEAR, FUNNEL = 0.015, 0.03
"""Metres from where it comes down: nearer than the first the hand may be low, and so much farther it has to be clear. The first is
more than demonstrations differ in where they come down, or their mean is to stay in the air."""
ACROSS, DOWN, UP = 0.016, 0.011, 0.014
"""Metres a step at most, off the line, down and up."""
AHEAD = 0.05
"""Metres on the way around the bowl, by which what the circle is pushed to is ahead of it."""


@dataclass(frozen=True)
class Manner:
    """How a push is done.

    Attributes:
        height: metres of the hand above the table.
        speed: metres a step, of a hand that pushes.
        haste: factor of the speed of a hand that travels.
        behind, aside: metres behind the circle, and to the left of the line to where it goes, at which a push begins.
    """

    height: float
    speed: float
    haste: float = 1.0
    behind: float = 0.065
    aside: float = 0.0


def pushed(hand: Place, circle: Place, goal: Place, manner: Manner) -> Place:
    """Where the hand goes next ``(3,)`` to push the circle to a goal.

    The direction of a hand at an angle a behind the circle is :data:`STEERING` times a from the circle's; with 2 that is a dipole
    field (Igarashi et al., 2010).

    Args:
        hand: ``(3,)``.
        circle, goal: ``(2,)``, its centre and where that should go; metres.
        manner: of the push.
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
    """Where a hand goes that has to come down at a place ``(2,)``: up first, and down only above it."""
    off = begin - hand[:2]
    away = float(np.linalg.norm(off))
    wanted = manner.height + CLEAR * min(1.0, max(0.0, (away - NEAR) / FUNNEL))
    free = min(1.0, max(0.0, 1 - (wanted - hand[2]) / FUNNEL))  # a hand that is too low rises before it moves
    step = min(away, free * min(ACROSS * manner.haste, 0.35 * away + 0.0005))
    rise = float(np.clip(wanted - hand[2], -DOWN * manner.haste, UP * manner.haste))
    return np.array([*(hand[:2] + step * off / max(away, 1e-9)), hand[2] + rise])


def around(circle: Place, goal: Place, bowl: Place) -> Place:
    """Where the circle should go next ``(2,)`` to come to a goal around the bowl: a place :data:`AHEAD` on its way.

    The way goes straight to the ring around the bowl, along it on the side where it is shorter, and straight on.

    Args:
        circle, goal, bowl: centres ``(2,)``.
    """
    line = goal - circle
    distance = max(float(np.linalg.norm(line)), 1e-6)
    along = line / distance
    beside, passed = _cross(along, bowl - circle), float(along @ (bowl - circle))
    if abs(beside) >= RING or not 0 < passed < distance:
        return goal
    side = 1.0 if beside > 0 else -1.0  # counter-clockwise is 1
    first, last = (_tangent(bowl, place, turn) for place, turn in ((circle, -side), (goal, side)))
    sweep = (side * (last - first)) % (2 * math.pi)
    angles = first + side * np.linspace(0, sweep, max(2, int(RING * sweep / 0.005)))
    arc = bowl + RING * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    return _on(np.concatenate((circle[None], arc, goal[None])), AHEAD)


def _on(way: Place, distance: float) -> Place:
    """The place on a way ``(n, 2)`` at a distance from its start, or its end."""
    travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    return np.array([np.interp(distance, travelled, column) for column in way.T])


def _cross(one: Sequence[float] | Place, other: Sequence[float] | Place) -> float:
    return float(one[0] * other[1] - one[1] * other[0])


def _tangent(centre: Place, place: Place, turn: float) -> float:
    """Angle on the ring around a centre where the line from a place touches it."""
    off = place - centre
    distance = max(float(np.linalg.norm(off)), RING + 1e-6)
    return math.atan2(off[1], off[0]) - turn * math.acos(RING / distance)
