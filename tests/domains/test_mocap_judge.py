from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.domains.mocap import judge as judging
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.features import JOINTS, LOWER, UPPER, bones, extremes, places, signals, summary, turns
from ftl_lightning.domains.mocap.judge import ARMS, LEGS, PARTS, PATH, WHOLE, Judge, identity, shipped_judge
from ftl_lightning.domains.mocap.skeleton import (
    HORIZON,
    L_ANKLE,
    L_ELBOW,
    L_WRIST,
    R_ANKLE,
    R_ELBOW,
    R_WRIST,
    as_joints,
    mirrored,
    standing_poses,
)
from ftl_lightning.domains.mocap.source import FILE
from ftl_lightning.domains.mocap.tasks import ACTION_OF, AND, CLASSES, OTHER, TESTED, TRAINING_CONCEPTS, action, actions, judged
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import shipped
from ftl_lightning.services.tensor_file import save_tensors
from tests.domains.mocap_samples import named_recordings, recordings, script

ALL = (*LOWER, *UPPER)


@pytest.fixture(scope="module")
def untrained() -> Judge:
    torch.manual_seed(0)
    return Judge().requires_grad_(False)


@pytest.fixture(scope="module")
def training() -> ModuleType:
    """The script that trains the judge."""
    return script("mocap_judge")


def moving(count: int, seed: int = 0) -> Tensor:
    """Windows of people whose joints wander."""
    draw = torch.Generator().manual_seed(seed)
    wander = 0.02 * torch.randn(count, HORIZON, 3 * JOINTS, generator=draw).cumsum(dim=1)
    return standing_poses(count, draw)[:, None] + wander


def jumping_jacks(count: int) -> Tensor:
    """Made-up jumping jacks: arms swing up sideways while the feet go apart, once a second."""
    time = torch.arange(HORIZON) / skeleton.FPS
    joints = as_joints(standing_poses(count, torch.Generator().manual_seed(0))[:, None].repeat(1, HORIZON, 1)).clone()
    share = (1 - torch.cos(2 * torch.pi * time + torch.linspace(0, 1, count)[:, None])) / 2
    angle = 0.15 + 2.7 * share
    for shoulder, elbow, wrist, side in ((6, R_ELBOW, R_WRIST, 1.0), (9, L_ELBOW, L_WRIST, -1.0)):
        way = torch.stack([side * torch.sin(angle), torch.zeros_like(angle), -torch.cos(angle)], dim=-1)
        joints[:, :, elbow] = joints[:, :, shoulder] + 0.3 * way
        joints[:, :, wrist] = joints[:, :, shoulder] + 0.52 * way
    for hip, ankle, side in ((0, R_ANKLE, 1.0), (3, L_ANKLE, -1.0)):
        lean = 0.05 + 0.35 * share
        way = torch.stack([side * torch.sin(lean), torch.zeros_like(lean), -torch.cos(lean)], dim=-1)
        joints[:, :, ankle - 1] = joints[:, :, hip] + 0.42 * way
        joints[:, :, ankle] = joints[:, :, hip] + 0.83 * way
    return joints.flatten(2)


def test_texts_name_one_action_each_and_two_joined_are_of_arms_and_of_legs() -> None:
    assert len(TESTED) >= 12
    assert action("Walk, veer left") == action("brisk walk") == "walk"
    assert action("ZombieWalk") == "walk"
    assert action("jumping jacks") == "jumping jacks"
    assert action("run, leap") is None, "two actions, one after the other"
    assert sum(judged(text) for text in TRAINING_CONCEPTS) > 60
    assert all(action(name) == name for name in CLASSES if name != OTHER)
    assert {name for name in ACTION_OF.values() if name} <= set(CLASSES)
    assert not judged(OTHER)
    assert actions(f"jumping jacks{AND}walk/stride") == ("jumping jacks", "walk")
    assert actions("jumping jacks") == ("jumping jacks",)
    assert actions(f"jumping jacks{AND}cook") == ()
    assert actions(AND.join(("walk", "run", "jump"))) == ()


def test_bones_give_the_same_places_and_larger_bodies_and_mirror_images_look_the_same() -> None:
    states = moving(4)
    joints = as_joints(states)
    assert torch.allclose(places(bones(joints)), joints, atol=1e-6)
    for seen in (signals, summary, extremes, turns):
        assert torch.allclose(seen(states, ALL), seen(1.3 * states, ALL), atol=1e-3), seen.__name__
    for seen in (summary, extremes, turns):
        for part, _ in PARTS.values():
            assert torch.allclose(seen(states, part), seen(mirrored(states), part), atol=1e-4), seen.__name__


def test_a_frozen_frame_and_trembling_look_different() -> None:
    states = moving(2)
    frozen = states[:, :1].repeat(1, HORIZON, 1)
    trembling = states + 0.02 * torch.randn(states.shape, generator=torch.Generator().manual_seed(1))
    for seen in (signals, summary, extremes):
        for other in (frozen, trembling):
            assert (seen(states, ALL) - seen(other, ALL)).abs().max() > 0.3, seen.__name__


def test_a_way_on_a_line_encloses_nothing_and_a_circle_does() -> None:
    angle = torch.linspace(0, 2 * torch.pi, HORIZON)
    joints = as_joints(standing_poses(2, torch.Generator().manual_seed(0))[:, None].repeat(1, HORIZON, 1)).clone()
    joints[:, :, [R_WRIST, L_WRIST], 2] += 0.2 * torch.sin(angle)[:, None]
    joints[1, :, [R_WRIST, L_WRIST], 1] += 0.2 * torch.cos(angle)[:, None]
    line, circle = turns(joints.flatten(2), ALL)[:, : 4 * 7].unflatten(1, (4, 7))[:, -1]  # wrists, the mean of both sides
    second_extent, area = 3, 5
    assert line[second_extent] < 0.02 < 0.5 < circle[second_extent] <= 1
    assert line[area] < 0.05 < 2 < circle[area]


def test_arms_are_judged_without_the_legs_and_legs_without_the_arms(untrained: Judge) -> None:
    states = moving(3)
    elsewhere = as_joints(moving(3, seed=5))
    other_legs, other_arms = as_joints(states).clone(), as_joints(states).clone()
    other_legs[:, :, list(LOWER)] = elsewhere[:, :, list(LOWER)]
    other_arms[:, :, list(UPPER)] = elsewhere[:, :, list(UPPER)]
    arms, legs, whole = (untrained.part(name) for name in (ARMS, LEGS, WHOLE))
    assert torch.allclose(arms(states), arms(other_legs.flatten(2)), atol=1e-5)
    assert torch.allclose(legs(states), legs(other_arms.flatten(2)), atol=1e-5)
    assert not torch.allclose(whole(states), whole(other_legs.flatten(2)), atol=1e-3)


def test_every_window_is_judged_by_itself_and_the_same_by_a_judge_that_is_read_again(untrained: Judge, tmp_path: Path) -> None:
    states = moving(5)
    together = untrained.part(WHOLE)(states)
    apart = torch.cat([untrained.part(WHOLE)(window[None]) for window in states])
    assert torch.allclose(together, apart, atol=1e-4)
    assert untrained(states).shape == (5, untrained.num_features)
    assert not untrained.train().training, "metrics that hold the judge do not switch it"
    path = tmp_path / "judge.safetensors"
    untrained.save(path, {"seed": 0})
    again = Judge.load(path)
    assert torch.equal(again.part(WHOLE)(states), together)
    again.save(tmp_path / "second.safetensors", {"seed": 0})
    assert (tmp_path / "second.safetensors").read_bytes() == path.read_bytes()


def test_who_does_not_move_or_is_not_finite_shows_nothing_and_a_goal_without_a_class_is_refused(untrained: Judge) -> None:
    frozen = moving(6)[:, :1].repeat(1, HORIZON, 1)
    trembling = frozen + 0.002 * torch.randn(frozen.shape, generator=torch.Generator().manual_seed(1))
    for part in (untrained.part(name) for name in PARTS):
        for states in (frozen, trembling):
            said = {part.classes[index] for index in part(states).argmax(dim=-1).tolist()}
            assert said <= set(judging.RESTING)
    states = moving(2)
    states[1, 3, 5] = torch.nan
    said = torch.stack([untrained.recognised(name, states) for name in CLASSES if name != OTHER]).any(dim=0)
    assert not said[1]
    with pytest.raises(UserError, match="expected an action that the judge of motion knows, such as 'walk', found 'cook'"):
        untrained.recognised("cook", moving(1))


def test_what_verifiers_do_not_confirm_is_not_said(untrained: Judge, monkeypatch: pytest.MonkeyPatch) -> None:
    states, whole = moving(6), untrained.part(WHOLE)
    logits = torch.full((6, len(CLASSES)), 5.0)
    logits[::2, CLASSES.index("walk")] = -5.0
    logits[:, [CLASSES.index("climb"), CLASSES.index(OTHER)]] = -5.0  # no verifier is asked about these
    monkeypatch.setattr(type(whole), "verified", lambda self, states: logits)
    scores = whole(states)
    assert scores[::2, CLASSES.index("walk")].isneginf().all()
    assert scores[1::2].isfinite().all()
    assert scores.isneginf().sum() == 3
    assert not len(untrained.part(ARMS).verifiers) + len(untrained.part(LEGS).verifiers), "arms alone are no whole action"
    assert set(judging.VERIFIED) <= set(TESTED) - set(judging.RESTING)


def test_a_missing_damaged_or_foreign_judge_is_refused_in_one_line(untrained: Judge, tmp_path: Path) -> None:
    path = tmp_path / "judge.safetensors"
    with pytest.raises(UserError, match=r"judge\.safetensors: expected the judge of motion, found nothing; take it from"):
        Judge.load(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match="expected a motion judge file, found a damaged or foreign file"):
        Judge.load(path)
    for classes, members, expected in (
        (["walk"], 2, "key 'classes': expected those of this version"),
        (CLASSES, 2, "expected weights of this version's judge"),
        (CLASSES, "two", "key 'members': expected a number of networks, found 'two'"),
    ):
        save_tensors(path, judging.KIND, {}, {"classes": classes, "members": members})
        with pytest.raises(UserError, match=expected):
            Judge.load(path)


@pytest.mark.parametrize(
    ("size", "steps", "accuracy"), [(40, (1, 1), None), pytest.param(200, (30, 60), 0.9, marks=pytest.mark.slow)]
)
def test_training_tells_made_up_actions_apart_and_repeats_itself(
    size: int, steps: tuple[int, int], accuracy: float | None, training: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    jacks, wander = jumping_jacks(8).reshape(-1, 14, 3).numpy(), moving(8).reshape(-1, 14, 3).numpy()
    trials = {f"{number:02}_01": ("walk", wander) for number in (2, 13)}
    trials |= {f"{number:02}_02": ("jumping jacks", jacks) for number in (2, 13)}
    recordings(trials).save(tmp_path / FILE)
    monkeypatch.setattr(training, "POOL", size)
    monkeypatch.setattr(training, "SPOILED", 30)
    monkeypatch.setattr(training, "HARD", size)
    windows = training.read(tmp_path, 8)
    assert {str(name) for name in windows.subject} == {"02", "13"}
    first, second = (training.train(windows.of(("13",), others=True), 0, (WHOLE,), *steps).part(WHOLE) for _ in range(2))
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())
    if accuracy is not None:
        test = windows.of(("13",))
        assert (first(test.states()).argmax(dim=-1) == test.label).float().mean() > accuracy


def test_windows_at_another_pace_stay_within_their_action(training: ModuleType) -> None:
    frames = torch.arange(200.0)[:, None].repeat(1, 42)
    ones = torch.ones(3, dtype=torch.long)
    windows = training.Windows(frames, 60 + 10 * torch.arange(3), 50 * ones, 110 * ones, 0 * ones, np.array(["02"] * 3))
    assert windows.states()[0, :, 0].tolist() == list(range(60, 92))
    fast = windows.states(torch.tensor([1.5, 1.5, 0.5]))[..., 0]
    assert fast.min() >= 50
    assert fast.max() <= 109
    assert torch.allclose(fast.diff(dim=1), torch.tensor([1.5, 1.5, 0.5])[:, None].expand(3, 31), atol=1e-4)


def test_hard_negatives_are_nearly_the_action(training: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    walk, jacks = CLASSES.index("walk"), CLASSES.index("jumping jacks")
    states = torch.cat([jumping_jacks(8), moving(8)])
    label = torch.tensor([jacks] * 8 + [walk] * 8)
    relative = bones(as_joints(states))

    def made(kind: int) -> Tensor:
        only = torch.zeros(len(CLASSES), 6)
        only[:, kind] = 1
        monkeypatch.setattr(training, "_HARD", only)
        found = training.hard_negatives(relative, label, torch.Generator().manual_seed(0))
        assert found.shape == relative.shape
        assert found.isfinite().all()
        assert torch.equal(found, training.hard_negatives(relative, label, torch.Generator().manual_seed(0)))
        return found[:8]

    def same(found: Tensor, joints: tuple[int, ...]) -> bool:
        return torch.equal(found[:, :, list(joints)], relative[:8, :, list(joints)])

    legs, arms = made(training.LEGS_OF_OTHERS), made(training.ARMS_OF_OTHERS)
    assert same(legs, UPPER)
    assert not same(legs, LOWER)
    assert same(arms, LOWER)
    assert not same(arms, UPPER)
    extent = (relative[:8].amax(dim=1) - relative[:8].amin(dim=1))[:, [R_WRIST, R_ANKLE]].amax(dim=-1)
    small = made(training.SMALLER)
    assert ((small.amax(dim=1) - small.amin(dim=1))[:, [R_WRIST, R_ANKLE]].amax(dim=-1) < 0.7 * extent).all()  # bones stay as long
    moves = made(training.ONE_SIDE).std(dim=1).amax(dim=-1) > 1e-4
    assert (moves[:, R_WRIST] != moves[:, L_WRIST]).logical_or(moves[:, R_ANKLE] != moves[:, L_ANKLE]).all()
    for kind in (training.STRAIGHT_WAY, training.MORPH):
        assert not same(made(kind), ALL)


def test_the_shipped_judge_is_small_and_knows_made_up_jumping_jacks_from_what_nearly_are(training: ModuleType) -> None:
    assert shipped(PATH).stat().st_size < 1_300_000
    assert len(identity()) == 16
    states = jumping_jacks(8)
    judge = shipped_judge()
    assert judge.recognised("jumping jacks", states).float().mean() > 0.7
    assert not judge.recognised("walk", states).any()
    frozen = states[:, 10:11].repeat(1, HORIZON, 1)
    assert not judge.recognised("jumping jacks", frozen).any()
    assert not judge.recognised("jumping jacks", moving(8)).any()
    stands = standing_poses(8, torch.Generator().manual_seed(1))[:, None].repeat(1, HORIZON, 1)
    walks = as_joints(stands).clone()
    swing = 0.3 * torch.sin(torch.arange(HORIZON) / skeleton.FPS * 2 * torch.pi)
    for ankle, side in ((R_ANKLE, 1), (L_ANKLE, -1)):
        walks[:, :, ankle, 1] += side * swing
        walks[:, :, ankle - 1, 1] += side * swing / 2
    for kind, relative in training.nearly("jumping jacks", states, walks.flatten(2), stands).items():
        assert judge.recognised("jumping jacks", places(relative).flatten(2)).float().mean() <= 0.15, kind


def test_the_shipped_judge_knows_people_it_has_not_seen(training: ModuleType) -> None:
    """Where recordings are named: jumping jacks of the demonstrator, and neither a frozen frame nor the mean pose nor walking."""
    named = named_recordings()
    windows = training.read(named, 4).of(training.UNSEEN)
    states, label = windows.states(), windows.label
    judge = shipped_judge()
    shown = states[label == CLASSES.index("jumping jacks")]
    assert judge.recognised("jumping jacks", shown).float().mean() > 0.9
    frames = shown[:, torch.from_numpy(np.arange(0, HORIZON, 8))].flatten(0, 1)
    assert judge.recognised("jumping jacks", frames[:, None].repeat(1, HORIZON, 1)).float().mean() < 0.02
    assert not judge.recognised("jumping jacks", states.mean(dim=(0, 1), keepdim=True).repeat(1, HORIZON, 1)).any()
    walks = training.read(named, 8)
    walks = walks[torch.from_numpy(np.flatnonzero(walks.label == CLASSES.index("walk")))]
    assert judge.recognised("jumping jacks", walks.states()).float().mean() < 0.01
