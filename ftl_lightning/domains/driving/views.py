"""How a model may see traffic: as it stands on the map, or from the controlled vehicle."""

import torch
from torch import Tensor

from ftl_lightning.domains.domain import View
from ftl_lightning.domains.driving.environment import INITIAL, OBSERVED, STATE
from ftl_lightning.domains.driving.scenarios import SCENARIOS, VEHICLES, decision_seconds
from ftl_lightning.errors import UserError

SECONDS = torch.tensor([decision_seconds(name) for name in SCENARIOS])
"""Between two decisions, by the number of the scenario."""
NEAR = 20.0
"""Metres; distances far beyond look alike, or a gap of some metres would be lost beside the hundred that can be seen."""
_PAIRS = ((1, 3, 5), (2, 4, 6))
"""Columns of a direction and the one across."""


def _vehicles(initial_states: Tensor) -> Tensor:
    """What is observed ``(sample, 5, 7)``, without what no model sees.

    Raises:
        UserError: for initial states of another size.
    """
    if initial_states.shape[-1] != INITIAL:
        raise UserError(f"key 'initial_states': expected {INITIAL} numbers each, found {initial_states.shape[-1]}")
    return initial_states[:, :OBSERVED].unflatten(-1, (VEHICLES, STATE))


def _turned(pairs: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """``(..., 2)`` turned by an angle."""
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def _seen_from(states: Tensor, ego: Tensor) -> Tensor:
    """States ``(sample, n, 7)`` seen from a vehicle ``(sample, 7)``: places from it, directions from its own."""
    cos, sin = ego[:, None, 5], ego[:, None, 6]
    presence, place, velocity, heading = states.split((1, 2, 2, 2), dim=-1)
    parts = (place - ego[:, None, 1:3], velocity, heading)
    return torch.cat((presence, *(_turned(part, cos, -sin) for part in parts)), dim=-1)


def _observe_from_ego(initial_states: Tensor) -> Tensor:
    """The controlled vehicle's speed, and the others seen from it, those that are none at 0 ``(7 + 4 * 7)``.

    Not its place on the map: that tells the four training scenarios apart without a concept, and says nothing on a new road.
    """
    vehicles = _vehicles(initial_states)
    ego, others = vehicles[:, 0], vehicles[:, 1:]
    seen = _seen_from(others, ego)
    presence, place, velocity, heading = seen.split((1, 2, 2, 2), dim=-1)
    near = place * NEAR / (NEAR + place.norm(dim=-1, keepdim=True))
    seen = torch.cat((presence, near, velocity - _speed(ego)[:, None], heading), dim=-1) * presence
    none = torch.zeros_like(ego[:, :3])
    return torch.cat((none, ego[:, 3:5].norm(dim=-1, keepdim=True), none, seen.flatten(1)), dim=-1)


def _speed(states: Tensor) -> Tensor:
    """Velocity ``(sample, 2)`` of states ``(sample, 7)``, along and across their own headings."""
    return _turned(states[:, 3:5], states[:, 5], -states[:, 6])


def _seconds(step: int, initial_states: Tensor) -> Tensor:
    """Between the state that comes before a plan's step and the one there ``(sample, 1)``: a plan's first is the present."""
    return SECONDS[initial_states[:, OBSERVED].long(), None] * min(step, 1)


def _encode_steps(states: Tensor, initial_states: Tensor) -> Tensor:
    """How each state ``(sample, horizon, 7)`` differs from the one before kept at its speed; the first, from the present.

    Presence; metres along and across the mean of both headings, which for a curve are its length and 0; metres a second along and
    across the own heading; cosine and sine of the turn.
    """
    found, before = [], _vehicles(initial_states)[:, 0]
    for step, state in enumerate(states.unbind(dim=1)):
        turn = _turned(state[:, 5:], before[:, 5], -before[:, 6])
        way = _turned(state[:, 1:3] - before[:, 1:3], before[:, 5], -before[:, 6])
        half = torch.atan2(turn[:, 1], turn[:, 0]) / 2
        way = _turned(way, half.cos(), -half.sin()) - _seconds(step, initial_states) * _speed(before)
        found.append(torch.cat((state[:, :1], way, _speed(state) - _speed(before), turn), dim=-1))
        before = state
    return torch.stack(found, dim=1)


def _decode_steps(steps: Tensor, initial_states: Tensor) -> Tensor:
    """The inverse, for turns of any length."""
    states = [_vehicles(initial_states)[:, 0]]
    for step, change in enumerate(steps.unbind(dim=1)):
        before = states[-1]
        angle = torch.atan2(change[:, 6], change[:, 5])
        heading = _turned(before[:, 5:], angle.cos(), angle.sin())
        way = change[:, 1:3] + _seconds(step, initial_states) * _speed(before)
        way = _turned(_turned(way, (angle / 2).cos(), (angle / 2).sin()), before[:, 5], before[:, 6])
        velocity = _turned(change[:, 3:5] + _speed(before), heading[:, 0], heading[:, 1])
        states.append(torch.cat((change[:, :1], before[:, 1:3] + way, velocity, heading), dim=-1))
    return torch.stack(states[1:], dim=1)


PERTURBATION = 4.0
"""Standard deviation of the present's speed in m/s."""


def _perturb(states: Tensor, initial_states: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Other speeds of the controlled vehicle in the present, from where it goes on as it did."""
    ego = _vehicles(initial_states)[:, 0]
    speed = (_speed(ego)[:, 0] + PERTURBATION * noise).clamp(min=0)
    now = torch.cat((ego[:, :3], speed[:, None] * ego[:, 5:], ego[:, 5:]), dim=-1)
    return torch.cat((now[:, None], states[:, 1:]), dim=1), torch.cat((now, initial_states[:, STATE:]), dim=-1)


VIEWS = {
    "map": View(
        encode=lambda states, initial_states: states,
        decode=lambda states, initial_states: states,
        observe=lambda initial_states: _vehicles(initial_states).flatten(1),
    ),
    "steps": View(encode=_encode_steps, decode=_decode_steps, observe=_observe_from_ego, perturb=_perturb, alike=_PAIRS),
}
"""``map`` is the paper's. In ``steps`` a plan is the same numbers on any road where the vehicle drives on as before."""
