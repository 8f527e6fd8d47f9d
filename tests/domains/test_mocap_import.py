"""Motion from BVH files: what was exported comes back, at any rate, and other files are told."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.domains.mocap.bvh import read_motion
from ftl_lightning.domains.mocap.domain import DOMAIN, with_rigid_bones
from ftl_lightning.domains.mocap.skeleton import FPS, HORIZON, standing_poses
from ftl_lightning.domains.mocap.source import LONGEST
from ftl_lightning.services.errors import LONGEST as LINE
from ftl_lightning.services.errors import UserError
from tests.domains.test_mocap_reading import bvh as converted


def imported(path: Path) -> Demonstrations:
    return DOMAIN.imports[path.suffix](path)


def exported(path: Path, states: Tensor) -> Path:
    path.write_text(DOMAIN.show.exports[".bvh"](states))
    return path


def moving(frames: int, rate: float = FPS) -> Tensor:
    """Somebody who lifts both hands and comes down ``(frame, 42)``, at a rate, with rigid bones and hips that do not turn."""
    (pose,) = standing_poses(1, torch.Generator().manual_seed(0))
    states = pose.repeat(frames, 1).unflatten(1, (14, 3))
    wave = torch.sin(torch.arange(frames) / rate * 3)[:, None]
    states[:, [7, 8, 10, 11], 2] += 0.25 * wave
    states[:, [1, 4], 1] += 0.05 * wave
    return with_rigid_bones(states.flatten(1)[None], {"pose": pose[None]})[0]


def test_what_was_exported_is_imported_as_it_is_seen_from_the_hips_of_who_walks_and_turns(tmp_path: Path) -> None:
    states = moving(60)
    found = imported(exported(tmp_path / "one.bvh", states))
    assert found.lengths.tolist() == [60]
    assert (found.states[0] - states).abs().max() < 1e-4
    assert found.domain == DOMAIN.name
    assert found.state_names == DOMAIN.plans.columns
    assert found.concepts == ("",)
    assert found.fitted(DOMAIN.observed) is found
    assert torch.equal(found.observed["pose"], found.states)
    assert imported(exported(tmp_path / "plan.bvh", moving(HORIZON))).states.shape == (1, HORIZON, 42)
    path = exported(tmp_path / "one.bvh", moving(40))
    head, rows = path.read_text().split(f"Frame Time: {1 / FPS:.6f}\n")
    values = np.array([row.split() for row in rows.splitlines()], dtype=float)
    values[:, 0] += np.arange(40) * 0.05  # the root goes along and rises
    values[:, 1] += 0.9
    path.write_text(f"{head}Frame Time: {1 / FPS:.6f}\n" + "\n".join(" ".join(map(str, row)) for row in values))
    assert (imported(path).states[0] - moving(40)).abs().max() < 1e-4


@pytest.mark.parametrize("rate", [24, 25, 60, 100, 120])
def test_other_rates_are_brought_to_the_domains(rate: int, tmp_path: Path) -> None:
    path = exported(tmp_path / "one.bvh", moving(3 * rate, rate))
    path.write_text(path.read_text().replace(f"Frame Time: {1 / FPS:.6f}", f"Frame Time: {1 / rate:.6f}"))
    (states,) = imported(path).states
    assert len(states) == int((3 * rate - 1) / rate * FPS + 1e-6) + 1
    assert (states - moving(len(states))).abs().max() < 2e-3


def test_long_motion_is_in_parts_a_jump_is_cut_and_a_short_one_or_bytes_that_are_no_text_are_told(tmp_path: Path) -> None:
    long = imported(exported(tmp_path / "long.bvh", moving(200)))
    assert long.states.shape[1] == LONGEST
    assert long.lengths.tolist() == [LONGEST, 200 - (LONGEST - HORIZON + 1)]
    states = moving(100)
    states[50:, 2::3] *= -1
    assert imported(exported(tmp_path / "jump.bvh", states)).lengths.tolist() == [50, 50]
    with pytest.raises(UserError, match="expected a motion of 32 frames or more at 30 a second, without jumps, found 20 frames"):
        imported(exported(tmp_path / "short.bvh", moving(20)))
    (tmp_path / "one.bvh").write_bytes(b"\xff\xfe\x00HIERARCHY")
    with pytest.raises(UserError, match="expected a BVH file in utf-8"):
        read_motion(tmp_path / "one.bvh")


def test_the_conversion_of_the_database_is_imported_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "02_01.bvh"
    path.write_text(converted(161))
    found = imported(path)
    assert found.lengths.tolist() == [40]  # every fourth of 160 frames
    hips = found.states[0, 0].unflatten(0, (14, 3))[[0, 3]]
    assert torch.allclose(hips[0], -hips[1])
    assert hips[0, 0] == pytest.approx(1.5 * 0.0254 / 0.45, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: text.replace("LeftForeArm", "Lower_Arm_L"), "found a skeleton without 'LeftForeArm'"),
        (lambda text: text[:-40], "found a damaged one"),
        (lambda text: text.replace("MOTION", "MOTIONS OF"), "found a damaged one"),
        (lambda text: text.partition("MOTION")[0], "no line MOTION"),
        (lambda text: text.replace("HIERARCHY", "ANARCHY"), "no line HIERARCHY"),
        (lambda text: text.replace("}", "", 1), "found a damaged one"),
        (lambda text: text.replace("OFFSET 0", "OFFSET up", 1), "found a damaged one"),
        (lambda text: text.replace("Zrotation", "Wrotation", 1), "channel 'Wrotation'"),
        (lambda text: text.replace("CHANNELS 6", "CHANNELS 999999999", 1), "found a damaged one"),
        (lambda text: text.replace("Frames: 60", "Frames: 61"), "found a damaged one"),
        (lambda text: text.replace("Frame Time: 0.033333", "Frame Time: 0"), "found a damaged one"),
        (lambda text: text.replace("\n0.", "\nnan ", 1), "found a damaged one"),
        (lambda text: "", "found a damaged one"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(change: object, expected: str, tmp_path: Path) -> None:
    path = exported(tmp_path / "one.bvh", moving(60))
    path.write_text(change(path.read_text()))  # type: ignore[operator]
    with pytest.raises(UserError) as error:
        imported(path)
    told = str(error.value)
    assert told.startswith(f"{path}: expected")
    assert expected in told
    assert "\n" not in told
    assert len(told) <= LINE + len(str(path))
