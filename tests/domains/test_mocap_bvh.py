"""Motion from BVH files: what was exported comes back, at any rate, and other files are told."""

import math
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.bvh import HIPS, TREE, bvh, read_motion
from ftl_lightning.domains.mocap.domain import DOMAIN, with_rigid_bones
from ftl_lightning.domains.mocap.skeleton import FPS, HORIZON, as_joints, standing_poses
from ftl_lightning.domains.mocap.source import LONGEST, read_folder
from ftl_lightning.services.errors import LONGEST as LINE
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT, refused, succeed
from tests.domains.mocap_samples import named_recordings
from tests.domains.test_mocap_reading import bvh as converted
from tests.domains.test_mocap_rendering import waving


def imported(path: Path) -> Demonstrations:
    return DOMAIN.recordings.imports[path.suffix](path)


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


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = exported(tmp_path / "one.bvh", moving(60)).read_text()
    plain = imported(tmp_path / "one.bvh")
    for ends in ("\n", "\r\n"):
        (tmp_path / "one.bvh").write_bytes(text.replace("\n", ends).encode("utf-8-sig"))
        assert imported(tmp_path / "one.bvh").hash == plain.hash


def test_frames_are_bounded_before_they_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = exported(tmp_path / "one.bvh", moving(60))
    path.write_text(path.read_text().replace("Frame Time: 0.033333", "Frame Time: 1"))
    assert int(imported(path).lengths.max()) == LONGEST  # one frame a second becomes thirty
    monkeypatch.setattr("ftl_lightning.domains.mocap.bvh.MOST_FRAMES", 1000)
    monkeypatch.setattr("ftl_lightning.domains.mocap.prepare._at_rate", None)
    with pytest.raises(UserError, match="expected motion of at most 1000 frames at 30 a second, found 1800: 60 of 1 s"):
        imported(path)


def _many(count: int, seconds: str, last: str) -> Callable[[str], str]:
    """Change of a file to many short frames, whose last number is ``last``."""

    def changed(text: str) -> str:
        head, _ = text.split("Frames:")
        return f"{head}Frames: {count}\nFrame Time: {seconds}\n" + ("0 " * 50 + "0\n") * (count - 1) + "0 " * 50 + last

    return changed


@pytest.mark.parametrize(
    ("seconds", "last", "expected"),
    [
        ("1", "0", "expected motion of at most 100000 frames at 30 a second, found 2700000: 90000 of 1 s"),
        ("0.033", "nan", "found a damaged one ('nan' where a number was expected)"),
        ("0.033", "", "found a damaged one"),
    ],
)
def test_a_day_of_frames_is_refused_at_once(seconds: str, last: str, expected: str, tmp_path: Path) -> None:
    path = exported(tmp_path / "one.bvh", moving(60))
    path.write_text(_many(90_000, seconds, last)(path.read_text()))
    begin = time.process_time()
    with pytest.raises(UserError) as error:
        imported(path)
    assert expected in str(error.value)
    assert time.process_time() - begin < 2


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
        *(
            (lambda text, seconds=seconds: text.replace("0.033333", seconds, 1), f"Frame Time: expected seconds .* found {seconds}")
            for seconds in ("0", "-0.033", "nan", "inf", "1e5", "1e300", "1e-300", "5e-324", "1e9999")
        ),
        (lambda text: text.replace("Frame Time: 0.033333", "Frame Time: " + "x" * 100_000), "found a damaged one"),
        (lambda text: text.replace("Frames: 60", "Frames: 999999999"), "Frames: expected 1 to 98039 frames of 17 joints"),
        (lambda text: text.replace("Frames: 60", "Frames: -60"), "Frames: expected 1 to"),
        (lambda text: text.replace("Frames: 60", "Frames: " + "9" * 9999), "found a damaged one"),
        (lambda text: text.replace("\n0.", "\n1e308 ", 1), "found a damaged one"),
        (lambda text: text.replace("OFFSET 0.000000", "OFFSET 1e200", 1), "beyond 1e"),
        (lambda text: text.replace("JOINT", "JOINT a { OFFSET 0 0 0 CHANNELS 0 } " * 2000 + "JOINT", 1), "more than 1000 joints"),
        (lambda text: text.replace("\n0.", "\nnan ", 1), "found a damaged one"),
        (lambda text: text + "0", "found a damaged one"),
        (lambda text: text.replace("Frames: 60", "Frames: 98039"), "for 98039 frames of 51 numbers"),
        (lambda text: "", "found a damaged one"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(change: object, expected: str, tmp_path: Path) -> None:
    path = exported(tmp_path / "one.bvh", moving(60))
    path.write_text(change(path.read_text()))  # type: ignore[operator]
    with pytest.raises(UserError) as error:
        imported(path)
    told = str(error.value)
    assert told.startswith(f"{path}: ")
    assert re.search(expected, told)
    assert "\n" not in told
    assert len(told) <= LINE + len(str(path))


SHIPPED = ROOT / "pretrained" / "mocap"
JACKS = SHIPPED / "jumping_jacks.safetensors"
SAMPLE = ["sample", f"--pretrained={SHIPPED}", f"--concept={JACKS}", "--steps=2"]
ENDS = {
    "RightLeg": skeleton.R_ANKLE, "LeftLeg": skeleton.L_ANKLE, "RightForeArm": skeleton.R_WRIST, "LeftForeArm": skeleton.L_WRIST,
}  # fmt: skip


def rotation(axis: str, degrees: float) -> NDArray[np.float64]:
    angle = math.radians(degrees)
    one, other = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[one, one] = turn[other, other] = math.cos(angle)
    turn[one, other], turn[other, one] = -math.sin(angle), math.sin(angle)
    return turn


def read(text: str) -> tuple[dict[str, NDArray[np.float64]], float]:
    """Where joints and end sites are ``(frame, 3)`` by name, the latter with ``.end``, and seconds a frame.

    Positions of a joint stand in place of its offset.
    """
    head, motion = text.split("MOTION\n")
    found: list[tuple[str, int, list[float], list[str]]] = []
    path: list[int] = []
    for words in map(str.split, head.splitlines()):
        match words:
            case ["ROOT" | "JOINT", name]:
                found.append((name, path[-1] if path else -1, [], []))
            case ["End", "Site"]:
                found.append((f"{found[path[-1]][0]}.end", path[-1], [], []))
            case ["{"]:
                path.append(len(found) - 1)
            case ["}"]:
                path.pop()
            case ["OFFSET", *numbers]:
                found[path[-1]][2].extend(map(float, numbers))
            case ["CHANNELS", count, *channels]:
                assert int(count) == len(channels)
                found[path[-1]][3].extend(channels)
    assert not path
    frames, seconds, *rows = motion.splitlines()
    assert int(frames.removeprefix("Frames: ")) == len(rows)
    places: dict[str, list[NDArray[np.float64]]] = {name: [] for name, *_ in found}
    for row in rows:
        values = iter(map(float, row.split()))
        turns, at = [], []
        for name, parent, offset, channels in found:
            own, turn = np.array(offset), np.eye(3)
            for channel in channels:
                if channel.endswith("position"):
                    own["XYZ".index(channel[0])] = next(values)
                else:
                    turn = turn @ rotation(channel[0], next(values))
            at.append(at[parent] + turns[parent] @ own if parent >= 0 else own)
            turns.append(turns[parent] @ turn if parent >= 0 else turn)
            places[name].append(at[-1])
        assert next(values, None) is None
    return {name: np.stack(own) for name, own in places.items()}, float(seconds.removeprefix("Frame Time: "))


def joints(text: str, from_hips: bool = True) -> Tensor:
    """Joints ``(frame, 14, 3)`` of a file, in the domain's axes, seen from the hips or from the ground."""
    places, _ = read(text)
    if from_hips:
        places = {name: own - places["Hips"] for name, own in places.items()}
    found = [places[f"{name}.end"] for name in ENDS] + [places[joint.name] for joint in TREE if joint.place != HIPS]
    numbers = [*ENDS.values(), *(joint.place for joint in TREE if joint.place != HIPS)]
    x, y, z = np.moveaxis(np.stack(found, axis=1)[:, np.argsort(numbers)], -1, 0)
    return torch.from_numpy(np.stack((-x, z, y), axis=-1)).float()


def far(states: Tensor) -> float:
    """Metres by which a joint is elsewhere in the file, at most."""
    return float(torch.linalg.vector_norm(joints(bvh(states)) - as_joints(states), dim=-1).max())


def wild(frames: int, seed: int) -> Tensor:
    """Somebody whose every joint goes anywhere ``(frames, 42)``, with rigid bones, turned by any angle."""
    draw = torch.Generator().manual_seed(seed)
    (pose,) = standing_poses(1, draw)
    states = pose + 0.4 * torch.randn(frames, 42, generator=draw).cumsum(dim=0)
    return with_rigid_bones(states[None], {"pose": pose[None]})[0]


def test_forward_kinematics_of_a_file_gives_the_joints_back() -> None:
    for states in (waving(), standing_poses(1, torch.Generator().manual_seed(3)), wild(40, 0), wild(40, 1)):
        rigid = with_rigid_bones(states[None], {"pose": states[:1]})[0]
        assert far(rigid) < 1e-4


def test_a_file_is_of_metres_y_up_facing_z_at_thirty_frames_a_second_and_somebody_stands_at_rest_in_it() -> None:
    places, seconds = read(bvh(standing_poses(1, torch.Generator().manual_seed(0))))
    assert seconds == pytest.approx(1 / 30, abs=1e-6)
    assert 1.5 < places["Head"][0, 1] < 1.6
    assert places["LeftUpLeg"][0, 0] > 0.08  # the person's left
    assert places["Head"][0, 2] > 0.05  # the head is before the hips
    assert min(places[f"{side}Leg.end"][0, 1] for side in ("Left", "Right")) == pytest.approx(0, abs=1e-5), "on the ground"
    states = standing_poses(1, torch.Generator().manual_seed(5))
    text = bvh(states)
    rows = text.splitlines()[-1].split()
    still = text.replace(text.splitlines()[-1], " ".join("0" if abs(float(one)) < 1e-3 else one for one in rows))
    assert float((joints(still) - as_joints(states)).abs().max()) < 1e-4  # it stands as it would at rest, and so nothing turns


def test_who_walks_goes_along_and_the_lower_foot_does_not_slide() -> None:
    """A stride of each leg in turn, seen from the hips: the foot that is down goes backwards, so the hips go forwards."""
    frames = torch.arange(41)
    states = as_joints(standing_poses(1, torch.Generator().manual_seed(0)).repeat(41, 1)).clone()
    swing = torch.sin(2 * math.pi * frames / 20)
    for side, (knee, ankle) in ((1, (skeleton.R_KNEE, skeleton.R_ANKLE)), (-1, (skeleton.L_KNEE, skeleton.L_ANKLE))):
        lift = (side * torch.cos(2 * math.pi * frames / 20)).clamp(min=0)  # of the leg that swings forwards, with a bent knee
        states[:, knee, 1] += side * 0.15 * swing + 0.25 * lift
        states[:, ankle, 1] += side * 0.3 * swing
        states[:, [knee, ankle], 2] += torch.stack((0.1 * lift, 0.25 * lift), dim=1)
    seen = joints(bvh(with_rigid_bones(states.flatten(1)[None], {"pose": states[:1].flatten(1)})[0]), from_hips=False)
    ankles = seen[:, list(skeleton.ANKLES)]
    assert ankles[..., 2].amin(dim=1).abs().max() < 1e-4, "someone is on the ground in every frame"
    lower = (ankles[1:, :, 2] + ankles[:-1, :, 2]).argmin(dim=1)
    assert ankles.diff(dim=0)[torch.arange(40), lower, :2].abs().max() < 1e-4
    assert seen[-1, skeleton.HEAD, 1] - seen[0, skeleton.HEAD, 1] > 1, "metres"


def test_an_arm_overhead_does_not_spin() -> None:
    up = as_joints(standing_poses(1, torch.Generator().manual_seed(0)).repeat(30, 1)).clone()
    for frame in range(30):  # round the place straight above the shoulder, close to it
        around = 2 * math.pi * frame / 30
        way = torch.tensor((0.02 * math.cos(around), 0.02 * math.sin(around), 1.0))
        for shoulder, elbow, wrist in ((6, 7, 8), (9, 10, 11)):
            up[frame, elbow], up[frame, wrist] = up[frame, shoulder] + 0.28 * way, up[frame, shoulder] + 0.5 * way
    rows = [[float(number) for number in line.split()] for line in bvh(up.flatten(1)).splitlines()[-30:]]
    assert np.abs(np.diff(rows, axis=0)).max() < 5  # degrees
    assert far(up.flatten(1)) < 1e-3


def test_half_a_turn_and_a_bone_without_a_direction_are_written() -> None:
    (pose,) = standing_poses(1, torch.Generator().manual_seed(0))
    states = torch.stack((pose, -pose, pose))
    assert far(states) < 1e-4
    gone = as_joints(states.clone())
    gone[:, skeleton.R_ELBOW] = gone[:, skeleton.R_SHOULDER]
    assert "nan" not in bvh(gone.flatten(1))
    with pytest.raises(UserError, match="export: expected motion of finite numbers"):
        bvh(states * math.nan)


@pytest.mark.slow
def test_samples_are_exported_each_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    succeed(*SAMPLE, "--count=3", "--out=jj.safetensors", f"--export={tmp_path / 'new' / 'jj.bvh'}")
    assert "jj_0.bvh to jj_2.bvh" in capsys.readouterr().out
    for number, plan in enumerate(Demonstrations.load("jj.safetensors").states):
        found = joints((tmp_path / "new" / f"jj_{number}.bvh").read_text())
        assert float((found - as_joints(plan)).abs().max()) < 1e-3
    succeed(*SAMPLE, "--count=1", f"--export={tmp_path / 'one.bvh'}")
    assert sorted(path.name for path in tmp_path.glob("*.bvh")) == ["one.bvh"]
    succeed(*SAMPLE, "--count=11", "--export=many.bvh")
    assert sorted(path.name for path in Path().glob("many*.bvh"))[::10] == ["many_00.bvh", "many_10.bvh"]


@pytest.mark.parametrize(
    ("arguments", "export", "expected"),
    [
        (SAMPLE, "jj.fbx", "expected a name that ends in .bvh, found 'jj.fbx'"),
        (SAMPLE, "taken.bvh", "taken_1.bvh: expected a file or nothing there, found a folder"),
        (SAMPLE, "jj.safetensors/jj.bvh", "jj.safetensors/jj.bvh: cannot be written"),
        (SAMPLE, "/proc/nowhere/jj.bvh", "/proc/nowhere/jj.bvh: cannot be written"),
        (
            ["sample", "--pretrained=object_rearrangement", "--compose=circle above square"],
            "scene.bvh",
            "expected none, as nothing else reads plans of object_rearrangement, found 'scene.bvh'",
        ),
    ],
)
def test_what_cannot_be_exported_is_refused_before_anything_is_generated(
    arguments: list[str], export: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken_1.bvh").mkdir()
    Path("jj.safetensors").write_text("of the user")
    found = refused(capsys, [*arguments, "--count=2", "--out=out.safetensors", f"--export={export}"])
    assert found.startswith(f"error: export: {expected}")
    assert found.count("\n") == 1


def test_recorded_motion_comes_back_too() -> None:
    """Where recordings are named: those whose bones are rigid, as all that ``prepare`` keeps are."""
    recorded, _ = read_folder(named_recordings())
    for number in range(0, len(recorded), 9):
        assert far(torch.from_numpy(recorded.trial(number)[:32])) < 1e-3
