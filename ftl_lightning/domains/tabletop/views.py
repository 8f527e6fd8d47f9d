"""How a model sees the table-top: as it is, and in training also from other sides."""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from ftl_lightning.demonstrations.features import Feature, Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.tabletop.interface import FEATURES, IMAGE, PLACES, POSE
from ftl_lightning.domains.tabletop.world import OVERHEAD
from ftl_lightning.processes import drawn

HAND, POINTS, MOVED = "hand", "points", "moved"
ORIGIN = "origin"
"""Observed with the view ``hand``: column and row of the hand in the picture (-1 to 1); with ``points``: its x and y from the
middle, where 1 is half of a picture."""
SHIFT = 0.07
"""Metres by which a scene is shifted at most, in x and in y."""
RAISED = 0.05
"""Metres by which half of the scenes without a picture are raised at most, so that pushes and picks are known on any surface."""
TURN = 0.5
"""Radians by which half of the scenes are turned at most; the others are turned by any angle."""
BLUR = (0.004, 0.004, 0.002)
"""Metres by which an encoder of images is wrong, in x, y and height: the standard deviation on new scenes."""
SURE = 6.0
"""Logit of being seen of an encoder that is sure."""
HALF = OVERHEAD.eye[2] * math.tan(math.radians(OVERHEAD.angle) / 2)
"""Metres of the table from the middle of a picture to its edge."""
MIDDLE = OVERHEAD.target[:2]
"""x and y in the middle of a picture."""


def moved(states: Tensor, observed: Observed, mirrored: Tensor, angles: Tensor, shifts: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Behaviour and picture as if the whole scene had been mirrored, turned about the middle of the picture, and shifted.

    The camera looks straight down, so that the picture moves as the table does, but for the few per cent by which what is high
    looks larger. The hand's yaw, which plans do not command, stays.

    Args:
        states: ``(sample, horizon, 4)``.
        observed: ``pose``, and ``image`` and the privileged ``places`` if they are there.
        mirrored: ``(sample,)`` of bool, left and right exchanged.
        angles: ``(sample,)`` in radians.
        shifts: ``(sample, 2)`` in metres, x and y.
    """
    cos, sin = angles.cos(), angles.sin()
    side = torch.where(mirrored, -1.0, 1.0)
    turned = torch.stack((torch.stack((cos, -sin * side), dim=-1), torch.stack((sin, cos * side), dim=-1)), dim=-2)
    middle = states.new_tensor(MIDDLE)

    def places(values: Tensor) -> Tensor:
        """``(sample, ..., columns)`` whose first two columns are x and y."""
        flat = values.flatten(1, -2) if values.dim() > 2 else values[:, None]
        xy = (flat[..., :2] - middle) @ turned.transpose(1, 2) + middle + shifts[:, None]
        return torch.cat((xy, flat[..., 2:]), dim=-1).reshape(values.shape)

    # A pixel at column u and row v (-1 to 1) shows x = -HALF v, y = -HALF u, seen from the middle. Each is taken from where it was.
    back = turned.transpose(1, 2)
    offset = (back @ shifts[..., None])[..., 0] / HALF
    theta = torch.cat((back.flip(1, 2), offset.flip(1)[..., None]), dim=-1)
    found = {**observed, POSE: places(observed[POSE])}
    if IMAGE in observed:
        images = observed[IMAGE]
        grid = functional.affine_grid(theta, list(images.shape), align_corners=False)
        drawn = functional.grid_sample(images.float(), grid, padding_mode="border", align_corners=False)
        found[IMAGE] = drawn.round().to(torch.uint8)
    if PLACES in observed:
        seen, centres = observed[PLACES].split((1, 3), dim=-1)
        centres = places(centres)
        shown = ((centres[..., :2] - middle).abs() < HALF).all(dim=-1, keepdim=True)
        found[PLACES] = torch.cat((seen * shown, centres), dim=-1)
    return places(states), found


def raised(states: Tensor, observed: Observed, heights: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Behaviour and places as if the whole table were higher. No picture from above would tell.

    Args:
        states: ``(sample, horizon, 4)``.
        observed: ``pose`` and the privileged ``places``.
        heights: ``(sample,)`` in metres.
    """
    found = dict(observed)
    found[POSE], found[PLACES] = observed[POSE].clone(), observed[PLACES].clone()
    found[POSE][:, 2] += heights
    found[PLACES][..., 3] += heights[:, None]
    states = states.clone()
    states[..., 2] += heights[:, None]
    return states, found


def misplaced(read: Tensor, places: Tensor) -> Tensor:
    """How wrong points that were read of pictures are ``(sample,)``.

    The absolute errors of the centres of what is seen, where 1 is half of a picture, and a hundredth of the cross-entropy of
    whether it is seen.

    Args:
        read: x, y, height and logit of being seen of each object, all x first ``(sample, 20)``; see
            :class:`ftl_lightning.diffusion.image_encoder.Points`.
        places: :data:`~ftl_lightning.domains.tabletop.interface.SEEN` ``(sample, 5, 4)``.
    """
    read, seen = read.unflatten(1, (4, -1)).transpose(1, 2), places[..., 0]
    off = read[..., :3] - (places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))) / HALF
    unseen = functional.binary_cross_entropy_with_logits(read[..., 3], seen, reduction="none")
    return (off.abs().sum(dim=-1) * seen + 0.01 * unseen).sum(dim=-1)


def told(places: Tensor, draw: torch.Generator) -> Tensor:
    """What an encoder might read of a picture: the places of what is seen, wrong by :data:`BLUR`.

    Args:
        places: :data:`~ftl_lightning.domains.tabletop.interface.SEEN` ``(sample, 5, 4)``.
        draw: of the errors.

    Returns:
        as :func:`misplaced` takes it.
    """
    seen, centres = places[..., :1], places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))
    wrong = drawn(len(centres), lambda n: torch.randn((n, *centres.shape[1:]), generator=draw, device=centres.device))
    wrong = wrong * centres.new_tensor(BLUR)
    return torch.cat((seen * (centres + wrong) / HALF, SURE * (2 * seen - 1)), dim=-1).transpose(1, 2).flatten(1)


def _perturb(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    if draw is None:  # a new task shows all that a model sees
        return states, observed
    count, device = len(states), states.device
    way = drawn(count, lambda n: torch.rand((n, 5), generator=draw, device=device))
    most = torch.where(way[:, 1] < 0.5, TURN, math.pi)
    states, observed = moved(states, observed, way[:, 0] < 0.5, most * (2 * way[:, 2] - 1), SHIFT * (2 * way[:, 3:] - 1))
    if IMAGE in observed:
        return states, observed
    height = drawn(count, lambda n: torch.rand(n, generator=draw, device=device))
    return raised(states, observed, RAISED * (2 * height - 1).clamp(min=0))


def _start(observed: Observed) -> Tensor:
    """The state that a plan starts from ``(sample, 1, 4)``."""
    return observed[POSE][:, None, list(FEATURES[POSE].state)]


def _place(observed: Observed) -> Tensor:
    """What states are told relative to with the view ``hand``: its place, and no opening, ``(sample, 1, 4)``."""
    return functional.pad(_start(observed)[..., :3], (0, 1))


def _with_origin(observed: Observed) -> dict[str, Tensor]:
    away = (observed[POSE][:, :2] - observed[POSE].new_tensor(MIDDLE)) / -HALF
    return {**observed, ORIGIN: away.flip(1)}


def _with_place(observed: Observed) -> dict[str, Tensor]:
    return {**observed, ORIGIN: (observed[POSE][:, :2] - observed[POSE].new_tensor(MIDDLE)) / HALF}


_FROM_HAND = View(
    features={**FEATURES, ORIGIN: Feature((2,))},
    observe=_with_origin,
    encode=lambda states, observed: states - _place(observed),
    decode=lambda states, observed: states + _place(observed),
    perturb=_perturb,
)
VIEWS = {
    HAND: _FROM_HAND,
    POINTS: replace(_FROM_HAND, observe=_with_place, plane=(0, 1)),
    MOVED: View(
        features=FEATURES,
        observe=lambda observed: observed,
        encode=lambda states, observed: states,
        decode=lambda states, observed: states,
        perturb=_perturb,
        same_columns=True,
    ),
}
"""With ``model.perturb``, scenes are mirrored, turned and shifted at random together with what is done in them.

``hand`` shows places from where the hand is; keypoints of pictures can be told likewise, see :data:`ORIGIN`. So does ``points``,
for encoders that tell x and y of things. ``moved`` shows states as they are.
"""
