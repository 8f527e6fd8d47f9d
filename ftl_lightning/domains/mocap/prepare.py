"""Convert a user's copy of the database to the file of recordings. Nothing is downloaded."""

import csv
import functools
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap import source
from ftl_lightning.domains.mocap.asf_amc import read_amc, read_asf
from ftl_lightning.domains.mocap.bvh import CONVERTED, EXPORTED, converted, read_bvh, read_motion
from ftl_lightning.domains.mocap.skeleton import FPS, HIPS, HORIZON, RIGID, Poses, normalised, z_up
from ftl_lightning.domains.mocap.source import FILE, FILES, THANKS, WHERE, Recordings, pieces
from ftl_lightning.domains.mocap.tasks import HELD_OUT, SEGMENTS, TRAINING_CONCEPTS, cleaned, read_segments
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import MOST_TEXT, check_readable
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.text import counted

REPORT = "recordings.json"
LEFT_OUT = "left out of pretraining"  # Key of the report: trials that are kept, but excluded from pretraining
INDEXES = ("cmu-mocap-index.csv", "cmu-mocap-index-text.txt")
"""B. Hahne's index of descriptions, as a spreadsheet or as text; the first existing file is read."""
SLOW = ("60", "61", "75", "87", "88", "89")
"""Subjects recorded at 60 frames per second, others at 120 (jutanke/mocap); AMC files do not state it."""
MIN_RAW_FRAMES = 128  # Minimum frames of a trial before subsampling
MAX_SPREAD = 1e-3  # Maximum range in metres of the length of a bone within a trial
FLOOR = 0.05  # Metres: initial frames with lower hips have no root yet
_TRIAL = re.compile(r"(\d{2,3}_\d{2,3})(?!\d)")
EXAMPLES = 3  # Maximum examples printed per reason; the report has all
SAME_RATE = 0.01  # Relative difference of frame rates that is rounding
_skeleton = functools.cache(read_asf)


class _Dropped(Exception):
    """Rejection of a trial, with a general reason and a detail of the trial."""

    def __init__(self, reason: str, detail: str = "") -> None:
        self.reason, self.detail = reason, detail


def _keep(condition: object, reason: str, detail: str = "") -> None:
    """Reject a trial unless a condition holds."""
    if not condition:
        raise _Dropped(reason, detail)


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


def _counted(what: str, trials: Mapping[str, Mapping[str, str]]) -> Iterable[str]:
    """Table of reasons, most frequent first, each with its number of trials and examples."""
    yield what
    for reason, count in Counter(entry["reason"] for entry in trials.values()).most_common():
        examples = [(name, entry["told"]) for name, entry in trials.items() if entry["reason"] == reason]
        listed = ", ".join(f"{name} ({text})" if text else name for name, text in examples[:EXAMPLES])
        yield f"{count:6}  {reason}: {listed}{', ...' if count > EXAMPLES else ''}"


def prepare(root: Path | None, out: Path | None = None) -> str:
    """Read a folder with ASF and AMC files of the database, or BVH files, at any depth, and write ``recordings.npz``.

    Also write ``recordings.json``: kept trials, dropped files and trials excluded from pretraining, with reasons. An existing file
    of recordings is checked. Return the text to print.

    Args:
        root: the folder, with B. Hahne's index of descriptions (:data:`INDEXES`), and optionally ``segments.csv``.
        out: output folder; ``None`` for ``root``.

    Raises:
        UserError: if there is nothing to read, or no valid trial, with the first reason.
    """
    if root is None:
        raise UserError(f"root: expected a folder with your copy of the database, found none; {WHERE}")
    present = f"{'a file' if root.exists() else 'nothing'} at {short(str(root))}; {WHERE}"
    require(root.is_dir(), "root", "a folder", present)
    out = root if out is None else out
    motions = sorted(path for path in root.rglob("*") if path.suffix.lower() in (".amc", ".bvh") and path.is_file())
    ready = next((root / name for name in FILES if (root / name).is_file()), None)
    if ready is not None and ready.name != FILE:  # made elsewhere, not from the files beside it
        motions = []
    present = f"{'none' if any(root.iterdir()) else 'an empty folder'}; {WHERE}"
    require(motions or ready, str(root), "AMC or BVH files", present)
    if (segments := root / SEGMENTS).is_file():
        read_segments(segments)
    report = _Report()
    recordings = _read(root, motions, report) if motions else Recordings.load(ready or root / FILE)
    _list(recordings, report)
    if motions or out / FILE != ready:
        recordings.save(out / FILE)
    content = {"kept": report.kept, "dropped": report.dropped, LEFT_OUT: report.left_out, "thanks": THANKS}
    write_text(out / REPORT, json.dumps(content, indent=1) + "\n")
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
                    _keep(named, "file not named after a trial, such as 13_29.amc")
                    poses[trial] = _trial(path, trial, descriptions.get(trial, ""), skeletons)
                    report.files[trial] = path.name
                except _Dropped as dropped:
                    report.dropped[trial] = {"reason": dropped.reason, "told": dropped.detail}
            advance()
    if not poses:
        name, first = next(iter(report.dropped.items()))
        detail = ": ".join(text for text in (name, first["reason"], first["told"]) if text)
        raise UserError(f"{root}: expected a valid trial, found none of {len(motions)}; {detail}")
    trials = sorted(poses)
    moved, kinds = zip(*(poses[trial] for trial in trials), strict=True)
    return Recordings(
        np.concatenate([poses.positions for poses in moved]).astype(np.float32),
        np.concatenate([poses.root for poses in moved]).astype(np.float32),
        np.cumsum([0, *(len(poses.root) for poses in moved)]).astype(np.int64),
        tuple(trials),
        tuple(descriptions[trial] for trial in trials),
        kinds,
        tuple(trial.split("_")[0] for trial in trials),
    )


def _trial(path: Path, trial: str, label: str, skeletons: Mapping[str, Path]) -> tuple[Poses, str]:
    """Read poses and kind of a trial."""
    subject = trial.split("_")[0]
    amc, known = path.suffix.lower() == ".amc", subject in skeletons
    _keep(label not in ("", "unknown"), "no description in the index")
    _keep(label in TRAINING_CONCEPTS or trial in HELD_OUT, "description that is no training concept", label)
    _keep(known or not amc, "no skeleton of the subject", f"{subject}.asf")
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
    joints = z_up(joints)
    above = joints[:, HIPS, 2].mean(axis=1) > FLOOR
    joints = joints[above.argmax() :] if above.any() else joints[:0]
    _keep(len(joints) >= MIN_RAW_FRAMES, f"shorter than {MIN_RAW_FRAMES} frames", f"{len(joints)} frames")
    spread = _spread(joints)
    _keep(spread <= MAX_SPREAD, "bones that change their length", f"by {1000 * spread:.1f} mm")
    poses = normalised(joints[:: max(1, round((60 if subject in SLOW else raw_fps) / FPS))])
    _keep(pieces(poses.states), f"less than {HORIZON} frames without glitches", f"of {len(poses.positions)}")
    return poses, kind


def _list(recordings: Recordings, report: _Report) -> None:
    """Report kept trials, and exclusions from pretraining."""
    training = source.training_pieces(recordings)
    validation, used = source.validation_trials(training), {piece.trial for piece in training}
    for number, trial in enumerate(recordings.trial_id):
        name, states = trial if trial not in report.kept else f"{trial} ({number})", recordings.trial(number)
        lengths = np.diff((0, *source.glitches(states), len(states)))
        short = "" if number in used else f"no piece of {HORIZON} frames without glitches"
        held_out = "held out for validation" if number in validation else ""
        report.kept[name] = {
            "label": recordings.label[number],
            "kind": recordings.kind[number],
            "file": report.files.get(trial, ""),
            "frames": len(states),
            "glitches": len(lengths) - 1,
            "too short": int(lengths[lengths < HORIZON].sum()),
        }
        if reason := source.unused_reason(recordings, number) or short or held_out:
            report.left_out[name] = {"reason": reason, "told": recordings.label[number]}


def _spread(joints: NDArray[np.float64]) -> float:
    """Maximum range of the length of a bone, in metres."""
    ends = np.array(RIGID).T
    lengths = np.linalg.norm(joints[:, ends[0]] - joints[:, ends[1]], axis=-1)
    return float(np.ptp(lengths, axis=0).max())


def _index(root: Path) -> dict[str, str]:
    """Read the cleaned descriptions of trials; raise a ``UserError`` if there is no index, or no line of a trial."""
    path = next((path for name in INDEXES for path in sorted(root.rglob(name))), None)
    if path is None:
        hint = "it comes with B. Hahne's conversion of the database (cgspeed.com)"
        raise UserError(f"{root}: expected the index of descriptions, {INDEXES[0]} or {INDEXES[1]}, found neither; {hint}")
    check_readable(path, "text", MOST_TEXT)
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows = csv.reader(lines) if path.suffix == ".csv" else (line.split("\t") for line in lines)
    descriptions = {row[0].strip(): cleaned(row[1]) for row in rows if len(row) > 1 and _TRIAL.fullmatch(row[0].strip())}
    require(descriptions, str(path), "lines such as '13_29,description'", "none")
    return descriptions


def demonstrated(path: Path, rooted: bool = False) -> Demonstrations:
    """Demonstrations, without text, from a file of ``sample --export``, at any frame rate, or of the conversion.

    Each is a piece without glitches, with the root if ``rooted``.

    Raises:
        UserError: for a file that is damaged, of another skeleton, or shorter than a plan.
    """
    motion = read_motion(path)
    if motion.names.issuperset(CONVERTED):
        joints = converted(motion, None)
    else:
        expected = "a skeleton of 'sample --export', or of the MotionBuilder-friendly conversion of the CMU database"
        for name in EXPORTED:
            require(name in motion.names, str(path), expected, f"a skeleton without {name!r}")
        joints = motion.places(EXPORTED)
    poses = normalised(z_up(_at_rate(joints, motion.seconds)))
    states = poses.rooted if rooted else poses.states
    parts = pieces(states)
    expected = f"a motion of {HORIZON} frames or more at {FPS} a second, without jumps"
    require(parts, str(path), expected, f"{len(states)} frames")
    return source.moving(parts, [""] * len(parts), {"generator": "BVH file", "file": path.name})


demonstrated_with_root = functools.partial(demonstrated, rooted=True)


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
