"""Motion capture as a domain: body, concepts, demonstrations from a folder, and where behaviour starts."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import DOMAIN, skeleton
from ftl_lightning.domains.mocap.domain import VIEWS, with_rigid_bones
from ftl_lightning.domains.mocap.measures import SETTLED, bone_error
from ftl_lightning.domains.mocap.skeleton import HORIZON, POSE, R_WRIST, as_joints, bone_lengths, mirrored
from ftl_lightning.domains.mocap.source import FILE, LONGEST, Recorded, Recordings, at_rest, glitches, hang_down, pieces
from ftl_lightning.domains.mocap.tasks import HELD_OUT, NEW_CONCEPTS, SEGMENTS, SUITES, TRAINING_CONCEPTS, cleaned, mirrored_text
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import InversionData, PretrainingData, shares
from tests.domains.mocap_samples import folder, motion, named_recordings, recordings

NAME = "ftl_lightning.domains.mocap:DOMAIN"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of recordings that no test changes."""
    return folder(tmp_path_factory.mktemp("recordings"))


def test_every_column_belongs_to_one_part_of_the_body_and_compositions_are_told_with_the_whole_and_by_its_parts() -> None:
    assert sorted(column for group in skeleton.GROUPS.values() for column in group) == list(range(len(skeleton.COLUMNS)))
    arms = {skeleton.COLUMNS[column].split(".")[0] for column in skeleton.GROUPS["arms"]}
    assert arms == {"RElbow", "RWrist", "LElbow", "LWrist"}
    tasks = SUITES["composition"].tasks
    parts = {task.setting: dict(task.on) for task in tasks if task.goal == "jumping jacks + walk"}
    assert parts == {
        "new + training": {},
        "new + training, by parts of the body": {"jumping jacks": ("arms", "trunk"), "walk": ("legs",)},
    }
    every = [column for groups in parts["new + training, by parts of the body"].values() for column in DOMAIN.plans.grouped(groups)]
    assert sorted(every) == list(range(42))
    with pytest.raises(UserError, match="expected one of arms, legs, trunk after '@', found 'leg'"):
        DOMAIN.plans.grouped(("leg",))


def test_generated_bones_are_as_long_as_at_the_start_and_recorded_ones_stay_as_they_are() -> None:
    poses = torch.from_numpy(motion(HORIZON, 1)).flatten(1)[None].repeat(3, 1, 1)
    start = {POSE: poses[:, 0]}
    recorded = with_rigid_bones(poses, start)
    assert torch.allclose(recorded[:, 0], poses[:, 0], atol=1e-5)
    assert torch.allclose(with_rigid_bones(recorded, start), recorded, atol=1e-5)
    generated = recorded + 0.03 * torch.randn(recorded.shape, generator=torch.Generator().manual_seed(0))
    rigid = with_rigid_bones(generated, start)
    assert (rigid - generated).abs().max() < 0.3
    assert bone_error("walk", generated, InitialStates(start)).min() > 0.02
    assert bone_error("walk", rigid, InitialStates(start)).max() < 1e-5
    for joint in (skeleton.R_SHOULDER, skeleton.NECK):  # no rigid bone leads there
        assert torch.equal(as_joints(rigid)[..., joint, :], as_joints(generated)[..., joint, :])


def test_the_initial_pose_fades_out_of_states_within_a_third_of_a_second() -> None:
    view, states = VIEWS["faded"], torch.from_numpy(motion(HORIZON, 2)).flatten(1)[None]
    start = {POSE: states[:, 0]}
    encoded = view.encode(states, start)
    assert torch.allclose(encoded[:, 0], skeleton.mean_pose()[None], atol=1e-6)
    assert torch.equal(encoded[:, SETTLED:], states[:, SETTLED:])
    elsewhere = {POSE: states[:, 0] + 0.02}
    assert (view.encode(states, elsewhere)[:, 1:SETTLED] != encoded[:, 1:SETTLED]).any()
    assert torch.allclose(view.decode(encoded, start), VIEWS["smooth"].decode(states, start), atol=1e-6)


def test_the_mirror_image_exchanges_left_and_right() -> None:
    states = torch.from_numpy(motion(5, 1)).flatten(1)
    states[:, 3 * R_WRIST] += 0.3
    other = mirrored(states)
    assert torch.equal(mirrored(other), states)
    assert [skeleton.JOINTS[joint] for joint in skeleton.MIRROR][:2] == ["LHip", "LKnee"]
    assert torch.equal(as_joints(other)[:, skeleton.LEFT, 0], -as_joints(states)[:, skeleton.RIGHT, 0])
    assert torch.equal(as_joints(other)[:, skeleton.LEFT, 1:], as_joints(states)[:, skeleton.RIGHT, 1:])
    lengths = bone_lengths(states)
    assert lengths.shape == (5, len(skeleton.BONES))
    assert lengths.sort(dim=1).values == pytest.approx(bone_lengths(other).sort(dim=1).values)


def test_texts_are_cleaned_and_mirrored_and_goals_may_join_several_concepts_some_of_them_new() -> None:
    assert cleaned("charleston_side_by_side_female ") == "charleston side by side female"
    assert cleaned("ZombieWalk") == "zombie walk"
    assert mirrored_text("walk, 90-degree left turn") == "walk, 90-degree right turn"
    assert mirrored_text("dribble, 90-degree right turns") == "dribble, 90-degree left turns"
    assert mirrored_text("climb, left, right, upright") == "climb, right, left, upright"
    assert all(cleaned(text) == text for text in TRAINING_CONCEPTS)
    assert len(set(TRAINING_CONCEPTS)) == len(TRAINING_CONCEPTS)
    assert not set(NEW_CONCEPTS) & set(TRAINING_CONCEPTS)
    assert not [text for text in TRAINING_CONCEPTS if "jumping jack" in text]
    reads = DOMAIN.concepts.reads
    assert reads("jumping jacks + walk")
    assert reads("walk")
    assert not reads("walk + ")
    assert not reads("fly")
    assert not reads("wash self")  # which the judge does not know
    assert SUITES["paper"].learned == ("jumping jacks", "arm circle")
    assert {"training", "paper", "validation"} <= set(DOMAIN.concepts.suites)
    assert all(
        reads(goal) for name in ("training", "paper", "composition", "validation") for goal in DOMAIN.concepts.suites[name].goals
    )
    data = PretrainingData(domain=NAME, root="/nowhere")  # nothing is read before it is needed
    assert data.encoder(DOMAIN.concepts.descriptions).shape == (len(DOMAIN.concepts.descriptions), 384)


def test_a_frozen_frame_is_still_has_its_bones_and_is_no_action() -> None:
    starts = DOMAIN.source(None).starts("walk", 4, 0)
    plans = DOMAIN.comparison.references["frozen frame"]("walk", 4, starts, 0)
    found = DOMAIN.measure("walk", plans, starts)
    assert set(found) == set(DOMAIN.metrics)
    assert not found["accuracy"].any()
    assert found["jerk"].max() < 1
    assert found["bone error"].max() < 1e-4


def test_trials_are_cut_at_glitches_and_into_parts_that_lose_no_window() -> None:
    states = motion(400, 1)
    states[150:] += 0.5
    flat = states.reshape(400, -1)
    assert glitches(flat) == [150]
    found = pieces(flat)
    assert [len(piece) for piece in found] == [128, 53, 128, 128, 56]
    assert sum(len(piece) - HORIZON + 1 for piece in found) == (150 - HORIZON + 1) + (250 - HORIZON + 1)
    assert [len(piece) for piece in pieces(flat, longest=None)] == [150, 250]
    assert not pieces(flat[:31])
    assert max(len(piece) for piece in found) == LONGEST


def test_training_has_every_piece_and_its_mirror_image_and_validation_is_of_other_trials(shared: Path, tmp_path: Path) -> None:
    source = Recorded(shared)
    found = source.split("train", 1, 0)
    assert found.concepts.count("walk") == 8  # one of five trials is held out
    assert found.concepts.count("walk, veer left") == found.concepts.count("walk, veer right") == 2
    right = "basketball - forward dribble, 90-degree right turns, crossover dribble"
    assert found.concepts.count(right) == 1  # the mirror image of its text is no training concept
    assert set(found.concepts) <= set(TRAINING_CONCEPTS)
    half = [row for row, text in enumerate(found.concepts) if text == "walk"]
    assert torch.equal(mirrored(found.states[half[0], :70]), found.states[half[4], :70])
    assert torch.equal(found.observed[POSE], found.states)
    assert found.lengths.min() >= HORIZON
    validation = source.split("validation", 1, 0).provenance["trials"]
    assert validation == ["02_05"]
    assert not {*validation, *HELD_OUT} & set(found.provenance["trials"])
    assert not set(HELD_OUT) & set(validation)
    recordings({"02_01": ("walk", motion(60, 1))}, kind="bvh_daz").save(tmp_path / FILE)
    with pytest.raises(UserError, match="expected trials of the training concepts for train, found none"):
        Recorded(tmp_path).split("train", 1, 0)


def test_new_concepts_are_demonstrated_by_windows_of_a_folder_that_start_at_rest(shared: Path) -> None:
    source = Recorded(shared)
    shown = [piece.states for piece in source._shown("jumping jacks")]
    assert sorted(map(len, shown)) == [54, 117]
    rest = [states[start : start + HORIZON] for states in shown for start in at_rest(states)]
    assert len(rest) >= 3
    more = source.draw("jumping jacks", len(rest) + 3, 0)
    assert more.concepts == ("jumping jacks",) * (len(rest) + 3)
    assert set(more.lengths.tolist()) == {HORIZON}
    assert all(any(torch.equal(window, own) for own in more.states[: len(rest)]) for window in rest)
    every = torch.cat([states.unfold(0, HORIZON, 1).transpose(1, 2) for states in shown])
    assert all((every == window).all(dim=(1, 2)).any() for window in more.states)
    assert torch.equal(source.draw("jumping jacks", len(rest) + 3, 0).states, more.states)
    assert not torch.equal(source.draw("jumping jacks", len(rest) + 3, 1).states, more.states)
    assert set(source.draw("walk", 9, 3).concepts) == {"walk"}
    data = InversionData(NAME, root=str(shared), demonstrations_per_concept=3, suite="validation")
    assert data.concepts == ("knee raise", "squat")
    assert len(data.demonstrations) == 6
    with pytest.raises(UserError, match="found 'chop wood'"):
        InversionData(NAME, root=str(shared), suite="database")


def test_segments_of_ones_own_take_the_place_of_the_shipped_ones_and_whole_trials_show_what_they_say(tmp_path: Path) -> None:
    root = folder(tmp_path / "recordings")
    (root / SEGMENTS).write_text("trial_id,label,start30,stop30\n13_29,knee raise,10,70\n")
    source = Recorded(root)
    assert [len(piece.states) for piece in source._shown("knee raise")] == [60]
    with pytest.raises(UserError, match=r"task: expected a concept that trials in .* show, found 'jumping jacks'"):
        source.draw("jumping jacks", 1, 0)
    trials = {"79_01": ("chop wood", motion(90, 1)), "80_71": ("chop wood", motion(100, 2))}
    recordings(trials).save(tmp_path / FILE)
    assert [len(piece.states) for piece in Recorded(tmp_path)._shown("chop wood")] == [90, 100]


def test_a_window_starts_where_a_motion_that_goes_to_and_fro_is_nearest_to_standing() -> None:
    states = torch.from_numpy(motion(1, 0)).reshape(1, 42).repeat(120, 1)
    lift = 0.5 - 0.5 * torch.cos(torch.arange(120) * 2 * torch.pi / 30)
    states[:, [3 * skeleton.WRISTS[0] + 2, 3 * skeleton.WRISTS[1] + 2]] += lift[:, None]
    assert at_rest(states) == [0, 30, 60]


def test_behaviour_starts_with_arms_down_in_trials_of_no_training_split_or_in_people_of_different_sizes(shared: Path) -> None:
    source = Recorded(shared)
    found = source.starts("jumping jacks", 20, 0)
    poses = found.observed[POSE]
    assert poses.shape == (20, 42)
    assert hang_down(poses).all()
    assert torch.equal(source.starts("jumping jacks", 20, 0).observed[POSE], poses)
    assert not torch.equal(source.starts("jumping jacks", 20, 1).observed[POSE], poses)
    own = torch.cat([piece.states[: len(piece.states) - HORIZON + 1] for piece in source._pieces if piece.concept == "walk"])
    walking = source.starts("walk", 20, 0).observed[POSE]
    assert all((pose == own).all(dim=1).any() for pose in walking)
    assert hang_down(source.starts("backflip", 20, 0).observed[POSE]).all()  # no trial shows it
    train = source.split("train", 1, 0).states.flatten(0, 1)
    assert torch.cdist(poses, train).min() > 0
    poses = Recorded(None).starts("walk", 5, 0).observed[POSE]
    assert hang_down(poses).all()
    assert len(poses.unique(dim=0)) == 5
    arms_up = poses.clone()
    arms_up[:, 3 * R_WRIST + 2] = 0.9
    assert not hang_down(arms_up).any()


@pytest.mark.parametrize("made", [None, "nowhere", "empty", "other", "file"])
def test_a_missing_root_is_told_in_one_line(made: str | None) -> None:
    if made in ("empty", "other"):
        Path(made).mkdir()
    if made in ("other", "file"):
        Path("file" if made == "file" else "other/holiday.jpg").write_text("")
    with pytest.raises(UserError, match=r"mocap\.cs\.cmu\.edu.*python -m ftl_lightning prepare mocap --root") as told:
        PretrainingData(domain=NAME, root=made).setup("fit")
    assert "\n" not in str(told.value)
    with pytest.raises(UserError, match="prepare mocap"):
        InversionData(NAME, root=made)


def test_batches_are_windows_that_start_in_the_observed_pose(shared: Path) -> None:
    data = PretrainingData(domain=NAME, root=str(shared), batch_size=64)
    data.setup("fit")
    batch = data.batch(3)
    assert batch.states.shape == (64, HORIZON, 42)
    assert torch.equal(batch.states[:, 0], batch.observed[POSE])
    assert not (batch.states[:, -1] == batch.states[:, -2]).all(dim=1).any()  # none reaches past an end
    every = data.every_window()
    assert len(every.states) == int((data.training.lengths - HORIZON + 1).sum())
    resting = PretrainingData(domain=NAME, root=str(shared), batch_size=64)
    resting.domain = replace(DOMAIN, plans=replace(DOMAIN.plans, at_rest=True))
    resting.setup("fit")
    still = resting.batch(3).states  # of a domain that comes to rest, windows reach past the end
    assert (still[:, -1] == still[:, -2]).all(dim=1).any()


def test_concepts_are_drawn_by_a_power_of_their_size_where_a_balance_is_given(shared: Path) -> None:
    lengths = torch.tensor([10, 30, 60])
    found = Demonstrations(torch.zeros(3, 60, 1), lengths, "", ("x",), ("",), ("few", "many", "few"))
    assert shares(found, 1) == pytest.approx([0.1, 0.3, 0.6])
    assert shares(found, 0) == pytest.approx([0.5 / 7, 0.5, 3 / 7])
    few, many = 70**0.5, 30**0.5
    assert shares(found, 0.5)[1].item() == pytest.approx(many / (few + many))
    plain = PretrainingData(domain=NAME, root=str(shared), batch_size=512)
    even = PretrainingData(domain=NAME, root=str(shared), batch_size=512, balance=0)
    for data in (plain, even):
        data.setup("fit")
    counts = even.batch(0).concepts.bincount()
    assert counts[counts > 0].min() > 512 / 4 * 0.7  # four concepts alike
    assert not torch.equal(plain.batch(0).concepts, even.batch(0).concepts)
    assert torch.equal(even.batch(5).states, even.batch(5).states)
    with pytest.raises(UserError, match=re.escape("data.balance: expected a number from 0 to 1, found 2")):
        PretrainingData(domain=NAME, balance=2)


def test_recordings_give_every_training_concept() -> None:
    """Where recordings are named: all concepts, new ones too, and people to start from."""
    named = named_recordings()
    source = Recorded(named)
    train = source.split("train", 1, 0)
    assert set(train.concepts) == set(TRAINING_CONCEPTS)
    assert not set(train.provenance["trials"]) & set(HELD_OUT)
    assert source.draw("jumping jacks", 5, 0).lengths.min() >= HORIZON
    assert source.draw("arm circle", 2, 0).lengths.tolist() != []
    assert len(source.arms_down) > 10
    poses = source.starts("jumping jacks", 100, 0).observed[POSE]
    assert len(poses.unique(dim=0)) > 80
    lengths = bone_lengths(poses)[:, :2]
    assert ((lengths > 0.3) & (lengths < 0.55)).all()
    other = Recordings.load(next(path for path in named.glob("*.npz") if "segment" not in path.name))
    assert len(other) == len(source.recordings)
