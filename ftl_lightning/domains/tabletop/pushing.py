"""Feedback policy of a push: the next hand position as a function of the current positions alone.

A low hand behind the circle pushes. Any other hand rises, travels above the table, and descends behind the circle. The same rule
thus starts a push and restarts it when the circle has slipped away, without memory.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.tabletop.scenes import RING

Place = NDArray[np.float64]

WIDEST = 0.8
"""Maximum angle in radians of a pushing hand from the line behind the circle, seen from the circle."""
FARTHEST = 0.12
"""Maximum distance in metres of a pushing hand from the circle's centre."""
STEERING = 3.0
"""Steering gain: deviation of the hand's direction from the circle's, per radian of the hand's angle. 1 moves straight to the
circle's centre, larger values return to the line behind it."""
LOW = 0.006
"""Height in metres above push height below which a hand is low."""
CLEAR = 0.065
"""Travel height in metres above push height, above all objects."""
NEAR, FUNNEL = 0.015, 0.03
"""Distances in metres from the point of descent: radius in which the hand may be low, and width of the funnel above it. The radius
exceeds the spread of this point between demonstrations; otherwise their mean would stay in the air."""
ACROSS, DOWN, UP = 0.016, 0.011, 0.014
"""Maximum metres per step sideways, down and up."""
AHEAD = 0.05
"""Distance in metres of the circle's next goal on the path around the bowl."""


@dataclass(frozen=True)
class Manner:
    """Style of a push.

    Attributes:
        height: hand height in metres above the table.
        speed: metres per step while pushing.
        haste: factor of the travel speed.
        behind, aside: start of the push in metres, behind the circle and left of the line to its goal.
    """

    height: float
    speed: float
    haste: float = 1.0
    behind: float = 0.065
    aside: float = 0.0


def pushed(hand: Place, circle: Place, goal: Place, manner: Manner) -> Place:
    """Next hand position ``(3,)`` of a push of the circle to a goal.

    For a hand at angle a behind the circle, the hand's direction differs by :data:`STEERING` times a from the circle's; a gain of 2
    is a dipole field (Igarashi et al., 2010).

    Args:
        hand: ``(3,)``.
        circle, goal: ``(2,)``, the circle's centre and its goal; metres.
        manner: style of the push.
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
    off = begin - hand[:2]
    away = float(np.linalg.norm(off))
    wanted = manner.height + CLEAR * min(1.0, max(0.0, (away - NEAR) / FUNNEL))
    free = min(1.0, max(0.0, 1 - (wanted - hand[2]) / FUNNEL))  # a low hand rises before it moves
    step = min(away, free * min(ACROSS * manner.haste, 0.35 * away + 0.0005))
    rise = float(np.clip(wanted - hand[2], -DOWN * manner.haste, UP * manner.haste))
    return np.array([*(hand[:2] + step * off / max(away, 1e-9)), hand[2] + rise])


def around(circle: Place, goal: Place, bowl: Place) -> Place:
    """Next goal ``(2,)`` of the circle on the way around the bowl to a goal, :data:`AHEAD` along the path.

    The path leads straight to the ring around the bowl, along its shorter side, and straight on.

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
    """Point on a path ``(n, 2)`` at a distance from its start, or its end."""
    travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    return np.array([np.interp(distance, travelled, column) for column in way.T])


def _cross(first: Sequence[float] | Place, second: Sequence[float] | Place) -> float:
    return float(first[0] * second[1] - first[1] * second[0])


def _tangent(centre: Place, place: Place, turn: float) -> float:
    """Angle on the ring around a centre of the tangent from a point."""
    off = place - centre
    distance = max(float(np.linalg.norm(off)), RING + 1e-6)
    return math.atan2(off[1], off[0]) - turn * math.acos(RING / distance)
