"""A small skeleton, motions of it, and folders of made-up recordings: no recorded motion comes with the project."""

import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.skeleton import FPS, L_WRIST, R_WRIST, standing_poses
from ftl_lightning.domains.mocap.source import FILE, Recordings

BONES = {
    "lhipjoint": ("root", (1, -1, 0), 2.0, (0, 0, 0), ""),
    "lfemur": ("lhipjoint", (0, -1, 0), 7.0, (0, 0, 20), "rx ry rz"),
    "ltibia": ("lfemur", (0, -1, 0), 7.0, (0, 0, 20), "rx"),
    "rhipjoint": ("root", (-1, -1, 0), 2.0, (0, 0, 0), ""),
    "rfemur": ("rhipjoint", (0, -1, 0), 7.0, (0, 0, -20), "rx ry rz"),
    "rtibia": ("rfemur", (0, -1, 0), 7.0, (0, 0, -20), "rx"),
    "thorax": ("root", (0, 1, 0), 6.0, (0, 0, 0), "rx ry rz"),
    "lowerneck": ("thorax", (0, 1, 0), 1.5, (0, 0, 0), "rx ry rz"),
    "head": ("lowerneck", (0, 1, 0), 2.0, (0, 0, 0), "rx ry rz"),
    "lclavicle": ("thorax", (1, 0, 0), 3.0, (0, 0, 0), "ry rz"),
    "lhumerus": ("lclavicle", (1, 0, 0), 5.0, (0, 0, 0), "rx ry rz"),
    "lradius": ("lhumerus", (1, 0, 0), 3.5, (90, 0, 0), "rx"),
    "rclavicle": ("thorax", (-1, 0, 0), 3.0, (0, 0, 0), "ry rz"),
    "rhumerus": ("rclavicle", (-1, 0, 0), 5.0, (0, 0, 0), "rx ry rz"),
    "rradius": ("rhumerus", (-1, 0, 0), 3.5, (90, 0, 0), "rx"),
}
"""Of each bone: what it hangs on, direction, length, axis, degrees of freedom."""


def asf(bones: Mapping[str, tuple[str, tuple[int, int, int], float, tuple[int, int, int], str]] = BONES) -> str:
    """The skeleton as a file."""
    lines = [":version 1.10", ":units", "  length 0.45", "  angle deg", ":root", "  order TX TY TZ RX RY RZ", "  axis XYZ"]
    lines += ["  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    for name, (_, direction, length, axis, dof) in bones.items():
        lines += ["  begin", f"    name {name}", f"    direction {' '.join(map(str, direction))}", f"    length {length}"]
        lines += [f"    axis {' '.join(map(str, axis))} XYZ", *([f"    dof {dof}"] if dof else []), "  end"]
    hierarchy = [f"    {parent} {name}" for name, (parent, *_) in bones.items()]
    return "\n".join([*lines, ":hierarchy", "  begin", *hierarchy, "  end", ""])


def amc(frames: list[dict[str, str]]) -> str:
    """A motion as a file: of each frame, what differs from rest."""
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, frame in enumerate(frames, start=1):
        rest = {"root": "0 17 0 0 0 0"} | {name: " ".join("0" for _ in dof.split()) for name, (*_, dof) in BONES.items() if dof}
        lines += [str(number), *(f"{name} {values}" for name, values in (rest | frame).items())]
    return "\n".join(lines) + "\n"


def swing(frames: int) -> list[dict[str, str]]:
    """Arms that swing from straight out to down and back."""
    angles = 40 + 40 * np.sin(np.arange(frames) / 40)
    return [{"lhumerus": f"0 0 {-angle:.4f}", "rhumerus": f"0 0 {angle:.4f}"} for angle in angles]


def database(folder: Path, trials: Mapping[str, str], frames: int = 160) -> Path:
    """A copy of the database with these trials and their descriptions."""
    folder.mkdir(parents=True, exist_ok=True)
    for trial in trials:
        (folder / f"{trial.split('_')[0]}.asf").write_text(asf())
        (folder / f"{trial}.amc").write_text(amc(swing(frames)))
    index = ["MOTION,DESCRIPTION,SUBJECT", *(f'{trial},"{label}",someone' for trial, label in trials.items())]
    (folder / "cmu-mocap-index.csv").write_text("\n".join(index))
    return folder


def motion(frames: int, number: int) -> NDArray[np.float32]:
    """States ``(frame, 14, 3)`` of someone who stands and lifts the hands a little."""
    (pose,) = standing_poses(1, torch.Generator().manual_seed(number)).reshape(1, 14, 3).numpy()
    found = np.repeat(pose[None], frames, axis=0)
    found[:, [R_WRIST, L_WRIST], 2] += 0.1 * np.sin(np.arange(frames)[:, None] / FPS * 6 + number)
    return found.astype(np.float32)


def recordings(trials: Mapping[str, tuple[str, NDArray[np.float32]]], kind: str = "asf_amc") -> Recordings:
    """Trials by name, each with its description and its states."""
    positions = [states for _, states in trials.values()]
    ends = np.cumsum([0, *map(len, positions)])
    return Recordings(
        np.concatenate(positions),
        np.zeros((ends[-1], 4), np.float32),
        ends.astype(np.int64),
        tuple(trials),
        tuple(label for label, _ in trials.values()),
        (kind,) * len(trials),
        tuple(trial.split("_")[0] for trial in trials),
    )


def folder(path: Path, concepts: Sequence[str] = ()) -> Path:
    """A folder of recordings of a few concepts, new ones among them, and of others that are asked for."""
    trials = {f"02_{number:02}": ("walk", motion(60 + 10 * number, number)) for number in range(1, 6)}
    trials |= {f"03_{number:02}": ("walk, veer left", motion(50, 10 + number)) for number in (1, 2)}
    trials |= {"03_03": ("basketball - forward dribble, 90-degree right turns, crossover dribble", motion(40, 20))}
    trials |= {"13_29": ("jumping jacks, side twists, bend over, squats", motion(1148, 30))}
    trials |= {"13_30": ("jumping jacks, side twists, squats, jog", motion(617, 31))}
    trials |= {f"05_{number:02}": (text, motion(40, number)) for number, text in enumerate(concepts)}
    path.mkdir(parents=True, exist_ok=True)
    recordings(trials).save(path / FILE)
    return path


def script(name: str) -> ModuleType:
    """A script of the benchmarks as a module."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[2] / "benchmarks" / "experiments" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def named_recordings(inside: str = "") -> Path:
    """The folder of recordings that ``FTL_LIGHTNING_DATA`` names; a test without one is skipped."""
    named = os.environ.get("FTL_LIGHTNING_DATA")
    if not named or not (Path(named) / inside).is_dir():
        pytest.skip(f"FTL_LIGHTNING_DATA names no folder of recordings {inside}".rstrip())
    return Path(named)
