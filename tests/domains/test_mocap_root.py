"""Human motion with the path of the root: states, their place in space, augmentation, sliding feet, films and files."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.domains.mocap import ROOTED, skeleton
from ftl_lightning.domains.mocap.bvh import bvh
from ftl_lightning.domains.mocap.domain import SLIDING, begun_elsewhere, planted
from ftl_lightning.domains.mocap.measures import SETTLED, skating
from ftl_lightning.domains.mocap.prepare import demonstrated_with_root
from ftl_lightning.domains.mocap.rendering import SOLE, wireframe
from ftl_lightning.domains.mocap.skeleton import ANKLES, COLUMNS, HIPS, HORIZON, POSE, in_space, mirrored, normalised, root_columns
from tests.domains.mocap_samples import folder, motion

ROOT = slice(len(COLUMNS), None)


def walk_in_space(frames: int, turn: float, pace: float = 0.03) -> torch.Tensor:
    """Joints ``(frame, 14, 3)`` of a rigid body that moves forwards and turns, from a place that is not the origin."""
    (pose,) = skeleton.standing_poses(1, torch.Generator().manual_seed(0)).reshape(1, 14, 3)
    yaw = 0.7 + turn * torch.arange(frames)
    steps = pace * torch.stack((-yaw.sin(), yaw.cos()), dim=-1)
    path = torch.tensor((2.0, -1.0)) + torch.cat((torch.zeros(1, 2), steps[:-1].cumsum(dim=0)))
    x, y = pose[:, 0], pose[:, 1]
    turned = torch.stack((yaw.cos()[:, None] * x - yaw.sin()[:, None] * y, yaw.sin()[:, None] * x + yaw.cos()[:, None] * y), dim=-1)
    height = pose[:, 2] - pose[list(ANKLES), 2].min()
    return torch.cat((turned + path[:, None], height.expand(frames, -1)[..., None]), dim=-1)


def test_states_keep_the_path_up_to_where_it_begins_and_faces() -> None:
    joints = walk_in_space(40, turn=-0.1)
    states = torch.from_numpy(normalised(joints.double().numpy()).rooted)
    assert states.shape == (40, len(ROOTED.plans.columns))
    assert torch.allclose(states[:, ROOT], torch.tensor((0.0, 0.03, states[0, 44].item(), -0.1)), atol=1e-5)
    placed = in_space(states)
    between, before = (torch.cdist(points.flatten(0, 1).double(), points.flatten(0, 1).double()) for points in (placed, joints))
    assert torch.allclose(between, before, atol=1e-4)
    assert placed[0, list(HIPS), :2].mean(dim=0).abs().max() < 1e-5
    assert placed[:, list(ANKLES), 2].amin(dim=1).abs().max() < 1e-5


def test_a_turn_beyond_half_a_circle_is_a_small_step() -> None:
    poses = normalised(walk_in_space(100, turn=0.09).double().numpy())
    assert np.abs(np.diff(poses.root[:, 3])).max() > 6
    assert np.allclose(root_columns(poses.positions, poses.root)[:, 3], 0.09, atol=1e-5)


def test_mirror_images_go_to_the_other_side() -> None:
    states = torch.from_numpy(normalised(walk_in_space(40, turn=0.05).double().numpy()).rooted)
    other = mirrored(states)
    assert torch.equal(mirrored(other), states)
    expected = in_space(states)[:, list(skeleton.MIRROR)] * torch.tensor((-1.0, 1.0, 1.0))
    assert torch.allclose(in_space(other), expected, atol=1e-5)


def test_a_window_begun_in_another_pose_stands_there_on_the_ground() -> None:
    states = torch.from_numpy(normalised(walk_in_space(HORIZON, turn=0.0).double().numpy()).rooted).repeat(64, 1, 1)
    begun, observed = begun_elsewhere(states, {POSE: states[:, 0, : len(COLUMNS)]}, torch.Generator().manual_seed(1))
    moved = (begun[:, 0] - states[:, 0]).abs().amax(dim=1) > 1e-4
    assert 16 < moved.sum() < 48
    assert torch.equal(begun[:, 0, : len(COLUMNS)], observed[POSE])
    assert begun[moved, 0, 42:44].abs().max() < 1e-6, "nobody moves in the first frame"
    assert in_space(begun[moved])[:, 0, list(ANKLES), 2].amin(dim=1).abs().max() < 1e-5
    assert torch.equal(begun[:, 16:], states[:, 16:])


@pytest.mark.parametrize("name", sorted(ROOTED.plans.views))
def test_views_keep_the_root(name: str) -> None:
    states = torch.from_numpy(normalised(walk_in_space(HORIZON, turn=0.01, pace=0.01).double().numpy()).rooted)[None]
    view, observed = ROOTED.plans.views[name], {POSE: states[:, 0, : len(COLUMNS)]}
    assert torch.allclose(view.decode(view.encode(states, observed), observed), states, atol=1e-4)


def test_standing_feet_of_samples_hardly_slide_and_feet_in_the_air_are_left_alone() -> None:
    states = torch.from_numpy(normalised(walk_in_space(HORIZON, turn=0.03).double().numpy()).rooted)[None]
    moved = planted(states, {})
    assert skating("walk", moved, None).item() == pytest.approx(SLIDING, abs=1e-5)
    assert torch.equal(moved[..., : len(COLUMNS)], states[..., : len(COLUMNS)])
    states[..., 44] += 0.1
    assert torch.equal(planted(states, {}), states)


def test_feet_slide_by_as_much_as_the_body_and_feet_in_the_air_do_not() -> None:
    states = torch.from_numpy(normalised(walk_in_space(HORIZON, turn=0.0).double().numpy()).rooted)[None]
    still, jump = states.clone(), states.clone()
    still[..., 42:44] = 0
    jump[..., 44] += 0.1
    assert skating("walk", states, None).item() == pytest.approx(0.03, abs=1e-5)
    assert skating("walk", still, None).item() == pytest.approx(0, abs=1e-6)
    assert skating("walk", jump, None).isnan().all()
    jump[:, SETTLED:20, 44] -= 0.1
    assert skating("walk", jump, None).item() == pytest.approx(0.03, abs=1e-5)


def test_recordings_become_demonstrations_with_root(tmp_path: Path) -> None:
    source = ROOTED.source(folder(tmp_path))
    drawn = ROOTED.fitted(source.draw("jumping jacks", 3, 0))
    assert drawn.states.shape == (3, HORIZON, 46)
    assert torch.equal(drawn.observed[POSE], drawn.states[..., : len(COLUMNS)])
    starts = source.starts("jumping jacks", 5, 0)
    assert starts.observed[POSE].shape == (5, len(COLUMNS))
    frozen = ROOTED.comparison.references["frozen frame"]("jumping jacks", 5, starts, 0)
    assert ROOTED.measure("jumping jacks", frozen, starts)["skating"].abs().max() < 1e-6


def test_films_and_files_show_where_somebody_goes(tmp_path: Path) -> None:
    states = torch.from_numpy(normalised(walk_in_space(HORIZON, turn=0.05).double().numpy()).rooted)
    points = wireframe(states).points
    assert points[..., 2].min() == pytest.approx(SOLE, abs=1e-4)
    gone = np.linalg.norm(points[-1, skeleton.HEAD, :2] - points[0, skeleton.HEAD, :2])
    assert gone == pytest.approx(2 * 0.03 / 0.05 * math.sin(0.05 * 31 / 2), rel=0.1)
    (path := tmp_path / "walk.bvh").write_text(bvh(states))
    again = demonstrated_with_root(path)
    assert torch.allclose(again.states[0, 1:, : len(COLUMNS)], states[-len(again.states[0]) + 1 :, : len(COLUMNS)], atol=1e-4)
    assert torch.allclose(again.states[0, 1:, ROOT], states[-len(again.states[0]) + 1 :, ROOT], atol=1e-4)


def test_small_motions_of_the_shared_sample_have_a_path_too() -> None:
    joints = torch.from_numpy(motion(HORIZON, 1)).double().numpy()
    assert np.abs(normalised(joints).rooted[:, 42:44]).max() < 1e-6
