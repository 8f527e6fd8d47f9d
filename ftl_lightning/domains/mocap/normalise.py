"""From where joints were to poses: root and yaw removed, 30 frames a second."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.skeleton import FPS, L_HIP, R_HIP


class Poses(NamedTuple):
    """Poses and what was removed from them.

    Attributes:
        positions: ``(frame, 14, 3)`` in metres, z up, the middle of the hips at the origin, hips facing +y.
        root: ``(frame, 4)``: where the middle of the hips was in metres, and its yaw in radians.
    """

    positions: NDArray[np.float64]
    root: NDArray[np.float64]


def z_up(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(..., 3)`` with y up as such with z up."""
    return np.stack((joints[..., 0], -joints[..., 2], joints[..., 1]), axis=-1)


def normalised(joints: NDArray[np.float64]) -> Poses:
    """Root and yaw removed in every frame of joints ``(frame, 14, 3)``, z up: the way from the left hip to the right is +x.

    Where hips stand on end their yaw means little and may spin; pitch and roll stay.
    """
    middle = (joints[:, R_HIP] + joints[:, L_HIP]) / 2
    across = joints[:, R_HIP] - joints[:, L_HIP]
    yaw = np.arctan2(across[:, 1], across[:, 0])
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, z = np.moveaxis(joints - middle[:, None], -1, 0)
    turned = np.stack((cosine * x + sine * y, cosine * y - sine * x, z), axis=-1)
    return Poses(turned, np.concatenate((middle, yaw[:, None]), axis=1))


def every(raw_fps: int) -> int:
    """How many frames of a recording make one at :data:`FPS`."""
    return max(1, round(raw_fps / FPS))
