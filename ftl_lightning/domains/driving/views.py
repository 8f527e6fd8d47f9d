"""How a model may see traffic: as it stands on the map, or from the controlled vehicle."""

import torch
from torch import Tensor
from torch.nn import functional

from ftl_lightning.domains.domain import View
from ftl_lightning.domains.driving.environment import INITIAL, OBSERVED, STATE
from ftl_lightning.domains.driving.scenarios import VEHICLES
from ftl_lightning.errors import UserError


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


def _on_the_map(states: Tensor, ego: Tensor) -> Tensor:
    """The inverse."""
    cos, sin = ego[:, None, 5], ego[:, None, 6]
    presence, *parts = states.split((1, 2, 2, 2), dim=-1)
    place, velocity, heading = (_turned(part, cos, sin) for part in parts)
    return torch.cat((presence, place + ego[:, None, 1:3], velocity, heading), dim=-1)


def _observe_from_ego(initial_states: Tensor) -> Tensor:
    """The controlled vehicle where it is ``(7)``, and the others seen from it, those that are none at 0 ``(4 * 7)``."""
    vehicles = _vehicles(initial_states)
    ego, others = vehicles[:, 0], vehicles[:, 1:]
    seen = _seen_from(others, ego) * others[..., :1]
    return torch.cat((ego, seen.flatten(1)), dim=-1)


def _encode_steps(states: Tensor, initial_states: Tensor) -> Tensor:
    """Each state ``(sample, horizon, 7)`` seen from the one before, the first from where the vehicle is."""
    before = torch.cat((_vehicles(initial_states)[:, :1], states[:, :-1]), dim=1)
    return _seen_from(states.flatten(0, 1)[:, None], before.flatten(0, 1))[:, 0].unflatten(0, states.shape[:2])


def _decode_steps(steps: Tensor, initial_states: Tensor) -> Tensor:
    """The inverse; headings are brought back to unit length, or their errors would multiply from step to step."""
    states = [_vehicles(initial_states)[:, 0]]
    for step in steps.unbind(dim=1):
        seen = torch.cat((step[:, :5], functional.normalize(step[:, 5:], dim=1)), dim=1)
        states.append(_on_the_map(seen[:, None], states[-1])[:, 0])
    return torch.stack(states[1:], dim=1)


VIEWS = {
    "map": View(
        encode=lambda states, initial_states: states,
        decode=lambda states, initial_states: states,
        observe=lambda initial_states: _vehicles(initial_states).flatten(1),
    ),
    "ego": View(
        encode=lambda states, initial_states: _seen_from(states, _vehicles(initial_states)[:, 0]),
        decode=lambda states, initial_states: _on_the_map(states, _vehicles(initial_states)[:, 0]),
        observe=_observe_from_ego,
    ),
    "steps": View(encode=_encode_steps, decode=_decode_steps, observe=_observe_from_ego),
}
"""``map`` is the paper's. In ``ego`` the next state is the same number on every road where the vehicle drives straight on; in ``steps``
so is every state of a plan, where the plans of ``ego`` spread over a hundred metres, beside which a metre is lost.
"""
