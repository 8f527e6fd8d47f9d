"""Drives that a hand leads are drives like the expert's."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.agent.domain import DOMAIN, progressed, reached
from ftl_lightning.domains.agent.environment import AgentEnvironment
from ftl_lightning.domains.agent.expert import LENGTH, SPEED
from ftl_lightning.domains.agent.rendering import SEEN
from ftl_lightning.domains.agent.scenes import OBSERVED, REACH, object_positions, target
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.recorder import Scene, check_path
from ftl_lightning.services.errors import UserError

assert DOMAIN.recordings.recorder is not None
RECORDER = DOMAIN.recordings.recorder
GOAL = "go to red bowl"


def places(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Where the agent, the target and the distractor are, x and z."""
    assert scene.starts is not None
    world = scene.starts.observed[OBSERVED]
    chosen = int(target(GOAL, world)[0])
    objects = object_positions(world)[0].double().numpy()[:, [0, 2]]
    return np.array(scene.pieces[0].at), objects[chosen], objects[1 - chosen]


def led(scene: Scene, to: NDArray[np.float64], bow: float = 0.0, trembling: float = 0.01) -> Demonstrations:
    """A drive along a hand's way to a place, which bows aside and trembles."""
    start, count = np.array(scene.pieces[0].at), 90
    share = np.linspace(0, 1, count)[:, None]
    aside = np.array([-(to - start)[1], (to - start)[0]]) / np.linalg.norm(to - start)
    way = start + share * (to - start) + bow * np.sin(np.pi * share) * aside
    way = np.rint((way + np.random.default_rng(0).normal(0, trembling, way.shape)) / 0.005) * 0.005
    return RECORDER.record(scene, *check_path(scene, way[:, None].tolist(), np.linspace(0, 3, count).tolist()))


def as_rollout(drive: Demonstrations) -> Rollout:
    return Rollout(drive.initial_states, drive.observed, torch.zeros(1, dtype=torch.bool), [{}])


def roughness(drive: Demonstrations, row: int = 0) -> float:
    """How much the acceleration changes once the agent is under way, in m/s a step squared, as a mean."""
    velocity = drive.states[row, 8 : int(drive.lengths[row]), 7:10]
    return float(torch.linalg.vector_norm(torch.diff(velocity, n=2, dim=0), dim=1).mean())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bow", [0.0, 0.25])
def test_a_way_led_to_the_red_bowl_is_a_demonstration_of_it(seed: int, bow: float) -> None:
    scene = RECORDER.scene(GOAL, seed)
    start, bowl, other = places(scene)
    aside = np.array([-(bowl - start)[1], (bowl - start)[0]])
    drive = led(scene, bowl, -bow if aside @ (other - start) > 0 else bow)  # away from the other object
    assert progressed(GOAL, drive.states, drive.initial_states).all()
    outcomes = reached(GOAL, as_rollout(drive))
    assert outcomes["success"].all()
    assert not outcomes["distractor"].any()
    end = np.linalg.norm(drive.states[0, -1, [0, 2]].numpy() - bowl)
    assert 0.24 < end < REACH  # just before the bodies touch, as the expert's
    assert torch.linalg.vector_norm(drive.states[0, -1, 7:10]) < 0.02  # at rest


def test_a_trembling_hand_leads_as_smooth_a_drive_as_the_experts() -> None:
    starts = DOMAIN.source(None).starts(GOAL, 4, 0)
    expert = DOMAIN.source(None).draw(GOAL, 4, 0)  # in the same scenes
    led_roughly, usual = [], []
    for row in range(4):
        scene = replace(RECORDER.scene(GOAL, 0), starts=starts.take([row]))
        drive = led(scene, places(scene)[1], trembling=0.01)
        led_roughly.append(roughness(drive))
        usual.append(roughness(expert, row))
        fastest, experts = (torch.linalg.vector_norm(one[:, 7:10], dim=1).max() for one in (drive.states[0], expert.states[row]))
        assert fastest < 1.02 * experts
        assert abs(int(drive.lengths[0]) - int(expert.lengths[row])) <= 3  # whatever time the hand took
    assert np.mean(led_roughly) < 1.35 * np.mean(usual)


def test_a_drive_has_all_that_the_experts_have_and_is_made_while_one_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, done, step = RECORDER.scene("", 1), Counter[str](), AgentEnvironment.step

    def counted(self: AgentEnvironment, action: NDArray[np.float32]) -> Any:
        done["step"] += 1
        return step(self, action)

    monkeypatch.setattr(AgentEnvironment, "step", counted)
    monkeypatch.setattr(AgentEnvironment, "render", lambda self: done.update(["picture"]))
    drive = led(scene, places(scene)[1])
    assert done == {"step": int(drive.lengths[0]) - 1}  # one pass of the simulator, without a picture
    expert = DOMAIN.source(None).draw(GOAL, 1, 0)
    assert drive.features == expert.features
    assert drive.per_step == expert.per_step
    assert (drive.state_names, drive.state_units, drive.domain) == (expert.state_names, expert.state_units, expert.domain)
    assert drive.concepts == ("",)
    assert drive.scenes is not None
    assert scene.starts is not None
    assert torch.equal(drive.scenes, scene.starts.scenes if scene.starts.scenes is not None else torch.empty(0))
    assert torch.equal(drive.states, drive.observed[OBSERVED][..., :13])


def test_a_long_way_ends_within_a_demonstrations_length_at_rest_and_in_sight_and_no_way_shows_nothing() -> None:
    scene = RECORDER.scene(GOAL, 0)
    start = np.array(scene.pieces[0].at)
    angle = np.linspace(0, 40, 2000)
    spiral = start + 0.02 * angle[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    drive = RECORDER.record(scene, *check_path(scene, spiral[:, None], np.arange(2000.0)))
    assert int(drive.lengths[0]) <= LENGTH
    assert torch.linalg.vector_norm(drive.states[0, -1, 7:10]) < 0.02
    outside = RECORDER.record(scene, *check_path(scene, [[[start[0], 3.0]]], [0.0]))
    (_, (_, high)) = SEEN
    assert outside.states[0, :, 2].max() < high + 0.02
    x, z = start
    with pytest.raises(UserError, match="lead the agent further"):
        RECORDER.record(scene, *check_path(scene, [[[x, z]], [[x + 0.05, z]]], [0.0, 1.0]))


def test_scenes_are_those_of_their_task_and_move_the_agent_alone_and_need_the_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"go to bowl", GOAL, "go to green cone"} <= set(RECORDER.tasks)
    for task in RECORDER.tasks:
        scene = RECORDER.scene(task, 2)
        assert scene.starts is not None
        target(task, scene.starts.observed[OBSERVED])  # one of the objects
        (piece,) = scene.pieces
        (number,) = piece.shapes
        assert np.allclose(scene.film.shapes[number].points[0, 0], piece.at)
        assert scene.film.frames == 1
        # The page stops the hand before a demonstration is full.
        assert scene.speed * scene.seconds <= SPEED * 0.05 * LENGTH
    with pytest.raises(UserError, match="agent task"):
        RECORDER.scene("go to blue bowl", 0)
    assert torch.equal(RECORDER.scene("", 5).starts.observed[OBSERVED], RECORDER.scene("", 5).starts.observed[OBSERVED])  # type: ignore[union-attr]
    assert not torch.equal(*(RECORDER.scene("", seed).starts.observed[OBSERVED] for seed in (5, 6)))  # type: ignore[union-attr]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match="pip install 'ftl-lightning\\[navigation\\]'"):
        RECORDER.scene(GOAL, 0)
