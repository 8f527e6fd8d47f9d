"""Motion from BVH files: B. Hahne's MotionBuilder-friendly conversion of the database (cgspeed), and exported files.

The conversion omits the thorax: neck and collars start at its base. It is restored from the subject's ASF, if available, else
replaced by the bone below it. The first frame of the conversion, a T-pose, is skipped.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap.asf_amc import INCH, THORAX, Skeleton
from ftl_lightning.domains.mocap.bvh_file import Motion, read_motion
from ftl_lightning.domains.mocap.export import NODES as EXPORTED
from ftl_lightning.domains.mocap.normalise import normalised, z_up
from ftl_lightning.domains.mocap.skeleton import COLUMNS, FPS, HORIZON
from ftl_lightning.domains.mocap.source import moving, pieces
from ftl_lightning.services.errors import UserError

METRES = INCH / 0.45
"""Metres per unit of the conversion, which is that of the ASF files."""
NODES = (
    "RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightArm", "RightForeArm", "RightHand", "LeftArm",
    "LeftForeArm", "LeftHand", "Neck1", "EndSiteHead",
)  # fmt: skip
"""Nodes at the joints, in their order."""
_AFTER_THORAX = ("Neck", "LeftShoulder", "RightShoulder")
_BELOW = "Spine1"
_CONVERTED = (*NODES, *_AFTER_THORAX, _BELOW)
SAME_RATE = 0.01
"""Relative difference of frame rates that is rounding."""


def read_bvh(path: Path, skeleton: Skeleton | None) -> tuple[NDArray[np.float64], int]:
    """Joint positions ``(frame, 14, 3)`` in metres, y up, and frames per second.

    Args:
        path: the file.
        skeleton: skeleton of the subject, if available.

    Raises:
        UserError: with the path, for a file that is damaged or of another conversion.
    """
    motion = read_motion(path)
    if missing := [name for name in _CONVERTED if name not in motion.names]:
        raise UserError(
            f"{path}: expected the MotionBuilder-friendly conversion of the database, found a skeleton without {missing[0]!r}"
        )
    return _converted(motion, skeleton), round(1 / motion.seconds)


def _converted(motion: Motion, skeleton: Skeleton | None) -> NDArray[np.float64]:
    """Joints ``(frame, 14, 3)`` of the conversion, without the first frame."""
    offsets = {node.name: node.offset for node in motion.nodes}
    thorax = offsets[_BELOW] if skeleton is None else skeleton.bones[THORAX].reach
    put_back = {name: np.asarray(thorax, dtype=np.float64) for name in _AFTER_THORAX if not np.any(offsets[name])}
    return motion.places(NODES, put_back)[1:] * METRES


def demonstrated(path: Path) -> Demonstrations:
    """Demonstrations from the motion of a file, without text: each a piece without glitches, as for recordings.

    Args:
        path: file of ``sample --export``, at any frame rate, or of the conversion.

    Raises:
        UserError: with the path, for a file that is damaged, of another skeleton, or shorter than a plan.
    """
    motion = read_motion(path)
    if motion.names.issuperset(_CONVERTED):
        joints = _converted(motion, None)
    elif motion.names.issuperset(EXPORTED):
        joints = motion.places(EXPORTED)
    else:
        missing = next(name for name in EXPORTED if name not in motion.names)
        raise UserError(
            f"{path}: expected a body as 'sample --export' writes it, or of the MotionBuilder-friendly conversion of the CMU "
            f"database, found one without {missing!r}"
        )
    poses = normalised(z_up(_at_rate(joints, motion.seconds))).positions.astype(np.float32).reshape(-1, len(COLUMNS))
    parts = pieces(poses)
    if not parts:
        raise UserError(
            f"{path}: expected a motion of {HORIZON} frames or more at {FPS} a second, without jumps, found {len(poses)} frames"
        )
    return moving(parts, [""] * len(parts), {"generator": "BVH file", "file": path.name})


def _at_rate(joints: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """Joints ``(frame, 14, 3)`` resampled to :data:`FPS` by linear interpolation."""
    step = 1 / FPS / seconds
    whole = max(round(step), 1)
    step = whole if abs(step - whole) < SAME_RATE * whole else step
    times = np.arange(0, len(joints) - 1 + 1e-9, step)
    before = np.minimum(times.astype(int), max(len(joints) - 2, 0))
    after = np.minimum(before + 1, len(joints) - 1)
    part = (times - before)[:, None, None]
    return joints[before] * (1 - part) + joints[after] * part
