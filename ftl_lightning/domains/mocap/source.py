"""Recordings of a folder, and demonstrations from them."""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, padded
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.formats.files import check_arrays
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.mocap import skeleton, tasks
from ftl_lightning.domains.mocap.skeleton import (
    COLUMNS,
    FPS,
    HORIZON,
    JOINTS,
    NAME,
    POSE,
    ROOT,
    ROOTED_NAME,
    has_root,
    mirrored,
    root_columns,
)
from ftl_lightning.domains.mocap.tasks import DEMONSTRATORS, TRAINING_CONCEPTS, Segment
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.services.tensor_file import atomic

FILE = "recordings.npz"
FILES = (FILE, "cmu14_trials.npz")
"""Names of a file of recordings: the output of ``prepare``, or another file with the same content. The first existing is read."""
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
    """Concatenated trials."""

    positions: NDArray[np.float32]  # (frame, 14, 3) in metres, see skeleton
    root: NDArray[np.float32]  # (frame, 4): middle of the hips (x, y, z in metres) and yaw in radians
    offsets: NDArray[np.int64]  # (trial + 1,): trial i has the frames offsets[i]:offsets[i + 1]
    trial_id: tuple[str, ...]  # such as 13_29
    label: tuple[str, ...]  # cleaned descriptions
    kind: tuple[str, ...]  # source formats, such as asf_amc
    subject: tuple[str, ...]  # such as 13

    def __len__(self) -> int:
        return len(self.trial_id)

    def trial(self, number: int, rooted: bool = False) -> NDArray[np.float32]:
        """States ``(frame, 42)`` of a trial, or with root ``(frame, 46)``."""
        frames = slice(self.offsets[number], self.offsets[number + 1])
        states = self.positions[frames].reshape(-1, len(COLUMNS))
        return np.concatenate((states, root_columns(self.positions[frames], self.root[frames])), axis=1) if rooted else states

    def save(self, path: Path) -> None:
        """Write the recordings atomically."""
        arrays: dict[str, Any] = {key: np.array(getattr(self, key)) for key in _KEYS}
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read recordings; raise a ``UserError`` with path and key for a file that is damaged or of other content."""
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
            **texts | {"label": tuple(map(tasks.cleaned, texts["label"]))},
        )


_TEXTS = ("trial_id", "label", "kind", "subject")
_KEYS = ("positions", "root", "offsets", *_TEXTS)


def _check(path: Path, arrays: Mapping[str, Any]) -> None:
    for key in _KEYS:
        require(key in arrays, f"{path}: key {key!r}", "it in a file of recordings", f"none; {WHERE}")
    trials, frames = len(arrays["trial_id"]), len(arrays["positions"])
    shapes = {"positions": (frames, len(JOINTS), 3), "root": (frames, 4), "offsets": (trials + 1,)}
    for key, expected in (shapes | dict.fromkeys(_TEXTS, (trials,))).items():
        require(arrays[key].shape == expected, f"{path}: key {key!r}", f"shape {expected}", arrays[key].shape)
    offsets = arrays["offsets"]
    growing = trials and offsets[0] == 0 and offsets[-1] == frames and (np.diff(offsets) >= 1).all()
    require(growing, f"{path}: key 'offsets'", f"ends of one trial or more, growing from 0 to {frames}", "others")
    for key in ("positions", "root"):
        finite = arrays[key].dtype.kind == "f" and (np.abs(arrays[key]) <= np.finfo(np.float32).max).all()
        require(finite, f"{path}: key {key!r}", "finite numbers", "others")


@cache
def read_folder(root: Path | None) -> tuple[Recordings, tuple[Segment, ...]]:
    """Recordings of a folder, and the segments of single actions: the folder's ``segments.csv``, else the shipped segments.

    Raise a ``UserError`` for a missing folder, missing recordings, or damaged recordings.
    """
    if root is None:
        raise UserError(f"data.root: expected a folder of recordings, found none; {WHERE}")
    present = f"{'a file' if root.exists() else 'nothing'} at {short(str(root))}; {WHERE}"
    require(root.is_dir(), "data.root", "a folder of recordings", present)
    path = next((root / name for name in FILES if (root / name).is_file()), None)
    if path is None:
        raise UserError(f"{root}: expected {FILE}, found {'other files' if any(root.iterdir()) else 'an empty folder'}; {WHERE}")
    segments = root / tasks.SEGMENTS
    return Recordings.load(path), tasks.read_segments(segments if segments.is_file() else tasks.SHIPPED)


MAX_SPEED = 12.0
"""Maximum joint speed in metres per second. Trials are cut at faster frames: glitches, or hips without defined yaw."""
LONGEST = 128  # Maximum frames of a piece; parts of longer pieces overlap by a window less a frame, so that no window is lost
OTHER_FIGURES = ("bvh_daz",)  # Excluded kinds of recordings: all subjects retargeted to the same figure
CYCLE = 8  # Frames, at most half a period of periodic motion
ARMS_DOWN = 0.4  # Maximum distance in metres from wrist to hip, sideways and vertical, of hanging arms
UPRIGHT = 0.35  # Minimum height in metres of shoulders above hips; half the minimum height of hips above ankles


def moving(motions: Sequence[Tensor], concepts: Sequence[str], provenance: Mapping[str, object]) -> Demonstrations:
    """Demonstrations from motions ``(frame, 42)`` or ``(frame, 46)``, with a text each."""
    states, lengths = padded(motions)
    rooted = has_root(states)
    return Demonstrations(
        states=states,
        lengths=lengths,
        domain=ROOTED_NAME if rooted else NAME,
        state_names=(*COLUMNS, *ROOT) if rooted else COLUMNS,
        state_units=(*("m",) * (states.shape[-1] - 1), "rad") if rooted else ("m",) * len(COLUMNS),
        concepts=tuple(concepts),
        observed={POSE: states[..., : len(COLUMNS)]},
        per_step=(POSE,),
        provenance=provenance,
    )


class Piece(NamedTuple):
    """Part of a trial without glitches: number of the trial, concept, and states, at least as long as a plan."""

    trial: int
    concept: str
    states: Tensor

    def window(self, start: int) -> "Piece":
        """Window of the length of a plan."""
        return Piece(self.trial, self.concept, self.states[start : start + HORIZON])


@dataclass(frozen=True)
class Recorded:
    """Recordings of a folder, read lazily; without a folder, a source of rule-based initial poses only.

    Attributes:
        root: folder.
        rooted: whether states have the columns of the body's root.
    """

    root: Path | None
    rooted: bool = False

    @property
    def recordings(self) -> Recordings:
        """All trials of the folder."""
        return read_folder(self.root)[0]

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Segments of single actions."""
        return read_folder(self.root)[1]

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """All pieces of trials of the training concepts, and in ``train`` their mirror images; ``count`` and ``seed`` are unused.

        See :func:`validation_trials`. Mirroring exchanges left and right in the description; mirror images of which it is no
        training concept are omitted. A ``UserError`` if the folder has no trial for the split.
        """
        chosen = [piece for piece in self._pieces if (piece.trial in self._validation) == (name == "validation")]
        require(chosen, str(self.root), f"trials of the training concepts for {name}", "none; use more of the database")
        if name == "train":
            reflected = [Piece(piece.trial, tasks.mirrored_text(piece.concept), mirrored(piece.states)) for piece in chosen]
            chosen += [piece for piece in reflected if piece.concept in TRAINING_CONCEPTS]
        return self._demonstrations(chosen, {"split": name})

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """Demonstrations of a concept, without replacement if there are enough.

        For a training concept, pieces of its trials. For a new concept, windows as long as a plan, aligned in time by
        :func:`at_rest` and, if there are too few, windows at random. A ``UserError`` if no trial of the folder shows the concept.
        """
        new = task in tasks.NEW_CONCEPTS
        shown = self._shown(task) if new else [piece for piece in self._pieces if piece.concept == task]
        require(shown, "task", f"a concept that trials in {self.root} show", repr(task))
        draw = generator("cpu", seed, task_key(task))
        choices = [piece.window(start) for piece in shown for start in at_rest(piece.states)] if new else shown
        order = torch.randperm(len(choices), generator=draw).tolist()
        windows = [choices[row] for row in order[:count]]
        while len(windows) < count:
            piece = shown[int(torch.randint(len(shown), (1,), generator=draw))]
            windows.append(piece.window(int(torch.randint(len(piece.states) - HORIZON + 1, (1,), generator=draw))))
        return self._demonstrations(windows, {"task": task, "seed": seed})

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """Initial poses, with equal probability of trials.

        For a training concept, poses of its trials, held out if possible. Otherwise poses of people who stand or walk with arms
        down, in validation trials without demonstrators of new concepts. Without a folder, rule-based poses. A ``UserError`` if the
        folder has neither.
        """
        draw = generator("cpu", seed, task_key(task))
        if self.root is None:
            return InitialStates({POSE: skeleton.walking_poses(count, draw)})
        trials = self._passed(task) or self.arms_down
        which = torch.randint(len(trials), (count,), generator=draw).tolist()
        share = torch.rand(count, generator=draw).tolist()
        poses = [trials[trial][int(part * len(trials[trial]))] for trial, part in zip(which, share, strict=True)]
        return InitialStates({POSE: torch.stack(poses)})

    @cached_property
    def arms_down(self) -> tuple[Tensor, ...]:
        """Poses with arms down ``(pose, 42)`` of each validation trial that has any, for :meth:`starts`; else a ``UserError``."""
        subjects = self.recordings.subject
        trials = [trial for trial in sorted(self._validation) if subjects[trial] not in DEMONSTRATORS]
        poses = [torch.from_numpy(self.recordings.trial(trial)) for trial in trials]
        hanging = tuple(down for states in poses if len(down := states[hang_down(states)]))
        require(hanging, str(self.root), "held-out trials in which someone stands with arms down", "none")
        return hanging

    def training_poses(self) -> tuple[Tensor, ...]:
        """Poses with arms down ``(pose, 42)``, and their mirror images, of each training trial that has any."""
        trials = sorted({piece.trial for piece in self._pieces} - self._validation)
        down = [poses[hang_down(poses)] for poses in (torch.from_numpy(self.recordings.trial(trial)) for trial in trials)]
        return tuple(torch.cat((poses, mirrored(poses))) for poses in down if len(poses))

    def _passed(self, concept: str) -> tuple[Tensor, ...]:
        """Poses ``(pose, 42)`` that start a window, per piece of a training concept's trials; empty if it has no trial."""
        shown = [piece for piece in self._pieces if piece.concept == concept]
        held_out = [piece for piece in shown if piece.trial in self._validation]
        return tuple(piece.states[: len(piece.states) - HORIZON + 1, : len(COLUMNS)] for piece in held_out or shown)

    @cached_property
    def _pieces(self) -> list[Piece]:
        return training_pieces(self.recordings, self.rooted)

    @cached_property
    def _validation(self) -> frozenset[int]:
        return validation_trials(self._pieces)

    def _shown(self, task: str) -> list[Piece]:
        """Pieces of a new concept by its demonstrators; if it has none, by anyone."""
        recordings, shown = self.recordings, dict[bool, list[Piece]]()
        for segment in self.segments:
            if segment.label == task and segment.trial_id in recordings.trial_id:
                trial = recordings.trial_id.index(segment.trial_id)
                parts = pieces(recordings.trial(trial, self.rooted)[segment.start : segment.stop], longest=None)
                own = shown.setdefault(recordings.subject[trial] in DEMONSTRATORS, [])
                own += [Piece(trial, task, states) for states in parts]
        return shown.get(True) or shown.get(False, [])

    def _demonstrations(self, chosen: Sequence[Piece], provenance: dict[str, object]) -> Demonstrations:
        trials = [self.recordings.trial_id[piece.trial] for piece in chosen]
        record = {"generator": NAME, "trials": trials, **provenance}
        return moving([piece.states for piece in chosen], [piece.concept for piece in chosen], record)


def unused_reason(recordings: Recordings, trial: int) -> str:
    """Reason why a trial is in neither training nor validation; empty if it is in either."""
    if recordings.trial_id[trial] in tasks.HELD_OUT:
        return "held out whole, as it shows a new concept"
    if recordings.label[trial] not in TRAINING_CONCEPTS:
        return "description that is no training concept"
    if recordings.kind[trial] in OTHER_FIGURES:
        return f"another figure than the subject's own ({recordings.kind[trial]})"
    return ""


def training_pieces(recordings: Recordings, rooted: bool = False) -> list[Piece]:
    """Pieces of training and validation trials, in the order of the trials; ``rooted`` as in :class:`Recorded`."""
    used = [trial for trial in range(len(recordings)) if not unused_reason(recordings, trial)]
    return [Piece(trial, recordings.label[trial], states) for trial in used for states in pieces(recordings.trial(trial, rooted))]


def validation_trials(training: Sequence[Piece]) -> frozenset[int]:
    """The last, eleventh last ... trial of each concept with three or more trials."""
    trials: dict[str, dict[int, None]] = {}
    for piece in training:
        trials.setdefault(piece.concept, {})[piece.trial] = None
    return frozenset(trial for shown in trials.values() if len(shown) > 2 for trial in list(shown)[::-10])


def pieces(states: NDArray[np.float32], longest: int | None = LONGEST) -> list[Tensor]:
    """Parts of a trial ``(frame, column)`` without glitches, each at least a window; longer ones in overlapping parts."""
    parts = []
    for start, stop in pairwise((0, *glitches(states), len(states))):
        if stop - start < HORIZON:
            continue
        step = stop - start if longest is None else longest - HORIZON + 1
        for first in range(start, stop - HORIZON + 1, step):
            last = stop if longest is None else min(first + longest, stop)
            parts.append(torch.from_numpy(states[first:last].copy()))
    return parts


def glitches(states: NDArray[np.float32]) -> list[int]:
    """Frames of a trial ``(frame, 42)`` or ``(frame, 46)`` that a joint reaches faster than :data:`MAX_SPEED`, around the root."""
    joints = states[:, : len(COLUMNS)].reshape(len(states), -1, 3)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(axis=1, initial=0) * FPS
    return (np.flatnonzero(speed > MAX_SPEED) + 1).tolist()


def at_rest(states: Tensor) -> list[int]:
    """Start frames of windows in ``(frame, column)``: local minima of the distance to standing, within :data:`CYCLE` frames."""
    (standing,) = skeleton.standing_poses(1, generator("cpu", 0))
    distance = torch.linalg.vector_norm(states[:, : len(COLUMNS)] - standing, dim=1)
    frames = range(len(states) - HORIZON + 1)
    return [frame for frame in frames if distance[frame] == distance[max(frame - CYCLE, 0) : frame + CYCLE + 1].min()]


def hang_down(poses: Tensor) -> Tensor:
    """Whether poses ``(pose, 42)`` are upright with both arms hanging down: ``(pose,)``."""
    pairs = skeleton.WRISTS, skeleton.HIPS, skeleton.SHOULDERS, skeleton.ANKLES
    wrists, hips, shoulders, ankles = (skeleton.as_joints(poses)[:, list(pair)] for pair in pairs)
    low = (wrists[..., 2] < shoulders[..., 2] - 0.2).all(dim=1)
    near = (torch.linalg.vector_norm(wrists - hips, dim=-1) < ARMS_DOWN).all(dim=1)
    upright = (shoulders[..., 2] > UPRIGHT).all(dim=1) & (ankles[..., 2].mean(dim=1) < -2 * UPRIGHT)
    return low & near & upright
