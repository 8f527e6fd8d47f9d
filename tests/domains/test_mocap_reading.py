"""Reading motion capture: kinematics, the folder of a user's own copy, and everything that can be wrong with it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ftl_lightning.domains.mocap.asf_amc import INCH, JOINT_BONES, read_amc, read_asf
from ftl_lightning.domains.mocap.bvh import METRES, NODES, read_bvh
from ftl_lightning.domains.mocap.prepare import LEFT_OUT, REPORT, prepare
from ftl_lightning.domains.mocap.skeleton import JOINTS, normalised, z_up
from ftl_lightning.domains.mocap.source import FILE, Recorded, Recordings, read_folder
from ftl_lightning.domains.mocap.tasks import SEGMENTS, SHIPPED, read_segments
from ftl_lightning.services.errors import UserError
from tests.conftest import refused, succeed
from tests.domains.mocap_samples import BONES, amc, asf, database, motion, named_recordings, recordings, swing

UNIT = INCH / 0.45
WALK, TURN = {"02_01": "walk"}, {"02_01": "walk", "02_02": "Walk, Veer_Left"}


def joints(tmp_path: Path, *frames: dict[str, str], skeleton: str = "") -> NDArray[np.float64]:
    """Where joints are in frames, in units of the file."""
    (tmp_path / "02.asf").write_text(skeleton or asf())
    (tmp_path / "02_01.amc").write_text(amc(list(frames)))
    body = read_asf(tmp_path / "02.asf")
    return body.joints(read_amc(tmp_path / "02_01.amc", body)) / UNIT


def at(found: NDArray[np.float64], bone: str, frame: int = 0) -> list[float]:
    """Where a bone ends."""
    return np.round(found[frame, JOINT_BONES.index(bone)], 6).tolist()


def told(folder: Path) -> str:
    """What ``prepare`` refuses a folder with."""
    with pytest.raises(UserError) as refused:
        prepare(folder)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_at_rest_bones_reach_along_their_directions(tmp_path: Path) -> None:
    assert set(JOINT_BONES) <= set(BONES)
    assert len(JOINT_BONES) == len(NODES) == len(JOINTS)
    found = joints(tmp_path, {})
    assert at(found, "rradius") == [-11.5, 23, 0]
    assert at(found, "head") == [0, 26.5, 0]
    assert at(found, "lhipjoint") == np.round([2 / np.sqrt(2), 17 - 2 / np.sqrt(2), 0], 6).tolist()


def test_rotations_are_applied_x_first_then_y_then_z_about_a_bones_own_axes(tmp_path: Path) -> None:
    arms = [{"lhumerus": turn} for turn in ("90 0 0", "0 90 0", "0 90 90")]
    found = joints(tmp_path, *arms, {"root": "0 0 0 0 0 90"}, {"thorax": "0 0 90"})
    assert at(found, "lhumerus", 0) == [8, 23, 0]
    assert at(found, "lhumerus", 1) == [3, 23, -5]
    assert at(found, "lhumerus", 2) == [3, 23, -5]  # about y to -z, which z does not move
    assert at(found, "head", 3) == [-9.5, 0, 0]
    assert at(found, "rradius", 4) == [-6, 17 - 11.5, 0]  # children turn with their parents
    found = joints(tmp_path, {"lradius": "90"}, {"lfemur": "90 0 0"})
    assert at(found, "lradius", 0) == [11.5, 23, 0]  # along its own x axis
    hip, knee = found[1, JOINTS.index("LHip")], found[1, JOINTS.index("LKnee")]
    turn = np.deg2rad(20)  # x of the axes, turned by 20 degrees about z
    expected = 7 * np.array([np.sin(turn) * np.cos(turn) * -1, -(np.sin(turn) ** 2), -np.cos(turn)])
    assert knee - hip == pytest.approx(expected, abs=1e-9)


def test_orders_units_and_radians_are_read(tmp_path: Path) -> None:
    usual = joints(tmp_path, {"root": "1 2 3 0 30 60"})
    mixed = asf().replace("order TX TY TZ RX RY RZ", "order RZ RY TX TY TZ RX")
    other = joints(tmp_path, {"root": "60 30 1 2 3 0"}, skeleton=mixed)
    path, turned = tmp_path / "02_01.amc", f"{np.pi / 3} {np.pi / 6} 1 2 3 0"
    path.write_text(path.read_text().replace("DEGREES", "RADIANS").replace("60 30 1 2 3 0", turned))
    body = read_asf(tmp_path / "02.asf")
    assert body.joints(read_amc(path, body)) / UNIT == pytest.approx(other, abs=1e-6)
    assert np.linalg.norm(other[0] - other[0, 0], axis=1) == pytest.approx(np.linalg.norm(usual[0] - usual[0, 0], axis=1))
    assert other[0] != pytest.approx(usual[0])  # z first is another turn
    (tmp_path / "02.asf").write_text(asf().replace("length 0.45", "length 0.9"))
    assert read_asf(tmp_path / "02.asf").metres == pytest.approx(INCH / 0.9)


def test_hips_are_put_at_the_origin_and_turned_to_the_front_and_a_knee_bends_backwards(tmp_path: Path) -> None:
    frames = [{"root": f"{frame} 17 5 0 {40 * frame} 0"} for frame in range(9)]
    poses = normalised(z_up(joints(tmp_path, *frames) * UNIT))
    right, left = poses.positions[:, 0], poses.positions[:, 3]
    assert right + left == pytest.approx(0, abs=1e-12)
    assert (right[:, 0] > 0).all()
    assert right[:, 1] == pytest.approx(0, abs=1e-12)
    assert poses.positions == pytest.approx(poses.positions[:1].repeat(9, axis=0))  # only root and yaw differed
    assert poses.positions[0, -1, 2] > 0.5
    turns = np.diff(np.unwrap(poses.root[:, 3]))
    assert turns == pytest.approx(np.deg2rad(40))
    assert np.diff(poses.root[:, 2]) == pytest.approx(0)
    poses = normalised(z_up(joints(tmp_path, {"rfemur": "-60 0 0", "lfemur": "-60 0 0"}) * UNIT))
    assert (poses.positions[0, [1, 4], 1] > 0.1).all()  # thighs lifted to the front, which is +y


def test_a_database_becomes_one_file_and_a_report_and_its_recordings_are_copied(tmp_path: Path) -> None:
    text = prepare(database(tmp_path / "cmu", TURN), tmp_path / "out")
    found = Recordings.load(tmp_path / "out" / FILE)
    assert (found.trial_id, found.label, found.subject) == (("02_01", "02_02"), ("walk", "walk, veer left"), ("02", "02"))
    assert found.kind == ("asf_amc", "asf_amc")
    assert found.positions.shape == (80, 14, 3)  # every fourth of 160 frames, twice
    assert "kept: 2 trials, 80 frames at 30 a second, 2 descriptions" in text
    assert "mocap.cs.cmu.edu" in text
    prepare(database(tmp_path / "slow", {"87_03": "backflip"}))
    assert len(Recordings.load(tmp_path / "slow" / FILE).positions) == 80  # every second, since it was recorded at 60 a second
    report = json.loads((tmp_path / "out" / REPORT).read_text())
    assert report["kept"]["02_02"] == {
        "label": "walk, veer left", "kind": "asf_amc", "file": "02_02.amc", "frames": 40, "glitches": 0, "too short": 0,
    }  # fmt: skip
    (tmp_path / "out" / FILE).rename(tmp_path / "out" / "cmu14_trials.npz")
    assert "kept: 2 trials" in prepare(tmp_path / "out", tmp_path / "again")
    assert Recordings.load(tmp_path / "again" / FILE).label == ("walk", "walk, veer left")


def test_the_command_line_prepares(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = database(tmp_path / "cmu", WALK)
    domain = "ftl_lightning.domains.mocap:DOMAIN"
    succeed("prepare", domain, f"--root={folder}", f"--out={tmp_path / 'out'}")
    assert (tmp_path / "out" / FILE).is_file()
    assert "kept: 1 trial" in capsys.readouterr().out
    refused(capsys, ["prepare", domain], "error: root: expected a folder with your copy of the database, found none")
    refused(capsys, ["prepare", "agent"], "needs nothing of the kind")


def test_what_was_dropped_is_told_with_its_reason(tmp_path: Path) -> None:
    trials = TURN | {"02_03": "juggling", "02_04": "Unknown", "02_05": "walk", "02_06": "walk", "02_07": "walk", "02_08": "walk"}
    folder = database(tmp_path, trials)
    (folder / "02_05.amc").write_text(amc(swing(100)))
    (folder / "02_06.amc").write_text(amc(swing(160)).replace("lradius 0", "lradius zero", 1))
    wild = [{"root": f"0 17 0 0 0 {170 * (frame // 4 % 2)}"} for frame in range(160)]
    (folder / "02_07.amc").write_text(amc(wild))
    (folder / "02_08.amc").rename(folder / "05_08.amc")
    (folder / "cmu-mocap-index.csv").write_text((folder / "cmu-mocap-index.csv").read_text() + '\n05_08,walk,"someone"')
    (folder / "readme.amc").write_text("")
    (folder / "02_01.mb.bvh").write_text("not looked at")
    text = prepare(folder)
    assert "kept: 2 trials" in text
    assert "dropped: 8 files\n     1  " in text
    assert "     1  description that is no training concept: 02_03 (juggling)\n" in text
    assert "     1  no description in the index: 02_04\n" in text
    assert "     1  shorter than 128 frames: 02_05 (100 frames)\n" in text
    assert "02_06.amc: line 15: expected a finite number, found 'zero'" in text
    assert "     1  less than 32 frames without glitches: 02_07 (of 40)\n" in text
    assert "     1  no skeleton of the subject: 05_08 (05.asf)\n" in text
    assert "     1  file not named after a trial, such as 13_29.amc: readme.amc\n" in text
    assert "     1  trial that was read from another file: 02_01.mb.bvh (02_01 from 02_01.amc)\n" in text
    assert f"or left out: {folder / REPORT}" in text
    assert len(json.loads((folder / REPORT).read_text())["dropped"]) == 8


def test_what_pretraining_leaves_out_is_told_with_its_reason(tmp_path: Path) -> None:
    fast = motion(100, 1)
    fast[[30, 60, 80]] += 1.0  # three glitches leave pieces of 30, 29, 19 and 19 frames
    cut = motion(100, 2)
    cut[50:] += 1.0
    cut[75:] += 1.0
    made = {f"02_{number:02}": ("walk", motion(40, number)) for number in (1, 2, 3)}
    made |= {"13_29": ("jumping jacks, side twists, bend over, squats", motion(100, 4))}
    made |= {"05_01": ("juggling", motion(40, 5)), "05_02": ("run", fast), "05_03": ("jump", cut), "05_04": ("run", motion(40, 6))}
    whole = recordings(made)
    replace(whole, kind=(*whole.kind[:-1], "bvh_daz")).save(tmp_path / "cmu14_trials.npz")
    text = prepare(tmp_path, tmp_path / "out")
    assert "kept: 8 trials" in text
    assert "of these, left out as pieces shorter than 32 frames: 50 frames of 1 trial\n" in text
    assert "dropped: 0 files\nkept, but left out of pretraining: 5 trials\n" in text
    assert "     1  another figure than the subject's own (bvh_daz): 05_04 (run)\n" in text
    report = json.loads((tmp_path / "out" / REPORT).read_text())
    assert {trial: one["reason"] for trial, one in report[LEFT_OUT].items()} == {
        "02_03": "held out for validation",
        "05_01": "description that is no training concept",
        "05_02": "no piece of 32 frames without glitches",
        "05_04": "another figure than the subject's own (bvh_daz)",
        "13_29": "held out whole, as it shows a new concept",
    }
    trained = set(Recorded(tmp_path / "out").split("train", 0, 0).provenance["trials"])
    assert trained == report["kept"].keys() - report[LEFT_OUT].keys()
    assert report["kept"]["05_03"]["too short"] == 50


def test_a_glitch_cuts_a_trial_first_frames_on_the_floor_are_left_out_and_an_index_as_text_will_do(tmp_path: Path) -> None:
    folder = database(tmp_path, WALK)
    frames = swing(400)
    for frame in frames[200:]:
        frame["thorax"] = "170 0 0"
    (folder / "02_01.amc").write_text(amc(frames))
    assert "kept, cut where a joint is too fast: 1 trial, 1 frame" in prepare(folder)
    (folder / "02_01.amc").write_text(amc([{"root": "0 0 0 0 0 0"}] * 8 + swing(160)))
    (folder / "cmu-mocap-index.csv").unlink()
    (folder / "cmu-mocap-index-text.txt").write_text("Subject #2\n\n02_01\twalk\n")
    assert "kept: 1 trial" in prepare(folder)
    assert len(Recordings.load(folder / FILE).positions) == 40


def test_a_folder_that_holds_nothing_to_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"root: expected a folder, found nothing at .*mocap\.cs\.cmu\.edu"):
        prepare(tmp_path / "nowhere")
    assert "expected AMC or BVH files, found an empty folder; get the CMU" in told(tmp_path)
    (tmp_path / "holiday.jpg").write_text("")
    assert "expected AMC or BVH files, found none; get the CMU" in told(tmp_path)
    database(tmp_path, WALK)
    (tmp_path / "cmu-mocap-index.csv").write_text("nothing of the kind")
    assert "cmu-mocap-index.csv: expected lines such as '13_29,description', found none" in told(tmp_path)
    (tmp_path / "cmu-mocap-index.csv").unlink()
    assert "expected the index of descriptions, cmu-mocap-index.csv or" in told(tmp_path)


SKELETON, MOTION = "02.asf", "02_01.amc"
SEGMENT = "trial_id,label,start30,stop30\n"
ONCE = "expected a frame's number before its bones, and each bone once"


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        (MOTION, "lradius", "tail", "02_01.amc: line 15: expected a bone of the skeleton, found 'tail'; is it of another subject?"),
        (MOTION, "lfemur 0 0 0", "lfemur 0 0", "02_01.amc: line 6: expected 3 numbers for 'lfemur', found 'lfemur 0 0'"),
        (MOTION, "lfemur 0 0 0", "lfemur 0 x 0", "02_01.amc: line 6: expected 3 finite numbers, found '0 x 0'"),
        (MOTION, "lfemur 0 0 0", "lfemur 0 nan 0", "02_01.amc: line 6: expected 3 finite numbers, found '0 nan 0'"),
        (MOTION, "lfemur 0 0 0\n", "", f"02_01.amc: line 20: {ONCE}"),
        (MOTION, "ltibia 0\n", "ltibia 0\nltibia 0\n", f"02_01.amc: line 8: {ONCE}"),
        (SKELETON, "name head", "name skull", "expected a skeleton of the CMU database, found a skeleton without the bone 'head'"),
        (SKELETON, "length 7.0", "length long", "02.asf: line 20: expected a finite number, found 'long'"),
        (SKELETON, "direction 1 -1 0", "direction 1 -1", "expected 3 finite numbers, found '1 -1'"),
        (SKELETON, "    direction 1 -1 0\n", "", "expected a bone with name, direction, length and axis (no 'direction' here)"),
        (SKELETON, "order TX TY TZ RX RY RZ", "order TX TY", "02.asf: line 6: expected TX TY TZ RX RY RZ in some order"),
        (SKELETON, "    thorax lowerneck", "", "section ':hierarchy': expected the parents of 'lowerneck', up to the root"),
        (SKELETON, "axis 0 0 20 XYZ", "axis 0 0 20 XXZ", "expected an order of axes such as XYZ, found 'XXZ'"),
        (SKELETON, "length 0.45", "length 0", "02.asf: key 'length': expected a positive number, found 0"),
        (MOTION, None, ":FULLY-SPECIFIED\n:DEGREES\n", "02_01.amc: expected frames of motion, found none"),
        pytest.param(MOTION, None, amc(swing(20)), "02_01: shorter than 128 frames: 20 frames", id="short"),
        (SEGMENTS, None, "", "segments.csv: line 1: expected trial_id,label,start30,stop30, found nothing"),
        (SEGMENTS, None, "a,b\n", "segments.csv: line 1: expected trial_id,label,start30,stop30, found a,b"),
        (SEGMENTS, None, f"{SEGMENT}\n02_01,walk,9,3\n", "segments.csv: line 3: expected a trial, a label"),
        (SEGMENTS, None, f"{SEGMENT}02_01,walk,0\n", "segments.csv: line 2: expected a trial, a label"),
    ],
)  # fmt: skip
def test_a_malformed_file_is_told_with_file_and_line(file: str, old: str | None, new: str, expected: str, tmp_path: Path) -> None:
    path = database(tmp_path, WALK) / file
    text = new
    if old is not None:
        assert old in path.read_text()
        text = path.read_text().replace(old, new, 1)
    path.write_text(text)
    assert expected in told(tmp_path)


def test_segments_of_ones_own_come_along_with_the_shipped_ones_that_show_the_new_concepts(tmp_path: Path) -> None:
    folder = database(tmp_path / "cmu", WALK)
    (folder / SEGMENTS).write_text(f"{SEGMENT}02_01,arm circle,3,39\n")
    prepare(folder, tmp_path / "out")
    _, segments = read_folder(tmp_path / "out")
    assert [(one.label, one.start, one.stop) for one in segments if one.trial_id == "02_01"] == [("arm circle", 3, 39)]
    assert "chop wood" in {one.label for one in segments}
    assert sum(one.label == "jumping jacks" and one.trial_id.startswith("13") for one in read_segments(SHIPPED)) == 3
    assert all(one.stop is None or one.stop > one.start for one in read_segments(SHIPPED))
    with pytest.raises(UserError, match="expected a table of segments"):
        read_segments(Path("nowhere.csv"))


def bvh(frames: int, after: str = "0 0 0") -> str:
    """A motion in the MotionBuilder-friendly form: someone who moves 1 unit up a frame."""
    chains = (
        ("LHipJoint 0 0 0", "LeftUpLeg 1.5 -1.5 0", "LeftLeg 0 -7 0", "LeftFoot 0 -7 0"),
        ("RHipJoint 0 0 0", "RightUpLeg -1.5 -1.5 0", "RightLeg 0 -7 0", "RightFoot 0 -7 0"),
    )
    back = ("LowerBack 0 0 0", "Spine 0 2 0", "Spine1 0 2 0")
    upper = (
        (f"Neck {after}", "Neck1 0 1.5 0", "Head 0 1.5 0"),
        (f"LeftShoulder {after}", "LeftArm 3 0 0", "LeftForeArm 5 0 0", "LeftHand 3.5 0 0"),
        (f"RightShoulder {after}", "RightArm -3 0 0", "RightForeArm -5 0 0", "RightHand -3.5 0 0"),
    )

    def opened(joint: str) -> str:
        name, *offset = joint.split()
        return f"JOINT {name}\n{{\nOFFSET {' '.join(offset)}\nCHANNELS 3 Zrotation Yrotation Xrotation\n"

    def chain(joints: tuple[str, ...], inside: str = "End Site\n{\nOFFSET 0 1.5 0\n}\n") -> str:
        return "".join(map(opened, joints)) + inside + "}\n" * len(joints)

    body = "".join(map(chain, chains)) + chain(back, "".join(map(chain, upper)))
    count = body.count("CHANNELS")
    rows = [f"0 {17 + frame} 0 " + " ".join(["0"] * 3 * (count + 1)) for frame in range(frames)]
    root = "ROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation\n"
    motion = f"MOTION\nFrames: {frames}\nFrame Time: .0083333\n" + "\n".join(rows) + "\n"
    return f"HIERARCHY\n{root}{body}}}\n{motion}"


class TestBvh:
    def test_the_thorax_is_put_back_and_the_first_frame_left_out(self, tmp_path: Path) -> None:
        (tmp_path / "02.asf").write_text(asf())
        (tmp_path / "02_01.bvh").write_text(bvh(5))
        found, fps = read_bvh(tmp_path / "02_01.bvh", read_asf(tmp_path / "02.asf"))
        assert (found.shape, fps) == ((4, 14, 3), 120)
        head = found[0, NODES.index("EndSiteHead")] / METRES
        assert head == pytest.approx([0, 18 + 4 + 6 + 4.5, 0])  # the skeleton's thorax is 6 long
        bare, _ = read_bvh(tmp_path / "02_01.bvh", None)
        assert bare[0, NODES.index("EndSiteHead")] / METRES == pytest.approx([0, 18 + 4 + 2 + 4.5, 0])  # as the bone below
        (tmp_path / "02_01.bvh").write_text(bvh(5, after="0 3 0"))
        whole, _ = read_bvh(tmp_path / "02_01.bvh", None)
        assert whole[0, NODES.index("EndSiteHead")] / METRES == pytest.approx([0, 18 + 4 + 3 + 4.5, 0])  # it is there

    def test_a_folder_of_both_takes_amc_files_first(self, tmp_path: Path) -> None:
        folder = database(tmp_path, TURN)
        (folder / "02_01.bvh").write_text(bvh(161))
        (folder / "02_02.amc").unlink()
        (folder / "02_02.bvh").write_text(bvh(161))
        prepare(folder)
        assert Recordings.load(folder / FILE).kind == ("asf_amc", "bvh_mb")
        (folder / "02.asf").unlink()
        prepare(folder)
        assert Recordings.load(folder / FILE).kind == ("bvh_mb_thx", "bvh_mb_thx")

    def test_another_conversion_or_a_damaged_file_is_told(self, tmp_path: Path) -> None:
        folder = database(tmp_path, WALK)
        (folder / "02_01.amc").unlink()
        (folder / "02_01.bvh").write_text(bvh(161).replace("RightUpLeg", "rThigh"))
        assert "02_01.bvh: expected the MotionBuilder-friendly conversion of the database, found a skeleton without" in told(folder)
        (folder / "02_01.bvh").write_text(bvh(161)[:-40])
        assert "02_01.bvh: expected a BVH file, found a damaged one" in told(folder)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda found: found.pop("label"), "key 'label': expected it in a file of recordings, found none"),
        (lambda found: found.update(root=found["root"][1:]), r"key 'root': expected shape \(80, 4\), found \(79, 4\)"),
        (lambda found: found.update(offsets=found["offsets"] + 1), "key 'offsets': expected ends of one trial or more"),
        (lambda found: found.update(positions=found["positions"] * np.nan), "key 'positions': expected finite numbers"),
    ],
)
def test_a_damaged_file_of_recordings_is_told(change: object, expected: str, tmp_path: Path) -> None:
    prepare(database(tmp_path, TURN))
    with np.load(tmp_path / FILE) as archive:
        found = dict(archive)
    change(found)  # type: ignore[operator]
    np.savez(tmp_path / FILE, **found)
    with pytest.raises(UserError, match=expected):
        Recordings.load(tmp_path / FILE)
    (tmp_path / FILE).write_bytes(b"no archive")
    with pytest.raises(UserError, match="expected recordings, found a damaged or foreign file"):
        Recordings.load(tmp_path / FILE)


def test_recorded_motion_is_read_as_it_was_before(tmp_path: Path) -> None:
    """Where recordings are named: their raw samples give the same poses as the file that was made elsewhere."""
    named = named_recordings("raw_samples")
    expected = read_folder(named)[0]
    for amc_too in (True, False):
        folder = tmp_path / str(amc_too)
        shutil.copytree(named / "raw_samples", folder)
        folder.chmod(0o755)
        if not amc_too:
            for path in folder.glob("*.amc"):
                path.unlink()
            (folder / "09_06.daz.bvh").unlink()
        prepare(folder)
        found = Recordings.load(folder / FILE)
        assert len(found) == (6 if amc_too else 2)
        for number, trial in enumerate(found.trial_id):
            same = expected.trial_id.index(trial)
            assert found.label[number] == expected.label[same]
            assert np.abs(found.trial(number) - expected.trial(same)).max() < 1e-5
            start, stop = expected.offsets[same : same + 2]
            roots = found.root[found.offsets[number] : found.offsets[number + 1]]
            assert np.abs(roots - expected.root[start:stop]).max() < 1e-5
