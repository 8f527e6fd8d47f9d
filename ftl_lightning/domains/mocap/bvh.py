"""Motion in the BVH files of B. Hahne's MotionBuilder-friendly conversion of the database (cgspeed), read by pybvh.

The conversion leaves the thorax out: neck and collars hang where it starts. It is put back from the subject's ASF where there is
one, else the bone below it stands for it. Its first frame is a T-pose, which is no motion.
"""

import contextlib
import io
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.asf_amc import INCH, THORAX, Skeleton
from ftl_lightning.errors import UserError
from ftl_lightning.limits import MOST_TEXT, expect_readable

METRES = INCH / 0.45
"""Of a unit of the conversion, which is that of the ASF files."""
NODES = (
    "RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightArm", "RightForeArm", "RightHand", "LeftArm",
    "LeftForeArm", "LeftHand", "Neck1", "EndSiteHead",
)  # fmt: skip
"""Whose places are the joints, in their order."""
_AFTER_THORAX = ("Neck", "LeftShoulder", "RightShoulder")
_BELOW = "Spine1"


def read_bvh(path: Path, skeleton: Skeleton | None) -> tuple[NDArray[np.float64], int]:
    """Where the joints are ``(frame, 14, 3)`` in metres, y up, and frames a second.

    Args:
        path: the file.
        skeleton: of the subject, if there is one.

    Raises:
        UserError: naming the file, if it is damaged or of another conversion, or pybvh is not installed.
    """
    try:
        import pybvh
    except ImportError:
        raise UserError(f"{path}: BVH files need the extra 'mocap'; run: pip install 'ftl-lightning[mocap]'") from None
    expect_readable(path, "BVH", MOST_TEXT)
    try:
        # What it guesses of facing and handedness does not matter here.
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            motion = pybvh.read_bvh_file(path, world_up="+y")
    except Exception as error:  # whatever a reader raises at what it cannot read
        raise UserError(f"{path}: expected a BVH file, found a damaged one ({' '.join(str(error).split())})") from error
    places = {node.name: node for node in motion.nodes}
    if missing := [name for name in (*NODES, *_AFTER_THORAX, _BELOW) if name not in motion.node_index]:
        raise UserError(
            f"{path}: expected the MotionBuilder-friendly conversion of the database, found a skeleton without {missing[0]!r}"
        )
    for name in _AFTER_THORAX:
        if not np.any(places[name].offset):
            places[name].offset = places[_BELOW].offset.copy() if skeleton is None else skeleton.bones[THORAX].reach.copy()
    found = motion.node_positions()[:, [motion.node_index[name] for name in NODES]]
    if not np.isfinite(found).all():
        raise UserError(f"{path}: expected finite numbers, found others")
    return found[1:] * METRES, round(1 / motion.frame_time)
