"""Convert a user's copy of the database to the file of recordings. Nothing is downloaded."""

import csv
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.asf_amc import Skeleton, read_amc, read_asf
from ftl_lightning.domains.mocap.bvh import read_bvh
from ftl_lightning.domains.mocap.normalise import Poses, every, normalised, z_up
from ftl_lightning.domains.mocap.recordings import FILE, FILES, THANKS, WHERE, Recordings
from ftl_lightning.domains.mocap.segments import SEGMENTS, read_segments
from ftl_lightning.domains.mocap.skeleton import HORIZON, JOINTS, RIGID
from ftl_lightning.domains.mocap.source import glitches, left_out, pieces, too_short
from ftl_lightning.domains.mocap.tasks import HELD_OUT, TRAINING_CONCEPTS, cleaned
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.files import MOST_TEXT, check_readable
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.text import counted

REPORT = "recordings.json"
LEFT_OUT = "left out of pretraining"
"""Key of the report: trials that are kept, but excluded from pretraining."""
INDEXES = ("cmu-mocap-index.csv", "cmu-mocap-index-text.txt")
"""Names of B. Hahne's index of descriptions, as a spreadsheet or as text; the first existing file is read."""
SLOW = ("60", "61", "75", "87", "88", "89")
"""Subjects recorded at 60 frames per second, others at 120 (jutanke/mocap); AMC files do not state it."""
MIN_RAW_FRAMES = 128
"""Minimum frames of a trial before subsampling."""
MAX_SPREAD = 1e-3
"""Maximum range in metres of the length of a bone within a trial."""
FLOOR = 0.05
"""Metres: initial frames with lower hips have no root yet."""
_TRIAL = re.compile(r"(\d{2,3}_\d{2,3})(?!\d)")
EXAMPLES = 3
"""Maximum examples printed per reason; the report has all."""


class _Dropped(Exception):
    """Rejection of a trial, with a general reason and a detail of the trial."""

    def __init__(self, reason: str, detail: str = "") -> None:
        self.reason, self.detail = reason, detail


@dataclass
class _Report:
    """Result per file, and trials excluded from pretraining."""

    kept: dict[str, dict[str, str | int]] = field(default_factory=dict)
    dropped: dict[str, dict[str, str]] = field(default_factory=dict)
    left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)

    def lines(self) -> Iterable[str]:
        frames = sum(int(row["frames"]) for row in self.kept.values())
        labels = len({row["label"] for row in self.kept.values()})
        yield f"kept: {counted(len(self.kept), 'trial')}, {frames} frames at 30 a second, {counted(labels, 'description')}"
        if cuts := {name: row["glitches"] for name, row in self.kept.items() if row["glitches"]}:
            summary = f"{counted(len(cuts), 'trial')}, {counted(sum(map(int, cuts.values())), 'frame')}"
            yield f"kept, cut where a joint is too fast: {summary}"
        if parts := {name: row["too short"] for name, row in self.kept.items() if row["too short"] and name not in self.left_out}:
            summary = f"{counted(sum(map(int, parts.values())), 'frame')} of {counted(len(parts), 'trial')}"
            yield f"of these, left out as pieces shorter than {HORIZON} frames: {summary}"
        yield from _counted(f"dropped: {counted(len(self.dropped), 'file')}", self.dropped)
        yield from _counted(f"kept, but left out of pretraining: {counted(len(self.left_out), 'trial')}", self.left_out)

    def text(self) -> str:
        """JSON text."""
        content = {"kept": self.kept, "dropped": self.dropped, LEFT_OUT: self.left_out, "thanks": THANKS}
        return json.dumps(content, indent=1) + "\n"


def _counted(what: str, trials: Mapping[str, Mapping[str, str]]) -> Iterable[str]:
    """Table of reasons, most frequent first, each with its number of trials and examples."""
    yield what
    for reason, count in Counter(entry["reason"] for entry in trials.values()).most_common():
        examples = [(name, entry["told"]) for name, entry in trials.items() if entry["reason"] == reason]
        listed = ", ".join(f"{name} ({text})" if text else name for name, text in examples[:EXAMPLES])
        yield f"{count:6}  {reason}: {listed}{', ...' if count > EXAMPLES else ''}"


def prepare(root: Path | None, out: Path | None = None) -> str:
    """Read a folder with ASF and AMC files of the database, or BVH files, at any depth, and write ``recordings.npz``.

    Also write ``recordings.json``: kept trials, dropped files with reasons, and trials excluded from pretraining with reasons. An
    existing file of recordings is checked.

    Args:
        root: the folder, with B. Hahne's index of descriptions (:data:`INDEXES`), and optionally ``segments.csv``.
        out: output folder; ``None`` for ``root``.

    Returns:
        Text to print.

    Raises:
        UserError: if there is nothing to read, or no valid trial, with the first reason.
    """
    if root is None:
        raise UserError(f"root: expected a folder with your copy of the database, found none; {WHERE}")
    if not root.is_dir():
        raise UserError(f"root: expected a folder, found {'a file' if root.exists() else 'nothing'} at {short(str(root))}; {WHERE}")
    out = root if out is None else out
    motions = sorted(path for path in root.rglob("*") if path.suffix.lower() in (".amc", ".bvh") and path.is_file())
    ready = next((root / name for name in FILES if (root / name).is_file()), None)
    if ready is not None and ready.name != FILE:  # made elsewhere, not from the files beside it
        motions = []
    if not motions and ready is None:
        raise UserError(f"{root}: expected AMC or BVH files, found {'none' if any(root.iterdir()) else 'an empty folder'}; {WHERE}")
    if (segments := root / SEGMENTS).is_file():
        read_segments(segments)
    report = _Report()
    recordings = _read(root, motions, report) if motions else Recordings.load(ready or root / FILE)
    _list(recordings, report)
    if motions or out / FILE != ready:
        recordings.save(out / FILE)
    write_text(out / REPORT, report.text())
    if segments.is_file() and out.resolve() != root.resolve():
        shutil.copyfile(segments, out / SEGMENTS)
    written = f"recordings: {out / FILE}; every trial, with its reason where it is dropped or left out: {out / REPORT}"
    return "\n".join((*report.lines(), written, THANKS))


def _read(root: Path, motions: list[Path], report: _Report) -> Recordings:
    """Read all valid trials of the folder."""
    descriptions = _index(root)
    skeletons = {path.stem: path for path in sorted(root.rglob("*")) if path.suffix.lower() == ".asf"}
    poses: dict[str, tuple[Poses, str]] = {}
    with bar("reading trials", len(motions)) as advance:
        for path in sorted(motions, key=lambda path: path.suffix.lower()):  # AMC before BVH of the same trial
            named = _TRIAL.match(path.name)
            trial = named[1] if named else path.name
            if trial in poses:
                detail = f"{trial} from {report.files[trial]}"
                report.dropped[path.name] = {"reason": "trial that was read from another file", "told": detail}
            else:
                report.dropped.pop(trial, None)
                try:
                    if named is None:
                        raise _Dropped("file not named after a trial, such as 13_29.amc")
                    poses[trial] = _trial(path, trial, descriptions.get(trial, ""), skeletons)
                    report.files[trial] = path.name
                except _Dropped as dropped:
                    report.dropped[trial] = {"reason": dropped.reason, "told": dropped.detail}
            advance()
    if not poses:
        name, first = next(iter(report.dropped.items()))
        detail = ": ".join(text for text in (name, first["reason"], first["told"]) if text)
        raise UserError(f"{root}: expected a trial that can be used, found none of {len(motions)}; {detail}")
    trials = sorted(poses)
    ends = np.cumsum([0, *(len(poses[trial][0].positions) for trial in trials)])
    return Recordings(
        np.concatenate([poses[trial][0].positions for trial in trials]).astype(np.float32),
        np.concatenate([poses[trial][0].root for trial in trials]).astype(np.float32),
        ends.astype(np.int64),
        tuple(trials),
        tuple(descriptions[trial] for trial in trials),
        tuple(poses[trial][1] for trial in trials),
        tuple(trial.split("_")[0] for trial in trials),
    )


def _trial(path: Path, trial: str, label: str, skeletons: Mapping[str, Path]) -> tuple[Poses, str]:
    """Read poses and kind of a trial."""
    if label in ("", "unknown"):
        raise _Dropped("no description in the index")
    if label not in TRAINING_CONCEPTS and trial not in HELD_OUT:
        raise _Dropped("description that is no training concept", label)
    subject = trial.split("_")[0]
    amc, known = path.suffix.lower() == ".amc", subject in skeletons
    if amc and not known:
        raise _Dropped("no skeleton of the subject", f"{subject}.asf")
    try:
        skeleton = _skeleton(skeletons[subject]) if known else None
        if amc and skeleton is not None:
            joints, raw_fps = skeleton.joints(read_amc(path, skeleton)), 60 if subject in SLOW else 120
            kind = "asf_amc"
        else:
            joints, raw_fps = read_bvh(path, skeleton)
            kind = "bvh_mb" if known else "bvh_mb_thx"
    except UserError as error:
        raise _Dropped("cannot be read", str(error)) from None
    joints = _from_the_floor(z_up(joints))
    if len(joints) < MIN_RAW_FRAMES:
        raise _Dropped(f"shorter than {MIN_RAW_FRAMES} frames", f"{len(joints)} frames")
    if (spread := _spread(joints)) > MAX_SPREAD:
        raise _Dropped("bones that change their length", f"by {1000 * spread:.1f} mm")
    poses = normalised(joints[:: every(60 if subject in SLOW else raw_fps)])
    if not pieces(_states(poses)):
        raise _Dropped(f"less than {HORIZON} frames without glitches", f"of {len(poses.positions)}")
    return poses, kind


def _states(poses: Poses) -> NDArray[np.float32]:
    return poses.positions.astype(np.float32).reshape(-1, 3 * len(JOINTS))


def _list(recordings: Recordings, report: _Report) -> None:
    """Report kept trials, and exclusions from pretraining."""
    reasons = left_out(recordings)
    for number, trial in enumerate(recordings.trial_id):
        name, states = trial if trial not in report.kept else f"{trial} ({number})", recordings.trial(number)
        report.kept[name] = {
            "label": recordings.label[number],
            "kind": recordings.kind[number],
            "file": report.files.get(trial, ""),
            "frames": len(states),
            "glitches": len(glitches(states)),
            "too short": too_short(states),
        }
        if reason := reasons.get(number):
            report.left_out[name] = {"reason": reason, "told": recordings.label[number]}


@cache
def _skeleton(path: Path) -> Skeleton:
    return read_asf(path)


def _from_the_floor(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frames from the first with hips above the floor."""
    above = np.flatnonzero(joints[:, :4:3, 2].mean(axis=1) > FLOOR)
    return joints[above[0] :] if len(above) else joints[:0]


def _spread(joints: NDArray[np.float64]) -> float:
    """Maximum range of the length of a bone, in metres."""
    ends = np.array(RIGID).T
    lengths = np.linalg.norm(joints[:, ends[0]] - joints[:, ends[1]], axis=-1)
    return float(np.ptp(lengths, axis=0).max())


def _index(root: Path) -> dict[str, str]:
    """Read the cleaned descriptions of trials.

    Raises:
        UserError: if there is no index, or no line of a trial.
    """
    path = next((path for name in INDEXES for path in sorted(root.rglob(name))), None)
    if path is None:
        raise UserError(
            f"{root}: expected the index of descriptions, {INDEXES[0]} or {INDEXES[1]}, found neither; it comes with B. Hahne's "
            "conversion of the database (cgspeed.com)"
        )
    check_readable(path, "text", MOST_TEXT)
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = csv.reader(lines) if path.suffix == ".csv" else (line.split("\t") for line in lines)
    descriptions = {row[0].strip(): cleaned(row[1]) for row in rows if len(row) > 1 and _TRIAL.fullmatch(row[0].strip())}
    if not descriptions:
        raise UserError(f"{path}: expected lines such as '13_29,description', found none")
    return descriptions
