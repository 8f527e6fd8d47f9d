"""Views of traffic: in map coordinates, or relative to the controlled vehicle."""

from dataclasses import replace

import torch
from torch import Tensor

from ftl_lightning.data.features import Feature, Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.driving.traffic import (
    FEATURES_SEEN,
    NAMES,
    OBSERVED,
    SCENARIO,
    STATE,
    TRAFFIC,
    TRAINING_CONCEPTS,
    VEHICLES,
    decision_seconds,
)
from ftl_lightning.services.randomness import drawn


def turned(pairs: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate ``(..., 2)`` by an angle."""
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def speed(states: Tensor) -> Tensor:
    """Velocity ``(..., 2)`` along and across the heading in m/s."""
    return turned(states[..., 3:5], states[..., 5], -states[..., 6])


def turn(before: Tensor, after: Tensor) -> Tensor:
    """Cosine and sine ``(..., 2)`` of the rotation between the headings."""
    return turned(after[..., 5:7], before[..., 5], -before[..., 6])


def way(before: Tensor, after: Tensor) -> Tensor:
    """Displacement ``(..., 2)`` in metres along and across the mean heading; on a curve nearly its length, and 0."""
    displacement = turned(after[..., 1:3] - before[..., 1:3], before[..., 5], -before[..., 6])
    cos, sin = turn(before, after).unbind(-1)
    half = torch.atan2(sin, cos) / 2
    return turned(displacement, half.cos(), -half.sin())


def drive(before: Tensor, after: Tensor) -> Tensor:
    """Displacement and final velocity ``(..., 4)``, independent of the road's direction, as of a driver's decision."""
    return torch.cat((way(before, after), speed(after)), dim=-1)


SECONDS = torch.tensor([decision_seconds(name) for name in NAMES])
KNOWN = torch.tensor([name in TRAINING_CONCEPTS for name in NAMES])
"""Seconds between decisions, and whether a scenario is part of pretraining, by scenario number."""
NEAR = 20.0
"""Distance scale in metres; larger distances are compressed."""


def _vehicles(observed: Observed) -> Tensor:
    """Vehicles ``(sample, 5, 7)``."""
    return observed[TRAFFIC].unflatten(-1, (VEHICLES, STATE))


def _near(places: Tensor) -> Tensor:
    """Compress large distances ``(..., n)``."""
    return places * NEAR / (NEAR + places.norm(dim=-1, keepdim=True))


def _observe_from_ego(observed: Observed) -> Observed:
    """Pose and speed of the controlled vehicle, and the others relative to it, 0 where absent ``(7 + 4 * 7)``.

    Position and heading are 0 on roads that are not part of pretraining, where they carry no learned information.
    """
    vehicles = _vehicles(observed)
    ego, others = vehicles[:, 0], vehicles[:, 1:]
    presence, *parts = others.split((1, 2, 2, 2), dim=-1)
    parts[0] = parts[0] - ego[:, None, 1:3]
    place, velocity, heading = (turned(part, ego[:, None, 5], -ego[:, None, 6]) for part in parts)
    relative = torch.cat((presence, _near(place), velocity - speed(ego)[:, None], heading), dim=-1) * presence
    pose = torch.cat((ego[:, 1:3], _near(ego[:, 1:2]), _near(ego[:, 2:3]), ego[:, 5:]), dim=-1) * _known(observed)
    return {TRAFFIC: torch.cat((pose[:, :4], ego[:, 3:5].norm(dim=-1, keepdim=True), pose[:, 4:], relative.flatten(1)), dim=-1)}


def _observe_standing(observed: Observed) -> Observed:
    """As :func:`_observe_from_ego`, and ``exp(-speed)`` of each vehicle, 0 where absent ``(35 + 5)``: near 1 if it stands."""
    vehicles = _vehicles(observed)
    standing = torch.exp(-vehicles[..., 3:5].norm(dim=-1)) * vehicles[..., 0]
    return {TRAFFIC: torch.cat((_observe_from_ego(observed)[TRAFFIC], standing), dim=-1)}


def _known(observed: Observed) -> Tensor:
    """Whether the map position is known ``(sample, 1)``: the road is part of pretraining and not hidden."""
    traffic = observed[TRAFFIC]
    return (traffic[:, :1] > 0) & KNOWN.to(traffic.device)[observed[SCENARIO].long()[:, 0], None]


def _seconds(step: int, observed: Observed) -> Tensor:
    """Seconds ``(sample, 1)`` between the preceding state and a step of a plan; 0 for the first step, the present."""
    number = observed[SCENARIO].long()[:, 0]
    return SECONDS.to(number.device)[number, None] * min(step, 1)


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """Change of each state ``(sample, horizon, 7)`` against the preceding state at constant speed; first against the present.

    Columns: presence; metres along and across the mean of both headings (on a curve: its length and 0); change of velocity along
    and across the heading in m/s; cosine and sine of the turn.
    """
    changes, before = [], _vehicles(observed)[:, 0]
    for step, state in enumerate(states.unbind(dim=1)):
        ahead = way(before, state) - _seconds(step, observed) * speed(before)
        changes.append(torch.cat((state[:, :1], ahead, speed(state) - speed(before), turn(before, state)), dim=-1))
        before = state
    return torch.stack(changes, dim=1)


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """Inverse of :func:`_encode_steps`; turns need not be normalised."""
    states = [_vehicles(observed)[:, 0]]
    for step, change in enumerate(steps.unbind(dim=1)):
        before = states[-1]
        angle = torch.atan2(change[:, 6], change[:, 5])
        heading = turned(before[:, 5:], angle.cos(), angle.sin())
        ahead = change[:, 1:3] + _seconds(step, observed) * speed(before)
        ahead = turned(turned(ahead, (angle / 2).cos(), (angle / 2).sin()), before[:, 5], before[:, 6])
        velocity = turned(change[:, 3:5] + speed(before), heading[:, 0], heading[:, 1])
        states.append(torch.cat((change[:, :1], before[:, 1:3] + ahead, velocity, heading), dim=-1))
    return torch.stack(states[1:], dim=1)


def _act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Drive between consecutive states of plans ``(episode, horizon, 7)``."""
    after = min(step + 1, plans.shape[1] - 1)
    return drive(plans[:, after - 1], plans[:, after])


PERTURBATION = 4.0  # standard deviation of the perturbed speed in m/s


def _perturb(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    """Perturb the present speed of the controlled vehicle on unknown roads; future states are unchanged.

    Roads count as unknown with probability 1/2; without a generator always, at unchanged speed.
    """
    if draw is None:
        noise = torch.tensor([[0.0, -1.0]], device=states.device).expand(len(states), 2)
    else:
        noise = drawn(len(states), lambda n: torch.randn((n, 2), generator=draw, device=draw.device))
    ego = _vehicles(observed)[:, 0]
    is_known = _known(observed) & (noise[:, 1:] > 0)
    pace = (speed(ego)[:, :1] + torch.where(is_known, 0, PERTURBATION * noise[:, :1])).clamp(min=0)
    now = torch.cat((ego[:, :3], pace * ego[:, 5:], ego[:, 5:]), dim=-1)
    traffic = torch.cat((ego[:, :1] * is_known, now[:, 1:], observed[TRAFFIC][:, STATE:]), dim=-1)
    return torch.cat((now[:, None], states[:, 1:]), dim=1), {**observed, TRAFFIC: traffic}


STEPS = View(
    features={TRAFFIC: FEATURES_SEEN[TRAFFIC]},
    observe=_observe_from_ego,
    encode=_encode_steps,
    decode=_decode_steps,
    perturb=_perturb,
    act=_act,
    scales=((1, 3, 5), (2, 4, 6)),
)
SEEN_STANDING = Feature(
    (OBSERVED + VEHICLES,),
    entities=tuple((*columns, OBSERVED + number) for number, columns in enumerate(FEATURES_SEEN[TRAFFIC].entities, start=1)),
)
VIEWS = {
    "map": View(
        features={TRAFFIC: FEATURES_SEEN[TRAFFIC]},
        observe=lambda observed: {TRAFFIC: observed[TRAFFIC]},
        encode=lambda states, observed: states,
        decode=lambda states, observed: states,
    ),
    "steps": STEPS,
    "standing": replace(STEPS, features={TRAFFIC: SEEN_STANDING}, observe=_observe_standing),
}
"""``map`` is the paper's view. In ``steps``, constant motion is the same on any road; ``standing`` also resolves low speeds."""
