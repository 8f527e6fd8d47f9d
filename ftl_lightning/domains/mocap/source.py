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

from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.demonstrations.features import Feature, InitialStates
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.recordings import WHERE, Recordings, read_folder
from ftl_lightning.domains.mocap.segments import Segment
from ftl_lightning.domains.mocap.skeleton import COLUMNS, FPS, HORIZON, as_joints, mirrored
from ftl_lightning.domains.mocap.standing import standing_poses, walking_poses
from ftl_lightning.domains.mocap.tasks import DEMONSTRATORS, HELD_OUT, NEW_CONCEPTS, TRAINING_CONCEPTS, mirrored_text
from ftl_lightning.errors import UserError
from ftl_lightning.seeding import generator, task_key

NAME = "mocap"
POSE = "pose"
"""The observed feature: where the joints are when a plan starts, which is the plan's first state."""
OBSERVED = {POSE: Feature((len(COLUMNS),), state=tuple(range(len(COLUMNS))))}
MAX_SPEED = 12.0
"""Metres a second. A joint that is faster is a glitch, or the hips stand on end and have no yaw; a trial is cut there."""
LONGEST = 128
"""Frames in a piece of a trial; longer ones are cut, and their parts overlap by a window less a frame, so that none is lost."""
OTHER_FIGURES = ("bvh_daz",)
"""Kinds of recordings that are left out: all subjects moved onto one figure that is not theirs."""
CYCLE = 8
"""Frames: what is repeated takes at least twice as many."""
ARMS_DOWN = 0.4
"""Metres at most from a wrist to its hip, sideways and in height, where arms hang down."""
UPRIGHT = 0.35
"""Metres at least from the hips up to the shoulders, and from the ankles up to the hips twice as many, where someone stands."""


def moving(motions: Sequence[Tensor], concepts: Sequence[str], provenance: Mapping[str, object]) -> Demonstrations:
    """Motions ``(frame, 42)`` in metres as demonstrations, with a text each."""
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
    """A stretch of a trial without glitches, of at least one window.

    Attributes:
        trial: which one, by its number.
        concept: what it shows.
        states: ``(frame, 42)`` float32.
    """

    trial: int
    concept: str
    states: Tensor

    def window(self, start: int) -> "Piece":
        """As long as a plan."""
        return Piece(self.trial, self.concept, self.states[start : start + HORIZON])


@dataclass(frozen=True)
class Recorded:
    """Recordings of a folder, which is read when it is needed first.

    Attributes:
        root: the folder; ``None`` where there is none, and then only poses made by rule to start from.
    """

    root: Path | None

    @property
    def recordings(self) -> Recordings:
        """All trials of the folder."""
        return self._folder[0]

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Where single actions are in them."""
        return self._folder[1]

    @property
    def _folder(self) -> tuple[Recordings, tuple[Segment, ...]]:
        if self.root is None:
            raise UserError(f"data.root: expected a folder of recordings, found none; {WHERE}")
        return read_folder(self.root)

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """All pieces of trials of the training concepts, and in ``'train'`` their mirror images.

        How many there are is the recordings' matter, and so ``count`` and ``seed`` do not matter. Of a concept with three trials
        or more, the last one, the eleventh last and so on are for validation, whole. A mirror image is of the description with left
        and right exchanged; where that is no training concept there is none.

        Raises:
            UserError: if the folder has no trial for it.
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
        """Demonstrations of a concept, without replacement where there are enough.

        Those of a new concept are windows as long as a plan, each from where its subject is nearest to standing at rest
        (:func:`at_rest`): what varies over a plan is told at the same times in all of them. Where more are asked for than there
        are, each further one is a window from a random place. Those of a training concept are pieces of its trials.

        Raises:
            UserError: if no trial of the folder shows it.
        """
        new = task in NEW_CONCEPTS
        shown = self._shown(task) if new else [piece for piece in self._pieces if piece.concept == task]
        if not shown:
            raise UserError(f"task: expected a concept that trials in {self.root} show, found {task!r}, which none does")
        draw = generator("cpu", seed, task_key(task))
        every = [piece.window(start) for piece in shown for start in at_rest(piece.states)] if new else shown
        order = torch.randperm(len(every), generator=draw).tolist()
        found = [every[row] for row in order[:count]]
        while len(found) < count:
            piece = shown[int(torch.randint(len(shown), (1,), generator=draw))]
            found.append(piece.window(int(torch.randint(len(piece.states) - HORIZON + 1, (1,), generator=draw))))
        return self._demonstrations(found, {"task": task, "seed": seed})

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """Poses to start from, of trials that are drawn alike.

        Of a training concept those that its own trials pass through: held-out ones, where it has any. Of anything else those of
        people who stand or walk with their arms down, in trials that are in no training split; nobody who demonstrates a new
        concept is among them. Without a folder they are made by rule, see :mod:`ftl_lightning.domains.mocap.standing`.

        Raises:
            UserError: if the folder has neither.
        """
        draw = generator("cpu", seed, task_key(task))
        if self.root is None:
            return InitialStates({POSE: walking_poses(count, draw)})
        trials = self._passed(task) or self.arms_down
        which = torch.randint(len(trials), (count,), generator=draw).tolist()
        share = torch.rand(count, generator=draw).tolist()
        found = [trials[trial][int(part * len(trials[trial]))] for trial, part in zip(which, share, strict=True)]
        return InitialStates({POSE: torch.stack(found)})

    @cached_property
    def arms_down(self) -> tuple[Tensor, ...]:
        """What :meth:`starts` draws from: of each trial with such poses, all of them ``(pose, 42)``.

        Raises:
            UserError: if there is none.
        """
        subjects = self.recordings.subject
        trials = {trial: self.recordings.trial(trial) for trial in sorted(self._validation)}
        poses = [torch.from_numpy(trials[trial]) for trial in trials if subjects[trial] not in DEMONSTRATORS]
        found = tuple(down for one in poses if len(down := one[hang_down(one)]))
        if not found:
            raise UserError(f"{self.root}: expected held-out trials in which someone stands with arms down, found none")
        return found

    def training_poses(self) -> tuple[Tensor, ...]:
        """Of each trial used for training in which someone stands or walks with arms down, all such poses ``(pose, 42)``.

        Mirror images are among them.
        """
        trials = sorted({piece.trial for piece in self._pieces} - self._validation)
        down = [poses[hang_down(poses)] for poses in (torch.from_numpy(self.recordings.trial(trial)) for trial in trials)]
        return tuple(torch.cat((poses, mirrored(poses))) for poses in down if len(poses))

    def _passed(self, concept: str) -> tuple[Tensor, ...]:
        """Poses ``(pose, 42)`` of each piece of a training concept's trials that a window starts from; none where there is none."""
        own = [piece for piece in self._pieces if piece.concept == concept]
        held_out = [piece for piece in own if piece.trial in self._validation]
        return tuple(piece.states[: len(piece.states) - HORIZON + 1] for piece in held_out or own)

    @cached_property
    def _pieces(self) -> list[Piece]:
        """Those of training concepts, in the order of the trials."""
        return _training_pieces(self.recordings)

    @cached_property
    def _validation(self) -> frozenset[int]:
        """Trials that are held out for validation."""
        return _validation_trials(self._pieces)

    def _shown(self, task: str) -> list[Piece]:
        """What subjects show of a new concept."""
        every = self.recordings
        found = []
        for segment in self.segments:
            if segment.label != task or segment.trial_id not in every.trial_id:
                continue
            trial = every.trial_id.index(segment.trial_id)
            if every.subject[trial] in DEMONSTRATORS:
                parts = pieces(every.trial(trial)[segment.start : segment.stop], longest=None)
                found += [Piece(trial, task, states) for states in parts]
        return found

    def _demonstrations(self, found: Sequence[Piece], provenance: dict[str, object]) -> Demonstrations:
        trials = [self.recordings.trial_id[piece.trial] for piece in found]
        told = {"generator": NAME, "trials": trials, **provenance}
        return moving([piece.states for piece in found], [piece.concept for piece in found], told)


def _no_training(every: Recordings, trial: int) -> str:
    """Why a trial is none of those that training and validation take; empty for one of them."""
    if every.trial_id[trial] in HELD_OUT:
        return "held out whole, as it shows a new concept"
    if every.label[trial] not in TRAINING_CONCEPTS:
        return "description that is no training concept"
    if every.kind[trial] in OTHER_FIGURES:
        return f"another figure than the subject's own ({every.kind[trial]})"
    return ""


def _training_pieces(every: Recordings) -> list[Piece]:
    """Pieces of trials that training and validation take, in the order of the trials."""
    wanted = [trial for trial in range(len(every)) if not _no_training(every, trial)]
    return [Piece(trial, every.label[trial], states) for trial in wanted for states in pieces(every.trial(trial))]


def _validation_trials(found: Sequence[Piece]) -> frozenset[int]:
    """Of the trials of each concept with three or more, the last one, the eleventh last and so on."""
    trials: dict[str, list[int]] = {}
    for piece in found:
        if piece.trial not in (known := trials.setdefault(piece.concept, [])):
            known.append(piece.trial)
    return frozenset(trial for known in trials.values() if len(known) > 2 for trial in known[::-10])


def left_out(every: Recordings) -> dict[int, str]:
    """Trials that pretraining sees nothing of, by their numbers, and why."""
    found = _training_pieces(every)
    validation, used = _validation_trials(found), {piece.trial for piece in found}
    reasons = {}
    for trial in range(len(every)):
        short = "" if trial in used else f"no piece of {HORIZON} frames without glitches"
        held_out = "held out for validation" if trial in validation else ""
        if reason := _no_training(every, trial) or short or held_out:
            reasons[trial] = reason
    return reasons


def too_short(states: NDArray[np.float32]) -> int:
    """Frames of a trial ``(frame, 42)`` in pieces that are shorter than a window."""
    ends = pairwise((0, *glitches(states), len(states)))
    return sum(stop - start for start, stop in ends if stop - start < HORIZON)


def pieces(states: NDArray[np.float32], longest: int | None = LONGEST) -> list[Tensor]:
    """Stretches of a trial ``(frame, 42)`` without glitches, of at least a window each; longer ones in parts that overlap."""
    found = []
    for start, stop in pairwise((0, *glitches(states), len(states))):
        if stop - start < HORIZON:
            continue
        step = stop - start if longest is None else longest - HORIZON + 1
        for first in range(start, stop - HORIZON + 1, step):
            last = stop if longest is None else min(first + longest, stop)
            found.append(torch.from_numpy(states[first:last].copy()))
    return found


def glitches(states: NDArray[np.float32]) -> list[int]:
    """Frames of a trial ``(frame, 42)`` that a joint reaches faster than :data:`MAX_SPEED`."""
    joints = states.reshape(len(states), -1, 3)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(axis=1, initial=0) * FPS
    return (np.flatnonzero(speed > MAX_SPEED) + 1).tolist()


def at_rest(states: Tensor) -> list[int]:
    """Frames of ``(frame, 42)`` where windows as long as a plan start: nearest to standing among :data:`CYCLE` on both sides."""
    (standing,) = standing_poses(1, generator("cpu", 0))
    far = torch.linalg.vector_norm(states - standing, dim=1)
    frames = range(len(states) - HORIZON + 1)
    return [frame for frame in frames if far[frame] == far[max(frame - CYCLE, 0) : frame + CYCLE + 1].min()]


def hang_down(poses: Tensor) -> Tensor:
    """Whether someone stands upright with both arms hanging down ``(pose,)``, of poses ``(pose, 42)``."""
    joints = as_joints(poses)
    wrists, hips = joints[:, list(skeleton.WRISTS)], joints[:, list(skeleton.HIPS)]
    shoulders, ankles = joints[:, list(skeleton.SHOULDERS)], joints[:, list(skeleton.ANKLES)]
    low = (wrists[..., 2] < shoulders[..., 2] - 0.2).all(dim=1)
    near = (torch.linalg.vector_norm(wrists - hips, dim=-1) < ARMS_DOWN).all(dim=1)
    upright = (shoulders[..., 2] > UPRIGHT).all(dim=1) & (ankles[..., 2].mean(dim=1) < -2 * UPRIGHT)
    return low & near & upright
