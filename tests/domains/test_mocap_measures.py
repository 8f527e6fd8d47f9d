import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import DOMAIN, measures
from ftl_lightning.domains.mocap.judge import Judge
from ftl_lightning.domains.mocap.measures import bone_error, distances, diversity, jerk, learned_elsewhere, rise
from ftl_lightning.domains.mocap.skeleton import FPS, HORIZON, L_WRIST, POSE, R_WRIST, as_joints, standing_poses
from ftl_lightning.services.errors import UserError


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
    assert diversity(states[:1].repeat(5, 1, 1), seed=0, judge=judge) == pytest.approx(0, abs=1e-4)
    assert diversity(states, seed=0, judge=judge) > 0.05
    within = {"one": states[:1].repeat(4, 1, 1), "other": states, "single": states[:1]}
    assert measures.multimodality(within, seed=0, judge=judge) > 0
    with pytest.raises(UserError, match="two windows or more of some goal"):
        measures.multimodality({"single": states[:1]}, seed=0, judge=judge)
    with pytest.raises(UserError, match="two windows or more, found 1"):
        diversity(states[:1], seed=0, judge=judge)


def test_what_is_learned_from_generated_motion_is_tested_on_real_motion() -> None:
    def moved(heights: Tensor, count: int, seed: int) -> Tensor:
        return wrists_at(heights) + 0.005 * torch.randn(count, HORIZON, 42, generator=torch.Generator().manual_seed(seed))

    up, low = torch.linspace(-0.3, 0.4, HORIZON), torch.full((HORIZON,), -0.3)
    generated = {"raise": moved(up, 20, 0), "stand": moved(low, 20, 1)}
    assert learned_elsewhere(generated, {"raise": moved(up, 8, 2), "stand": moved(low, 8, 3)}) == 1
    assert learned_elsewhere(generated, {"raise": moved(low, 8, 2), "stand": moved(low, 8, 3)}) == 0.5
    with pytest.raises(UserError, match="expected the same two classes or more"):
        learned_elsewhere(generated, {"raise": moved(up, 8, 2)})
