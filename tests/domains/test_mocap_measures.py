import math
from functools import partial

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import measures
from ftl_lightning.domains.mocap.domain import BLENDED, DOMAIN, VIEWS, begun_elsewhere, smoothed, with_rigid_bones
from ftl_lightning.domains.mocap.judge import Judge
from ftl_lightning.domains.mocap.measures import CONDITIONS, THRESHOLDS, bone_error, jerk, rise, satisfied
from ftl_lightning.domains.mocap.skeleton import (
    FPS,
    HORIZON,
    L_ANKLE,
    L_KNEE,
    L_WRIST,
    POSE,
    R_ANKLE,
    R_KNEE,
    R_WRIST,
    as_joints,
    drawn_poses,
    standing_poses,
    walking_poses,
)
from ftl_lightning.domains.mocap.tasks import SUITES
from ftl_lightning.services.errors import UserError
from tests.domains.mocap_samples import script

TIME = torch.linspace(0, 1, HORIZON)
PHASE = (1 - torch.cos(2 * math.pi * TIME)) / 2
"""From 0 to 1 and back within a window."""


def person() -> Tensor:
    """A window ``(1, 32, 42)`` of somebody who stands still."""
    return standing_poses(1, torch.Generator().manual_seed(0))[:, None].repeat(1, HORIZON, 1)


def jack(hands: float = 1.0, feet: float = 1.0, late: int = 0) -> Tensor:
    """Hands that go overhead and down, feet that open and close, by shares of the usual size; feet some frames later."""
    states = person()
    joints = as_joints(states)
    for wrist, side in ((R_WRIST, 1), (L_WRIST, -1)):
        joints[0, :, wrist, 2] += hands * 0.9 * PHASE
        joints[0, :, wrist, 0] += side * 0.3 * (PHASE * (1 - PHASE))
    for ankle, side in ((R_ANKLE, 1), (L_ANKLE, -1)):
        joints[0, :, ankle, 0] += side * feet * 0.2 * PHASE.roll(late)
    return states


def circle(turns: float = 1.0, narrow: float = 1.0) -> Tensor:
    """Arms held sideways that turn, on a path that is round or, with 0, a line."""
    states = person()
    joints = as_joints(states)
    angle = 2 * math.pi * turns * TIME
    for wrist, shoulder, side in ((R_WRIST, 6, 1), (L_WRIST, 9, -1)):
        joints[0, :, wrist] = joints[0, :, shoulder] + torch.stack(
            [torch.full_like(TIME, side * 0.5), narrow * 0.2 * torch.sin(angle), 0.2 * torch.cos(angle)], dim=-1
        )
    return states


def test_a_jumping_jack_needs_hands_and_feet_in_time() -> None:
    rule = partial(satisfied, "jumping jacks")
    assert rule(jack()).tolist() == [True]
    assert rule(jack(hands=0.4)).tolist() == [False], "hands that stay below the head"
    assert rule(jack(feet=0.2)).tolist() == [False], "feet that hardly open"
    assert rule(jack(feet=0)).tolist() == [False]
    assert rule(jack(late=HORIZON // 4)).tolist() == [False], "feet a quarter of a cycle later"
    assert rule(jack(late=HORIZON // 2)).tolist() == [True], "some open their feet while the hands sink"
    one = jack()
    as_joints(one)[:, :, L_WRIST] = as_joints(person())[:, :, L_WRIST]
    assert rule(one).tolist() == [False], "one hand"
    lying = jack()[..., [*range(42)]].clone()
    as_joints(lying)[..., 2] *= 0.3
    assert rule(lying).tolist() == [False], "nobody upright"
    trembling = jack() + 0.03 * torch.randn(1, HORIZON, 42, generator=torch.Generator().manual_seed(0))
    assert rule(trembling).tolist() == [False]


def test_an_arm_circle_needs_a_turn_on_a_round_path() -> None:
    rule = partial(satisfied, "arm circle")
    assert rule(circle()).tolist() == [True]
    assert rule(circle(turns=-1)).tolist() == [True], "the other way round"
    assert rule(circle(turns=0.5)).tolist() == [False]
    assert rule(circle(narrow=0)).tolist() == [False], "up and down"
    assert rule(person()).tolist() == [False]
    assert measures.arm_rotation(circle()).mean().item() == pytest.approx(measures.FULL_TURN, abs=10)
    raised = person()
    as_joints(raised)[0, :, [R_WRIST, L_WRIST], 2] += TIME[:, None]
    assert rule(raised).tolist() == [False], "arms that are raised without a turn"


def test_knees_are_raised_one_at_a_time_and_bent_together_in_a_squat() -> None:
    raised = person()
    as_joints(raised)[0, :, R_KNEE, 2] += 0.45 * PHASE
    assert satisfied("knee raise", raised).tolist() == [True]
    assert satisfied("knee raise", person()).tolist() == [False]
    squatting = person()
    joints = as_joints(squatting)
    joints[0, :, [R_KNEE, L_KNEE], 1] += 0.35 * PHASE[:, None]
    joints[0, :, [R_KNEE, L_KNEE], 2] += 0.2 * PHASE[:, None]
    joints[0, :, [R_ANKLE, L_ANKLE], 2] += 0.4 * PHASE[:, None]
    assert satisfied("squat", squatting).tolist() == [True]
    assert satisfied("knee raise", squatting).tolist() == [False]
    assert satisfied("squat", person()).tolist() == [False]


def test_thresholds_are_those_of_the_conditions_and_refuse_people_who_stand() -> None:
    assert {action: {*limits} for action, limits in THRESHOLDS.items()} == {action: {*own} for action, own in CONDITIONS.items()}
    assert {*CONDITIONS} == {*SUITES["more"].goals}
    for action in CONDITIONS:
        assert not satisfied(action, people(20)).any(), action
    assert measures.rule("up down", people(1), None).tolist() == [0]
    assert measures.recognised("up down", people(1), None).isnan().all(), "the judge does not know it"
    turned = measures.full_turn("arm circle", torch.cat([circle(turns=1.1), circle(turns=0.8)]), None)
    assert turned.tolist() == [1, 0]


def test_level_starts_and_strides_are_counted_apart_and_nothing_is_said_of_other_goals() -> None:
    states = torch.cat([jack(), jack(feet=0)])
    starts = InitialStates({POSE: states[:, 0].clone()})
    as_joints(starts.observed[POSE])[1, R_ANKLE, 1] += 0.5
    assert measures.rule("jumping jacks", states, starts).tolist() == [1, 0]
    assert measures.level("jumping jacks", states, starts).nan_to_num(-1).tolist() == [1, -1]
    assert measures.strides("jumping jacks", states, starts).nan_to_num(-1).tolist() == [-1, 0]
    for name in ("rule", "level", "strides", "full turn", "feet in time", "degrees turned"):
        assert DOMAIN.measure("walk", states, starts)[name].isnan().all(), name
    assert DOMAIN.measure("jumping jacks", states, starts)["amplitude of feet"][0] == pytest.approx(0.4, abs=0.01)


def test_half_of_the_windows_begin_elsewhere_and_go_on_as_recorded() -> None:
    states = jack().repeat(200, 1, 1)
    observed = {POSE: states[:, 0]}
    same, seen = begun_elsewhere(states, observed, None)
    assert same is states
    assert seen is observed
    begun, seen = begun_elsewhere(states, observed, torch.Generator().manual_seed(0))
    elsewhere = (begun[:, 0] != states[:, 0]).any(dim=1)
    assert 70 < elsewhere.sum() < 130
    assert torch.equal(begun[~elsewhere], states[~elsewhere])
    assert torch.equal(begun[:, BLENDED[1] :], states[:, BLENDED[1] :])
    assert torch.equal(seen[POSE], begun[:, 0]), "the model observes where the window begins"
    rigid = with_rigid_bones(begun, observed)  # bones are those of the person
    assert torch.allclose(rigid[elsewhere, : BLENDED[0]], begun[elsewhere, : BLENDED[0]], atol=1e-5)
    again, _ = begun_elsewhere(states, observed, torch.Generator().manual_seed(0))
    assert torch.equal(again, begun)
    assert VIEWS["smooth"].perturb is begun_elsewhere


def test_poses_are_drawn_of_people_who_stand_and_walk() -> None:
    poses = drawn_poses(500, torch.Generator().manual_seed(0))
    assert poses.shape == (500, 42)
    assert 0.3 < measures.is_stride(poses).float().mean() < 0.8
    assert not measures.is_stride(standing_poses(20, torch.Generator().manual_seed(0))).any()
    assert measures.is_stride(walking_poses(500, torch.Generator().manual_seed(0))).any()


def test_smoothing_removes_trembling_and_keeps_the_ends() -> None:
    states = jack()
    observed = {POSE: states[:, 0]}
    trembling = states + 0.003 * torch.randn(states.shape, generator=torch.Generator().manual_seed(0))
    trembling[:, 0] = states[:, 0]
    smooth = smoothed(trembling, observed)
    assert measures.jerk("jumping jacks", smooth, None) < 0.5 * measures.jerk("jumping jacks", trembling, None)
    assert torch.allclose(smooth[:, 0], states[:, 0], atol=1e-6)
    rigid = with_rigid_bones(states, observed)
    assert (smoothed(rigid, observed) - rigid).abs().max() < 0.02, "metres by which a second of motion is changed at most"


def people(count: int, seed: int = 0) -> Tensor:
    """Windows of people who stand still."""
    return standing_poses(count, torch.Generator().manual_seed(seed))[:, None].repeat(1, HORIZON, 1)


def wrists_at(heights: Tensor) -> Tensor:
    """One window whose wrists are at heights ``(32,)`` above the shoulders."""
    states = people(1)
    joints = as_joints(states)
    joints[:, :, [R_WRIST, L_WRIST], 2] = joints[:, :, [6, 9], 2] + heights[:, None]
    return joints.flatten(2)


@pytest.fixture(scope="module")
def judge() -> Judge:
    torch.manual_seed(0)
    return Judge().requires_grad_(False)


def test_bones_of_the_start_have_no_error_longer_ones_their_share_and_each_window_one_value() -> None:
    states = people(3)
    starts = InitialStates({POSE: states[:, 0]}, torch.zeros(3, 0))
    assert bone_error("walk", states, starts).abs().max() < 1e-6
    assert torch.allclose(bone_error("walk", 1.1 * states, starts), torch.full((3,), 0.1), atol=1e-5)
    assert bone_error("walk", 1.1 * states, None).abs().max() < 1e-6, "without a start, the first frame's lengths are right"
    for name, metric in DOMAIN.metrics.items():
        assert metric.measure("walk", states, None).shape == (3,), name


def test_jerk_is_the_size_of_the_third_derivative() -> None:
    time = torch.arange(HORIZON, dtype=torch.float64) / FPS
    states = torch.zeros(2, HORIZON, 14, 3, dtype=torch.float64)
    states[1, :, :, 2] = (time**3)[:, None]
    found = jerk("walk", states.flatten(2), None)
    assert torch.allclose(found, torch.tensor([0.0, 6.0], dtype=torch.float64), atol=1e-6)


def test_arms_rise_only_when_both_go_from_low_to_high() -> None:
    up = torch.linspace(-0.3, 0.4, HORIZON)
    assert rise("jumping jacks", wrists_at(up), None).tolist() == [True]
    assert rise("jumping jacks", wrists_at(up.flip(0)), None).tolist() == [False], "arms that come down"
    assert rise("jumping jacks", wrists_at(torch.full((HORIZON,), 0.4)), None).tolist() == [False], "a frozen frame"
    one = wrists_at(up)
    as_joints(one)[:, :, L_WRIST, 2] = -0.5
    assert rise("jumping jacks", one, None).tolist() == [False]


def test_sets_are_near_when_equal_and_compared_at_equal_numbers_and_repeatably(judge: Judge) -> None:
    draw = torch.Generator().manual_seed(1)

    def trembling(size: float) -> Tensor:
        return people(60) + size * torch.randn(60, HORIZON, 42, generator=draw)

    distances = script("mocap_distances").distances
    same = distances(trembling(0.01), trembling(0.01), seed=0, judge=judge)
    other = distances(trembling(0.1), trembling(0.01), seed=0, judge=judge)
    assert set(same) == {"fid", "kid", "number"}
    assert same["number"] == 60
    assert other["fid"] > 5 * same["fid"]
    assert other["kid"] > abs(same["kid"]) + 1
    states = people(40) + 0.02 * torch.randn(40, HORIZON, 42, generator=torch.Generator().manual_seed(2))
    before = torch.random.get_rng_state()
    first = distances(states[:12], states, seed=3, judge=judge)
    assert first == distances(states[:12], states, seed=3, judge=judge)
    assert first["number"] == 12
    assert torch.equal(torch.random.get_rng_state(), before), "randomness outside is left as it was"
    with pytest.raises(UserError, match="expected two windows or more on each side, found 1 and 40"):
        distances(states[:1], states, seed=0, judge=judge)


def test_copies_of_one_window_have_no_diversity(judge: Judge) -> None:
    states = people(30) + 0.05 * torch.randn(30, HORIZON, 42, generator=torch.Generator().manual_seed(2))
    sets = script("mocap_distances")
    diversity = sets.diversity
    assert diversity(states[:1].repeat(5, 1, 1), seed=0, judge=judge) == pytest.approx(0, abs=1e-4)
    assert diversity(states, seed=0, judge=judge) > 0.05
    within = {"one": states[:1].repeat(4, 1, 1), "other": states, "single": states[:1]}
    assert sets.multimodality(within, seed=0, judge=judge) > 0
    with pytest.raises(UserError, match="two windows or more of some goal"):
        sets.multimodality({"single": states[:1]}, seed=0, judge=judge)
    with pytest.raises(UserError, match="two windows or more, found 1"):
        diversity(states[:1], seed=0, judge=judge)


def test_what_is_learned_from_generated_motion_is_tested_on_real_motion() -> None:
    def moved(heights: Tensor, count: int, seed: int) -> Tensor:
        return wrists_at(heights) + 0.005 * torch.randn(count, HORIZON, 42, generator=torch.Generator().manual_seed(seed))

    learned_elsewhere = script("mocap_distances").learned_elsewhere
    up, low = torch.linspace(-0.3, 0.4, HORIZON), torch.full((HORIZON,), -0.3)
    generated = {"raise": moved(up, 20, 0), "stand": moved(low, 20, 1)}
    assert learned_elsewhere(generated, {"raise": moved(up, 8, 2), "stand": moved(low, 8, 3)}) == 1
    assert learned_elsewhere(generated, {"raise": moved(low, 8, 2), "stand": moved(low, 8, 3)}) == 0.5
    with pytest.raises(UserError, match="expected the same two classes or more"):
        learned_elsewhere(generated, {"raise": moved(up, 8, 2)})
