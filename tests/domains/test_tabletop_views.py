"""Scenes seen from other sides: picture, pose and plan move together, as the scene itself would."""

import math

import pytest
import torch

from ftl_lightning.data.features import take
from ftl_lightning.domains.tabletop.interface import (
    HAND,
    IMAGE,
    MOVED,
    ORIGIN,
    POINTS,
    POSE,
    SHIFT,
    UNMOVED,
    VIEWS,
    WIDE_VIEWS,
    moved,
)
from ftl_lightning.domains.tabletop.scenes import BOOK, CIRCLE, TRIANGLE, scene_of
from ftl_lightning.domains.tabletop.source import initial_states
from ftl_lightning.services.randomness import generator

PLACED = {CIRCLE: (0.42, 0.12, 0.0), TRIANGLE: (0.55, -0.10, 0.3), BOOK: (0.57, 0.10, 0.2)}


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_moved_scene_looks_as_one_that_was_built_there(mirrored: bool) -> None:
    angle, shift = 0.3, (-0.02, 0.015)
    place = torch.tensor([[[x, y, 0.1, 0.0] for x, y, _ in PLACED.values()]])
    start = initial_states(torch.from_numpy(scene_of(PLACED))[None])
    plan, seen = moved(place, start.observed, torch.tensor([mirrored]), torch.tensor([angle]), torch.tensor([shift]))
    there = {
        name: (float(x), float(y), angle + (-yaw if mirrored else yaw))
        for (name, (_, _, yaw)), (x, y) in zip(PLACED.items(), plan[0, :, :2], strict=True)
    }
    built = initial_states(torch.from_numpy(scene_of(there))[None])
    off, before = ((one[IMAGE].float() - built.observed[IMAGE].float()).abs().mean() for one in (seen, start.observed))
    assert off < 0.3 * before  # what is left are edges, and the shift of what is high
    assert torch.equal(plan[..., 2:], place[..., 2:])
    hand = start.observed[POSE]
    x, y = hand[0, 0] - 0.5, -hand[0, 1] if mirrored else hand[0, 1]
    turned = [0.5 + math.cos(angle) * x - math.sin(angle) * y + shift[0], math.sin(angle) * x + math.cos(angle) * y + shift[1]]
    torch.testing.assert_close(seen[POSE][0, :2], torch.tensor(turned), atol=1e-5, rtol=0)
    assert torch.equal(seen[POSE][:, 2:], hand[:, 2:])


def test_places_are_told_from_the_hand() -> None:
    start = initial_states(torch.from_numpy(scene_of(PLACED))[None])
    view, hand = VIEWS[HAND], start.observed[POSE][0]
    plan = torch.tensor([[[float(hand[0]) + 0.1, float(hand[1]), float(hand[2]) - 0.05, 0.08]]])
    told = view.encode(plan, start.observed)
    torch.testing.assert_close(told, torch.tensor([[[0.1, 0.0, -0.05, 0.08]]]))
    torch.testing.assert_close(view.decode(told, start.observed), plan)
    # The picture of a circle at the hand has its green where the origin is.
    below = {CIRCLE: (float(hand[0]), float(hand[1]), 0.0), TRIANGLE: (0.62, -0.18, 0.3)}
    seen = view.observe(initial_states(torch.from_numpy(scene_of(below))[None]).observed)
    red, green, _ = seen[IMAGE][0].float()
    mask = (green > 1.5 * red).float()
    along = torch.linspace(-1, 1, 64)
    found = torch.stack((mask.sum(0) @ along, mask.sum(1) @ along)) / mask.sum()
    torch.testing.assert_close(seen[ORIGIN][0], found, atol=0.04, rtol=0)  # a pixel is 0.03


def test_perturbing_is_random_as_drawn_and_leaves_a_new_task_alone() -> None:
    perturb = VIEWS[MOVED].perturb
    assert perturb is not None
    start = initial_states(torch.from_numpy(scene_of(PLACED))[None])
    many = take(start.observed, [0] * 50)
    plans = torch.tensor([0.5, 0.0, 0.1, 0.0]).expand(50, 4, 4)
    once, again, other = (perturb(plans, many, generator("cpu", seed)) for seed in (0, 0, 1))
    assert torch.equal(once[0], again[0])
    assert torch.equal(once[1][IMAGE], again[1][IMAGE])
    assert not torch.equal(once[0], other[0])
    # The middle is only shifted.
    assert 0.8 * SHIFT < (once[0][..., :2] - plans[..., :2]).abs().max() <= SHIFT + 1e-6
    assert once[1][IMAGE].dtype == torch.uint8
    assert perturb(plans, many, None)[0] is plans


def test_pretraining_of_the_wide_model_leaves_some_scenes_as_the_camera_sees_them_but_inversion_none() -> None:
    perturb, learning = WIDE_VIEWS[POINTS].pretraining, WIDE_VIEWS[POINTS].perturb
    assert perturb is not None
    assert learning is not None
    many = take(initial_states(torch.from_numpy(scene_of(PLACED))[None]).observed, [0] * 200)
    plans = torch.rand(1, 4, 4).repeat(200, 1, 1)
    states, seen = perturb(plans, many, generator("cpu", 0))
    still = (states == plans).flatten(1).all(dim=1)
    assert abs(float(still.float().mean()) - UNMOVED) < 0.1
    same = (seen[IMAGE] == many[IMAGE]).flatten(1).all(dim=1)
    assert same[still].all()
    assert not same[~still].any()
    every = learning(plans, many, generator("cpu", 0))[0]
    assert torch.equal(every[~still], states[~still])
    assert not (every == plans).flatten(1).all(dim=1).any()
