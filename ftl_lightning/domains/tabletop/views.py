"""Views of the table-top for models: states and observations, with random transformations in training."""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from ftl_lightning.data.features import Feature, Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.tabletop.interface import FEATURES, IMAGE, PLACES, POSE
from ftl_lightning.domains.tabletop.world import OVERHEAD
from ftl_lightning.services.randomness import drawn

HAND, POINTS, MOVED = "hand", "points", "moved"
ORIGIN = "origin"
"""Feature of the hand position in the image: column and row, -1..1, with the view ``hand``; x and y from the centre, in half
images, with ``points``."""
SHIFT = 0.07
"""Maximum shift of a scene in metres, in x and in y."""
RAISED = 0.05
"""Maximum elevation in metres of half of the scenes without image, so that pushes and picks generalise to any surface."""
TURN = 0.5
"""Maximum rotation in radians of half of the scenes; others are rotated by any angle."""
BLUR = (0.004, 0.004, 0.002)
"""Standard deviation of the errors of an image encoder on new scenes, in metres, in x, y and height."""
SURE = 6.0
"""Visibility logit of a confident encoder."""
HALF = OVERHEAD.eye[2] * math.tan(math.radians(OVERHEAD.angle) / 2)
"""Metres of the table from the centre of an image to its edge."""
MIDDLE = OVERHEAD.target[:2]
"""x and y of the centre of an image."""


def moved(states: Tensor, observed: Observed, mirrored: Tensor, angles: Tensor, shifts: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Mirror a scene, rotate it about the image centre and shift it: states and observations.

    The camera looks straight down, so that the image moves with the table, except for a few per cent of perspective of high
    objects. The yaw of the hand, which plans do not command, is constant.

    Args:
        states: ``(sample, horizon, 4)``.
        observed: ``pose``, optionally ``image`` and the privileged ``places``.
        mirrored: ``(sample,)`` of bool, left and right exchanged.
        angles: ``(sample,)`` in radians.
        shifts: ``(sample, 2)`` in metres, x and y.
    """
    cos, sin = angles.cos(), angles.sin()
    side = torch.where(mirrored, -1.0, 1.0)
    turned = torch.stack((torch.stack((cos, -sin * side), dim=-1), torch.stack((sin, cos * side), dim=-1)), dim=-2)
    middle = states.new_tensor(MIDDLE)

    def places(values: Tensor) -> Tensor:
        """Transform ``(sample, ..., columns)`` with x and y in the first two columns."""
        flat = values.flatten(1, -2) if values.dim() > 2 else values[:, None]
        xy = (flat[..., :2] - middle) @ turned.transpose(1, 2) + middle + shifts[:, None]
        return torch.cat((xy, flat[..., 2:]), dim=-1).reshape(values.shape)

    # A pixel at column u and row v (-1 to 1) shows x = -HALF v, y = -HALF u, from the centre. Each is sampled at its source.
    back = turned.transpose(1, 2)
    offset = (back @ shifts[..., None])[..., 0] / HALF
    theta = torch.cat((back.flip(1, 2), offset.flip(1)[..., None]), dim=-1)
    result = {**observed, POSE: places(observed[POSE])}
    if IMAGE in observed:
        images = observed[IMAGE]
        grid = functional.affine_grid(theta, list(images.shape), align_corners=False)
        drawn = functional.grid_sample(images.float(), grid, padding_mode="border", align_corners=False)
        result[IMAGE] = drawn.round().to(torch.uint8)
    if PLACES in observed:
        seen, centres = observed[PLACES].split((1, 3), dim=-1)
        centres = places(centres)
        shown = ((centres[..., :2] - middle).abs() < HALF).all(dim=-1, keepdim=True)
        result[PLACES] = torch.cat((seen * shown, centres), dim=-1)
    return places(states), result


def raised(states: Tensor, observed: Observed, heights: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Raise the table: states and positions. Images from above would not show it.

    Args:
        states: ``(sample, horizon, 4)``.
        observed: ``pose`` and the privileged ``places``.
        heights: ``(sample,)`` in metres.
    """
    result = dict(observed)
    result[POSE], result[PLACES] = observed[POSE].clone(), observed[PLACES].clone()
    result[POSE][:, 2] += heights
    result[PLACES][..., 3] += heights[:, None]
    states = states.clone()
    states[..., 2] += heights[:, None]
    return states, result


def misplaced(read: Tensor, places: Tensor) -> Tensor:
    """Loss of keypoints of an image encoder ``(sample,)``.

    Absolute errors of the centres of visible objects, in half images, plus .01 times the cross-entropy of visibility.

    Args:
        read: x, y, height and visibility logit of each object, all x first ``(sample, 20)``; see
            :class:`ftl_lightning.networks.image_encoder.Points`.
        places: :data:`~ftl_lightning.domains.tabletop.interface.SEEN` ``(sample, 5, 4)``.
    """
    read, seen = read.unflatten(1, (4, -1)).transpose(1, 2), places[..., 0]
    off = read[..., :3] - (places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))) / HALF
    unseen = functional.binary_cross_entropy_with_logits(read[..., 3], seen, reduction="none")
    return (off.abs().sum(dim=-1) * seen + 0.01 * unseen).sum(dim=-1)


def told(places: Tensor, draw: torch.Generator) -> Tensor:
    """Simulate the keypoints of an image encoder: centres of visible objects with errors of :data:`BLUR`.

    Args:
        places: :data:`~ftl_lightning.domains.tabletop.interface.SEEN` ``(sample, 5, 4)``.
        draw: generator of the errors.

    Returns:
        keypoints in the form of :func:`misplaced`.
    """
    seen, centres = places[..., :1], places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))
    wrong = drawn(len(centres), lambda n: torch.randn((n, *centres.shape[1:]), generator=draw, device=centres.device))
    wrong = wrong * centres.new_tensor(BLUR)
    return torch.cat((seen * (centres + wrong) / HALF, SURE * (2 * seen - 1)), dim=-1).transpose(1, 2).flatten(1)


def _perturb(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    if draw is None:  # no transformation of new tasks
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
    """Initial state of a plan ``(sample, 1, 4)``."""
    return observed[POSE][:, None, list(FEATURES[POSE].state)]


def _place(observed: Observed) -> Tensor:
    """Origin of states with the view ``hand``: hand position, and zero opening, ``(sample, 1, 4)``."""
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
"""``model.perturb`` mirrors, rotates and shifts scenes at random, together with their states.

``hand`` has states relative to the hand; keypoints of images can be relative too, see :data:`ORIGIN`. ``points`` is the same for
encoders of x and y of objects. ``moved`` has absolute states.
"""
