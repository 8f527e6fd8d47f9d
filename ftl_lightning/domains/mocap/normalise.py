"""Normalisation of joint positions to poses: root and yaw removed, 30 frames per second."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.skeleton import FPS, L_HIP, R_HIP


class Poses(NamedTuple):
    """Poses and removed root motion.

    Attributes:
        positions: ``(frame, 14, 3)`` in metres, z up, the middle of the hips at the origin, hips facing +y.
        root: ``(frame, 4)``: middle of the hips in metres, and yaw in radians.
    """

    positions: NDArray[np.float64]
    root: NDArray[np.float64]


def z_up(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert points ``(..., 3)`` from y up to z up."""
    return np.stack((joints[..., 0], -joints[..., 2], joints[..., 1]), axis=-1)


def normalised(joints: NDArray[np.float64]) -> Poses:
    """Remove root and yaw in every frame of joints ``(frame, 14, 3)``, z up: the direction from left to right hip is +x.

    The yaw of vertical hips means little and may spin; pitch and roll stay.
    """
    middle = (joints[:, R_HIP] + joints[:, L_HIP]) / 2
    across = joints[:, R_HIP] - joints[:, L_HIP]
    yaw = np.arctan2(across[:, 1], across[:, 0])
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, z = np.moveaxis(joints - middle[:, None], -1, 0)
    turned = np.stack((cosine * x + sine * y, cosine * y - sine * x, z), axis=-1)
    return Poses(turned, np.concatenate((middle, yaw[:, None]), axis=1))


def every(raw_fps: int) -> int:
    """Subsampling factor of a recording to :data:`FPS`."""
    return max(1, round(raw_fps / FPS))
