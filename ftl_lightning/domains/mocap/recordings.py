"""File of recordings in a domain folder, and segments of actions.

``recordings.npz`` is the output of ``prepare``. ``cmu14_trials.npz``, with the same content, is accepted too.
"""

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.data.formats.npz import check_arrays
from ftl_lightning.domains.mocap.segments import SEGMENTS, Segment, read_segments, shipped_segments
from ftl_lightning.domains.mocap.skeleton import JOINTS
from ftl_lightning.domains.mocap.tasks import cleaned
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.tensor_file import atomic

FILE = "recordings.npz"
FILES = (FILE, "cmu14_trials.npz")
"""Names of a file of recordings; the first existing file is read."""
WHERE = (
    "get the CMU motion capture database (mocap.cs.cmu.edu, the files of allasfamc.zip) and run: "
    "python -m ftl_lightning prepare mocap --root FOLDER"
)
THANKS = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."
)
"""Acknowledgement requested by the database."""


@dataclass(frozen=True)
class Recordings:
    """Concatenated trials.

    Attributes:
        positions: ``(frame, 14, 3)`` float32, metres, see :mod:`ftl_lightning.domains.mocap.skeleton`.
        root: ``(frame, 4)`` float32: middle of the hips (x, y, z in metres) and yaw in radians.
        offsets: ``(trial + 1,)`` int64: trial i has the frames ``offsets[i]:offsets[i + 1]``.
        trial_id: such as ``13_29``.
        label: description of each trial, cleaned.
        kind: source format of each trial, such as ``asf_amc``.
        subject: subject of each trial, such as ``13``.
    """

    positions: NDArray[np.float32]
    root: NDArray[np.float32]
    offsets: NDArray[np.int64]
    trial_id: tuple[str, ...]
    label: tuple[str, ...]
    kind: tuple[str, ...]
    subject: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.trial_id)

    def trial(self, number: int) -> NDArray[np.float32]:
        """States ``(frame, 42)`` of a trial."""
        return self.positions[self.offsets[number] : self.offsets[number + 1]].reshape(-1, 3 * len(JOINTS))

    def save(self, path: Path) -> None:
        """Write the recordings atomically."""
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                positions=self.positions,
                root=self.root,
                offsets=self.offsets,
                trial_id=np.array(self.trial_id),
                label=np.array(self.label),
                kind=np.array(self.kind),
                subject=np.array(self.subject),
            )

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read recordings.

        Raises:
            UserError: with path and key, for a file that is damaged or of other content.
        """
        size = check_readable(path, "recordings")
        try:
            check_arrays(path, size)
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files if name in _KEYS}
        except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise UserError(f"{path}: expected recordings, found a damaged or foreign file ({error}); {WHERE}") from error
        arrays.setdefault("subject", np.array([str(trial).split("_")[0] for trial in arrays.get("trial_id", ())]))
        _check(path, arrays)
        texts = {key: tuple(map(str, arrays[key])) for key in _TEXTS}
        return cls(
            np.ascontiguousarray(arrays["positions"], dtype=np.float32),
            np.ascontiguousarray(arrays["root"], dtype=np.float32),
            arrays["offsets"].astype(np.int64),
            **texts | {"label": tuple(map(cleaned, texts["label"]))},
        )


_TEXTS = ("trial_id", "label", "kind", "subject")
_KEYS = ("positions", "root", "offsets", *_TEXTS)


def _check(path: Path, arrays: Mapping[str, Any]) -> None:
    if missing := [key for key in _KEYS if key not in arrays]:
        raise UserError(f"{path}: key {missing[0]!r}: expected it in a file of recordings, found none; {WHERE}")
    trials = len(arrays["trial_id"])
    frames = len(arrays["positions"])
    shapes = {"positions": (frames, len(JOINTS), 3), "root": (frames, 4), "offsets": (trials + 1,)}
    for key, expected in (shapes | dict.fromkeys(_TEXTS, (trials,))).items():
        if arrays[key].shape != expected:
            raise UserError(f"{path}: key {key!r}: expected shape {expected}, found {arrays[key].shape}")
    offsets = arrays["offsets"]
    if not trials or offsets[0] != 0 or offsets[-1] != frames or (np.diff(offsets) < 1).any():
        raise UserError(f"{path}: key 'offsets': expected ends of one trial or more, growing from 0 to {frames}, found others")
    for key in ("positions", "root"):
        if arrays[key].dtype.kind != "f" or not np.isfinite(arrays[key]).all():
            raise UserError(f"{path}: key {key!r}: expected finite numbers, found others")


@cache
def read_folder(root: Path) -> tuple[Recordings, tuple[Segment, ...]]:
    """Recordings of a folder, and the segments of single actions: the folder's ``segments.csv``, else the shipped segments.

    Raises:
        UserError: for a missing folder, missing recordings, or damaged recordings.
    """
    if not root.is_dir():
        present = f"{'a file' if root.exists() else 'nothing'} at {short(str(root))}"
        raise UserError(f"data.root: expected a folder of recordings, found {present}; {WHERE}")
    path = next((root / name for name in FILES if (root / name).is_file()), None)
    if path is None:
        raise UserError(f"{root}: expected {FILE}, found {'other files' if any(root.iterdir()) else 'an empty folder'}; {WHERE}")
    segments = root / SEGMENTS
    return Recordings.load(path), read_segments(segments) if segments.is_file() else shipped_segments()
