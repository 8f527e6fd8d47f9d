"""From a user's own copy of the database to the one file of recordings that the rest reads. Nothing is downloaded."""

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
from ftl_lightning.errors import UserError, short
from ftl_lightning.limits import MOST_TEXT, expect_readable
from ftl_lightning.progress import bar
from ftl_lightning.representation import counted
from ftl_lightning.tensor_file import write_text

REPORT = "recordings.json"
LEFT_OUT = "left out of pretraining"
"""Key of the report: trials that are kept for learning, judging or validation alone."""
INDEXES = ("cmu-mocap-index.csv", "cmu-mocap-index-text.txt")
"""Names of B. Hahne's index of descriptions, as a spreadsheet or as text; the first one found is read."""
SLOW = ("60", "61", "75", "87", "88", "89")
"""Subjects recorded at 60 frames a second, the others at 120 (jutanke/mocap); AMC files do not say."""
MIN_RAW_FRAMES = 128
"""Of a trial, before it is thinned out."""
MAX_SPREAD = 1e-3
"""Metres by which the length of a bone may differ within a trial."""
FLOOR = 0.05
"""Metres: first frames with hips lower than that have no root yet."""
_TRIAL = re.compile(r"(\d{2,3}_\d{2,3})(?!\d)")
EXAMPLES = 3
"""Of each reason that are printed; the report has all."""


class _Dropped(Exception):
    """A trial is left out, for a reason that it may share with others; ``told`` is of this trial alone."""

    def __init__(self, reason: str, told: str = "") -> None:
        self.reason, self.told = reason, told


@dataclass
class _Report:
    """What became of each file, and which trials are kept, but not pretrained on."""

    kept: dict[str, dict[str, str | int]] = field(default_factory=dict)
    dropped: dict[str, dict[str, str]] = field(default_factory=dict)
    left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)

    def lines(self) -> Iterable[str]:
        frames = sum(int(one["frames"]) for one in self.kept.values())
        labels = len({one["label"] for one in self.kept.values()})
        yield f"kept: {counted(len(self.kept), 'trial')}, {frames} frames at 30 a second, {counted(labels, 'description')}"
        if cuts := {name: one["glitches"] for name, one in self.kept.items() if one["glitches"]}:
            told = f"{counted(len(cuts), 'trial')}, {counted(sum(map(int, cuts.values())), 'frame')}"
            yield f"kept, cut where a joint is too fast: {told}"
        if parts := {name: one["too short"] for name, one in self.kept.items() if one["too short"] and name not in self.left_out}:
            told = f"{counted(sum(map(int, parts.values())), 'frame')} of {counted(len(parts), 'trial')}"
            yield f"of these, left out as pieces shorter than {HORIZON} frames: {told}"
        yield from _counted(f"dropped: {counted(len(self.dropped), 'file')}", self.dropped)
        yield from _counted(f"kept, but left out of pretraining: {counted(len(self.left_out), 'trial')}", self.left_out)

    def text(self) -> str:
        """As JSON."""
        content = {"kept": self.kept, "dropped": self.dropped, LEFT_OUT: self.left_out, "thanks": THANKS}
        return json.dumps(content, indent=1) + "\n"


def _counted(what: str, trials: Mapping[str, Mapping[str, str]]) -> Iterable[str]:
    """A table of reasons, the most frequent first, each with its number of trials and a few of them."""
    yield what
    for reason, count in Counter(one["reason"] for one in trials.values()).most_common():
        own = [(name, one["told"]) for name, one in trials.items() if one["reason"] == reason]
        told = ", ".join(f"{name} ({text})" if text else name for name, text in own[:EXAMPLES])
        yield f"{count:6}  {reason}: {told}{', ...' if count > EXAMPLES else ''}"


def prepare(root: Path | None, out: Path | None = None) -> str:
    """Read a folder with the database's ASF and AMC files, or BVH files, at any depth, and write ``recordings.npz``.

    Beside it stands ``recordings.json``: what was kept, what was dropped and why, and what is kept but not pretrained on and why. A
    folder that holds recordings already is checked.

    Args:
        root: the folder, with B. Hahne's index of descriptions (:data:`INDEXES`), and maybe ``segments.csv``.
        out: folder to write; ``None`` for the same.

    Returns:
        What to print.

    Raises:
        UserError: where there is nothing to read, or no trial can be used, with the first reason.
    """
    if root is None:
        raise UserError(f"root: expected a folder with your copy of the database, found none; {WHERE}")
    if not root.is_dir():
        raise UserError(f"root: expected a folder, found {'a file' if root.exists() else 'nothing'} at {short(str(root))}; {WHERE}")
    out = root if out is None else out
    motions = sorted(path for path in root.rglob("*") if path.suffix.lower() in (".amc", ".bvh") and path.is_file())
    ready = next((root / name for name in FILES if (root / name).is_file()), None)
    if ready is not None and ready.name != FILE:  # made elsewhere: what lies beside it is not what it was made from
        motions = []
    if not motions and ready is None:
        raise UserError(f"{root}: expected AMC or BVH files, found {'none' if any(root.iterdir()) else 'an empty folder'}; {WHERE}")
    if (own := root / SEGMENTS).is_file():
        read_segments(own)
    report = _Report()
    recordings = _read(root, motions, report) if motions else Recordings.load(ready or root / FILE)
    _list(recordings, report)
    if motions or out / FILE != ready:
        recordings.save(out / FILE)
    write_text(out / REPORT, report.text())
    if own.is_file() and out.resolve() != root.resolve():
        shutil.copyfile(own, out / SEGMENTS)
    written = f"recordings: {out / FILE}; every trial, with its reason where it is dropped or left out: {out / REPORT}"
    return "\n".join((*report.lines(), written, THANKS))


def _read(root: Path, motions: list[Path], report: _Report) -> Recordings:
    """Every trial of the folder that can be used."""
    descriptions = _index(root)
    skeletons = {path.stem: path for path in sorted(root.rglob("*")) if path.suffix.lower() == ".asf"}
    found: dict[str, tuple[Poses, str]] = {}
    with bar("reading trials", len(motions)) as advance:
        for path in sorted(motions, key=lambda path: path.suffix.lower()):  # AMC before BVH of the same trial
            named = _TRIAL.match(path.name)
            trial = named[1] if named else path.name
            if trial in found:
                told = f"{trial} from {report.files[trial]}"
                report.dropped[path.name] = {"reason": "trial that was read from another file", "told": told}
            else:
                report.dropped.pop(trial, None)
                try:
                    if named is None:
                        raise _Dropped("file not named after a trial, such as 13_29.amc")
                    found[trial] = _trial(path, trial, descriptions.get(trial, ""), skeletons)
                    report.files[trial] = path.name
                except _Dropped as dropped:
                    report.dropped[trial] = {"reason": dropped.reason, "told": dropped.told}
            advance()
    if not found:
        name, first = next(iter(report.dropped.items()))
        told = ": ".join(text for text in (name, first["reason"], first["told"]) if text)
        raise UserError(f"{root}: expected a trial that can be used, found none of {len(motions)}; {told}")
    trials = sorted(found)
    ends = np.cumsum([0, *(len(found[trial][0].positions) for trial in trials)])
    return Recordings(
        np.concatenate([found[trial][0].positions for trial in trials]).astype(np.float32),
        np.concatenate([found[trial][0].root for trial in trials]).astype(np.float32),
        ends.astype(np.int64),
        tuple(trials),
        tuple(descriptions[trial] for trial in trials),
        tuple(found[trial][1] for trial in trials),
        tuple(trial.split("_")[0] for trial in trials),
    )


def _trial(path: Path, trial: str, label: str, skeletons: Mapping[str, Path]) -> tuple[Poses, str]:
    """Poses of one and its kind."""
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
    """Tell what was kept, and what of it pretraining leaves out."""
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
    """Frames from the first one in which the hips are above the floor."""
    above = np.flatnonzero(joints[:, :4:3, 2].mean(axis=1) > FLOOR)
    return joints[above[0] :] if len(above) else joints[:0]


def _spread(joints: NDArray[np.float64]) -> float:
    """The most by which the length of a bone differs, in metres."""
    ends = np.array(RIGID).T
    lengths = np.linalg.norm(joints[:, ends[0]] - joints[:, ends[1]], axis=-1)
    return float(np.ptp(lengths, axis=0).max())


def _index(root: Path) -> dict[str, str]:
    """Descriptions of trials, cleaned.

    Raises:
        UserError: where there is no index, or none of its lines is of a trial.
    """
    path = next((path for name in INDEXES for path in sorted(root.rglob(name))), None)
    if path is None:
        raise UserError(
            f"{root}: expected the index of descriptions, {INDEXES[0]} or {INDEXES[1]}, found neither; it comes with B. Hahne's "
            "conversion of the database (cgspeed.com)"
        )
    expect_readable(path, "text", MOST_TEXT)
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = csv.reader(lines) if path.suffix == ".csv" else (line.split("\t") for line in lines)
    found = {row[0].strip(): cleaned(row[1]) for row in rows if len(row) > 1 and _TRIAL.fullmatch(row[0].strip())}
    if not found:
        raise UserError(f"{path}: expected lines such as '13_29,description', found none")
    return found
