"""Demonstrations from a folder of recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.container import Demonstrations, padded
from ftl_lightning.data.features import Feature, InitialStates
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.recordings import WHERE, Recordings, read_folder
from ftl_lightning.domains.mocap.segments import Segment
from ftl_lightning.domains.mocap.skeleton import COLUMNS, FPS, HORIZON, as_joints, mirrored
from ftl_lightning.domains.mocap.standing import standing_poses, walking_poses
from ftl_lightning.domains.mocap.tasks import DEMONSTRATORS, HELD_OUT, NEW_CONCEPTS, TRAINING_CONCEPTS, mirrored_text
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator, task_key

NAME = "mocap"
POSE = "pose"
"""Observed feature: the joints at the start of a plan, which are the plan's first state."""
OBSERVED = {POSE: Feature((len(COLUMNS),), state=tuple(range(len(COLUMNS))))}
MAX_SPEED = 12.0
"""Maximum joint speed in metres per second. Faster frames are glitches, or hips without defined yaw; trials are cut there."""
LONGEST = 128
"""Maximum frames of a piece; parts of longer pieces overlap by a window less a frame, so that no window is lost."""
OTHER_FIGURES = ("bvh_daz",)
"""Excluded kinds of recordings: all subjects retargeted to the same figure."""
CYCLE = 8
"""Frames; periodic motion has at least twice as many per period."""
ARMS_DOWN = 0.4
"""Maximum distance in metres from wrist to hip, sideways and vertical, of hanging arms."""
UPRIGHT = 0.35
"""Minimum height in metres of shoulders above hips; half the minimum height of hips above ankles."""


def moving(motions: Sequence[Tensor], concepts: Sequence[str], provenance: Mapping[str, object]) -> Demonstrations:
    """Demonstrations from motions ``(frame, 42)`` in metres, with a text each."""
    states, lengths = padded(motions)
    return Demonstrations(
        states=states,
        lengths=lengths,
        domain=NAME,
        state_names=COLUMNS,
        state_units=("m",) * len(COLUMNS),
        concepts=tuple(concepts),
        observed={POSE: states},
        per_step=(POSE,),
        provenance=provenance,
    )


@dataclass(frozen=True)
class Piece:
    """Part of a trial without glitches, at least as long as a window.

    Attributes:
        trial: number of the trial.
        concept: concept of the motion.
        states: ``(frame, 42)`` float32.
    """

    trial: int
    concept: str
    states: Tensor

    def window(self, start: int) -> "Piece":
        """Window of the length of a plan."""
        return Piece(self.trial, self.concept, self.states[start : start + HORIZON])


@dataclass(frozen=True)
class Recorded:
    """Recordings of a folder, read lazily.

    Attributes:
        root: the folder; ``None`` for rule-based initial poses only.
    """

    root: Path | None

    @property
    def recordings(self) -> Recordings:
        """All trials of the folder."""
        return self._folder[0]

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Segments of single actions."""
        return self._folder[1]

    @property
    def _folder(self) -> tuple[Recordings, tuple[Segment, ...]]:
        if self.root is None:
            raise UserError(f"data.root: expected a folder of recordings, found none; {WHERE}")
        return read_folder(self.root)

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """All pieces of trials of the training concepts, and in ``'train'`` their mirror images.

        The recordings determine the number; ``count`` and ``seed`` are ignored. Concepts with three trials or more hold out whole
        trials for validation: the last, the eleventh last and so on. A mirror image has the description with left and right
        exchanged, and is omitted if this is no training concept.

        Raises:
            UserError: if the folder has no trial for the split.
        """
        wanted = [piece for piece in self._pieces if (piece.trial in self._validation) == (name == "validation")]
        if not wanted:
            raise UserError(
                f"{self.root}: expected trials of the training concepts for {name}, found none; use more of the database"
            )
        if name == "train":
            reflected = [Piece(piece.trial, mirrored_text(piece.concept), mirrored(piece.states)) for piece in wanted]
            wanted += [piece for piece in reflected if piece.concept in TRAINING_CONCEPTS]
        return self._demonstrations(wanted, {"split": name})

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """Demonstrations of a concept, without replacement if there are enough.

        For a new concept, windows as long as a plan, each from the pose nearest to standing at rest (:func:`at_rest`), which aligns
        variation over a plan in time. If there are too few, windows from random frames follow. For a training concept, pieces of
        its trials.

        Raises:
            UserError: if no trial of the folder shows the concept.
        """
        new = task in NEW_CONCEPTS
        shown = self._shown(task) if new else [piece for piece in self._pieces if piece.concept == task]
        if not shown:
            raise UserError(f"task: expected a concept that trials in {self.root} show, found {task!r}, which none does")
        draw = generator("cpu", seed, task_key(task))
        every = [piece.window(start) for piece in shown for start in at_rest(piece.states)] if new else shown
        order = torch.randperm(len(every), generator=draw).tolist()
        windows = [every[row] for row in order[:count]]
        while len(windows) < count:
            piece = shown[int(torch.randint(len(shown), (1,), generator=draw))]
            windows.append(piece.window(int(torch.randint(len(piece.states) - HORIZON + 1, (1,), generator=draw))))
        return self._demonstrations(windows, {"task": task, "seed": seed})

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """Initial poses, with equal probability of trials.

        For a training concept, poses of its trials, held out if possible. Otherwise poses of people who stand or walk with arms
        down, in validation trials without demonstrators of new concepts. Without a folder, rule-based poses, see
        :mod:`ftl_lightning.domains.mocap.standing`.

        Raises:
            UserError: if the folder has neither.
        """
        draw = generator("cpu", seed, task_key(task))
        if self.root is None:
            return InitialStates({POSE: walking_poses(count, draw)})
        trials = self._passed(task) or self.arms_down
        which = torch.randint(len(trials), (count,), generator=draw).tolist()
        share = torch.rand(count, generator=draw).tolist()
        poses = [trials[trial][int(part * len(trials[trial]))] for trial, part in zip(which, share, strict=True)]
        return InitialStates({POSE: torch.stack(poses)})

    @cached_property
    def arms_down(self) -> tuple[Tensor, ...]:
        """Poses with arms down ``(pose, 42)`` of each validation trial that has any, for :meth:`starts`.

        Raises:
            UserError: if there is none.
        """
        subjects = self.recordings.subject
        trials = {trial: self.recordings.trial(trial) for trial in sorted(self._validation)}
        poses = [torch.from_numpy(trials[trial]) for trial in trials if subjects[trial] not in DEMONSTRATORS]
        hanging = tuple(down for states in poses if len(down := states[hang_down(states)]))
        if not hanging:
            raise UserError(f"{self.root}: expected held-out trials in which someone stands with arms down, found none")
        return hanging

    def training_poses(self) -> tuple[Tensor, ...]:
        """Poses with arms down ``(pose, 42)`` of each training trial that has any.

        Mirror images are included.
        """
        trials = sorted({piece.trial for piece in self._pieces} - self._validation)
        down = [poses[hang_down(poses)] for poses in (torch.from_numpy(self.recordings.trial(trial)) for trial in trials)]
        return tuple(torch.cat((poses, mirrored(poses))) for poses in down if len(poses))

    def _passed(self, concept: str) -> tuple[Tensor, ...]:
        """Poses ``(pose, 42)`` that start a window, per piece of a training concept's trials; empty if it has no trial."""
        shown = [piece for piece in self._pieces if piece.concept == concept]
        held_out = [piece for piece in shown if piece.trial in self._validation]
        return tuple(piece.states[: len(piece.states) - HORIZON + 1] for piece in held_out or shown)

    @cached_property
    def _pieces(self) -> list[Piece]:
        """Pieces of training concepts, in the order of the trials."""
        return _training_pieces(self.recordings)

    @cached_property
    def _validation(self) -> frozenset[int]:
        """Validation trials."""
        return _validation_trials(self._pieces)

    def _shown(self, task: str) -> list[Piece]:
        """Pieces of a new concept by its demonstrators."""
        every = self.recordings
        shown = []
        for segment in self.segments:
            if segment.label != task or segment.trial_id not in every.trial_id:
                continue
            trial = every.trial_id.index(segment.trial_id)
            if every.subject[trial] in DEMONSTRATORS:
                parts = pieces(every.trial(trial)[segment.start : segment.stop], longest=None)
                shown += [Piece(trial, task, states) for states in parts]
        return shown

    def _demonstrations(self, chosen: Sequence[Piece], provenance: dict[str, object]) -> Demonstrations:
        trials = [self.recordings.trial_id[piece.trial] for piece in chosen]
        record = {"generator": NAME, "trials": trials, **provenance}
        return moving([piece.states for piece in chosen], [piece.concept for piece in chosen], record)


def _no_training(every: Recordings, trial: int) -> str:
    """Reason why a trial is in neither training nor validation; empty if it is in either."""
    if every.trial_id[trial] in HELD_OUT:
        return "held out whole, as it shows a new concept"
    if every.label[trial] not in TRAINING_CONCEPTS:
        return "description that is no training concept"
    if every.kind[trial] in OTHER_FIGURES:
        return f"another figure than the subject's own ({every.kind[trial]})"
    return ""


def _training_pieces(every: Recordings) -> list[Piece]:
    """Pieces of training and validation trials, in the order of the trials."""
    wanted = [trial for trial in range(len(every)) if not _no_training(every, trial)]
    return [Piece(trial, every.label[trial], states) for trial in wanted for states in pieces(every.trial(trial))]


def _validation_trials(training: Sequence[Piece]) -> frozenset[int]:
    """The last, eleventh last ... trial of each concept with three or more trials."""
    trials: dict[str, list[int]] = {}
    for piece in training:
        if piece.trial not in (known := trials.setdefault(piece.concept, [])):
            known.append(piece.trial)
    return frozenset(trial for known in trials.values() if len(known) > 2 for trial in known[::-10])


def left_out(every: Recordings) -> dict[int, str]:
    """Trials without use in pretraining, by number, and reasons."""
    training = _training_pieces(every)
    validation, used = _validation_trials(training), {piece.trial for piece in training}
    reasons = {}
    for trial in range(len(every)):
        short = "" if trial in used else f"no piece of {HORIZON} frames without glitches"
        held_out = "held out for validation" if trial in validation else ""
        if reason := _no_training(every, trial) or short or held_out:
            reasons[trial] = reason
    return reasons


def too_short(states: NDArray[np.float32]) -> int:
    """Number of frames of a trial ``(frame, 42)`` in pieces shorter than a window."""
    ends = pairwise((0, *glitches(states), len(states)))
    return sum(stop - start for start, stop in ends if stop - start < HORIZON)


def pieces(states: NDArray[np.float32], longest: int | None = LONGEST) -> list[Tensor]:
    """Parts of a trial ``(frame, 42)`` without glitches, each at least a window; longer ones in overlapping parts."""
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
    """Frames of a trial ``(frame, 42)`` that a joint reaches faster than :data:`MAX_SPEED`."""
    joints = states.reshape(len(states), -1, 3)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(axis=1, initial=0) * FPS
    return (np.flatnonzero(speed > MAX_SPEED) + 1).tolist()


def at_rest(states: Tensor) -> list[int]:
    """Start frames of windows of ``(frame, 42)``: nearest to standing within :data:`CYCLE` frames on both sides."""
    (standing,) = standing_poses(1, generator("cpu", 0))
    far = torch.linalg.vector_norm(states - standing, dim=1)
    frames = range(len(states) - HORIZON + 1)
    return [frame for frame in frames if far[frame] == far[max(frame - CYCLE, 0) : frame + CYCLE + 1].min()]


def hang_down(poses: Tensor) -> Tensor:
    """Whether poses ``(pose, 42)`` are upright with both arms hanging down: ``(pose,)``."""
    joints = as_joints(poses)
    wrists, hips = joints[:, list(skeleton.WRISTS)], joints[:, list(skeleton.HIPS)]
    shoulders, ankles = joints[:, list(skeleton.SHOULDERS)], joints[:, list(skeleton.ANKLES)]
    low = (wrists[..., 2] < shoulders[..., 2] - 0.2).all(dim=1)
    near = (torch.linalg.vector_norm(wrists - hips, dim=-1) < ARMS_DOWN).all(dim=1)
    upright = (shoulders[..., 2] > UPRIGHT).all(dim=1) & (ankles[..., 2].mean(dim=1) < -2 * UPRIGHT)
    return low & near & upright
