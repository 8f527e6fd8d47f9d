"""What a user can do wrong with the table-top, and what may break: each told in one line, and the rest goes on."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.tabletop import DOMAIN, source
from ftl_lightning.domains.tabletop.domain import POLICIES
from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
from ftl_lightning.domains.tabletop.interface import (
    FEATURES,
    IMAGE,
    NAME,
    OPEN,
    POSE,
    PUSH,
    PUSH_ON_BOOK,
    STATE_NAMES,
    STATE_UNITS,
    TASKS,
    TRAINING_CONCEPTS,
)
from ftl_lightning.domains.tabletop.scenes import CIRCLE, HAND, TRIANGLE, scene_of
from ftl_lightning.domains.tabletop.source import Episode
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation import generation
from ftl_lightning.evaluation.closed_loop import fixed_plans, reset, roll_out
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.services.errors import Note, UserError
from ftl_lightning.training.data import InversionData, PretrainingData
from tests.conftest import refused

assert DOMAIN.closed_loop is not None
LOOP = DOMAIN.closed_loop
GOOD = scene_of({CIRCLE: (0.45, 0.0, 0.0), TRIANGLE: (0.60, 0.0, 0.0)})
OVERLAP = scene_of({CIRCLE: (0.45, 0.0, 0.0), TRIANGLE: (0.47, 0.0, 0.0)})
TIME = 6


def made(task: str = PUSH, count: int = 2, **changes: Any) -> Demonstrations:
    """Demonstrations in which nothing moves."""
    values: dict[str, Any] = {
        "states": torch.zeros(count, TIME, 4),
        "lengths": torch.full((count,), TIME),
        "domain": NAME,
        "state_names": STATE_NAMES,
        "state_units": STATE_UNITS,
        "concepts": (task,) * count,
        "observed": {IMAGE: torch.full((count, TIME, 3, 64, 64), 7, dtype=torch.uint8), POSE: torch.zeros(count, TIME, 8)},
        "per_step": (IMAGE, POSE),
        "scenes": torch.from_numpy(np.stack([GOOD] * count)),
    }
    return Demonstrations(**(values | changes))


def seen(**changes: torch.Tensor) -> dict[str, Any]:
    return {"observed": {**made().observed, **changes}}


POSES = made().observed[POSE]
SHAPE = r"\(3, 64, 64\)"
IMAGES = rf"key 'observed/image': expected uint8 images of shape {SHAPE} each, found"
POSES_OF_8 = r"key 'observed/pose': expected float32 of shape \(8,\) each, found"
THREE = {"states": torch.zeros(2, TIME, 3), "state_names": STATE_NAMES[:3], "state_units": STATE_UNITS[:3]}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (seen(image=torch.zeros(2, TIME, 3, 32, 32, dtype=torch.uint8)), rf"{IMAGES} uint8 images of shape \(3, 32, 32\)"),
        (seen(image=torch.zeros(2, TIME, 64, 64, 3, dtype=torch.uint8)), rf"{IMAGES} uint8 images of shape \(64, 64, 3\)"),
        (seen(image=torch.zeros(2, TIME, 3, 64, 64)), rf"{IMAGES} float32 of shape {SHAPE}"),
        ({"observed": {POSE: POSES}, "per_step": (POSE,)}, f"{IMAGES} none"),
        ({"observed": {}, "per_step": (), "scenes": None}, f"{IMAGES} none"),
        ({"per_step": (POSE,)}, rf"{IMAGES} .* \(observed at every time\? then list it in per_step\)"),
        (seen(pose=POSES.to(torch.uint8)), f"{POSES_OF_8} uint8 images"),
        (seen(pose=POSES[..., :7]), rf"{POSES_OF_8} float32 of shape \(7,\)"),
        ({"domain": "driving"}, "expected behaviour of tabletop, the model's domain, found that of driving"),
        (THREE, r"key 'states': expected states of 4 columns \(tabletop\), found 3"),
    ],
)
def test_demonstrations_that_do_not_fit(changes: dict[str, Any], expected: str) -> None:
    made(**changes).save("demos.safetensors")
    with pytest.raises(UserError, match=rf"demos.safetensors: .*{expected}") as told:
        InversionData(NAME, demonstrations="demos.safetensors")
    assert "\n" not in str(told.value)


def test_demonstrations_that_fit_go_through_files_of_both_kinds() -> None:
    fits = made()
    fits.save("demos.safetensors")
    observed = {f"observed/{name}": values.numpy() for name, values in fits.observed.items()}
    np.savez("demos.npz", states=fits.states.numpy(), per_step=np.array(fits.per_step), **observed)
    for name in ("demos.safetensors", "demos.npz"):
        found = InversionData(NAME, demonstrations=name).demonstrations
        assert torch.equal(found.observed[IMAGE], fits.observed[IMAGE])
    observed[f"observed/{IMAGE}"] = observed[f"observed/{IMAGE}"] / 255
    np.savez("demos.npz", states=fits.states.numpy(), per_step=np.array(fits.per_step), **observed)
    with pytest.warns(Note, match="shares in .0, 1. to bytes"):
        assert torch.equal(InversionData(NAME, demonstrations="demos.npz").demonstrations.observed[IMAGE], fits.observed[IMAGE])
    observed[f"observed/{IMAGE}"] = observed[f"observed/{IMAGE}"] - 0.5
    np.savez("demos.npz", states=fits.states.numpy(), per_step=np.array(fits.per_step), **observed)
    with pytest.raises(UserError, match=rf"demos.npz: .* expected uint8 images of shape {SHAPE} each, found float32"):
        InversionData(NAME, demonstrations="demos.npz")
    np.savez("demos.npz", states=fits.states.numpy())
    with pytest.raises(UserError, match=f"demos.npz: {IMAGES} none"):
        InversionData(NAME, demonstrations="demos.npz")


def test_commands_that_cannot_be_followed_are_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = f"table-top task: expected one of {TASKS[0]!r}, "
    assert main(["generate", NAME, "--task", "push green circle to sky"]) == 2
    assert unknown in capsys.readouterr().err
    for option, expected in (
        ("--count=0", "count: expected 1 or more, found 0"),
        ("--seed=-1", "seed: expected 0 or more, found -1"),
        ("--workers=0", "workers: expected 1 or more, found 0"),
        ("--out=.", "out: .: expected a file or nothing there, found a folder"),
    ):
        refused(capsys, ["generate", NAME, "--task", PUSH, option], expected)
    monkeypatch.setattr(source, "perform", lambda *_, **__: episode(success=False))
    expected = "table-top 'push green circle to orange triangle': expected 2 successful episodes of 8, found 0"
    refused(capsys, ["generate", NAME, "--task", PUSH, "--count=2"], expected)


def test_splits_have_four_times_as_many_pushes(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = set()

    def draw(self: source.Expert, task: str, count: int, seed: int, workers: int = 1, scatter: bool = False) -> Demonstrations:
        seeds.add(seed)
        return made(task, count)

    monkeypatch.setattr(source.Expert, "draw", draw)
    monkeypatch.setattr(source.Expert, "starts", lambda *_: made(count=1).initial_states)
    data = PretrainingData(NAME, samples_per_concept=3, validation_per_concept=1, batch_size=8, balance=0.0)
    data.setup("fit")
    for found, each in ((data.training, 3), (data.validation, 1)):
        assert Counter(found.concepts) == dict.fromkeys(TRAINING_CONCEPTS, each) | {PUSH: 4 * each}
    assert len(seeds) == 2
    first = data.first_windows()
    assert first.concepts.tolist() == [0, 1, 2, 3]
    assert first.observed[IMAGE].shape == (4, 3, 64, 64)
    assert data.every_window().concepts.bincount().tolist() == [3 * TIME, 3 * TIME, 12 * TIME, 3 * TIME]
    assert data.batch(0).observed[IMAGE].shape == (8, 3, 64, 64)


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (OVERLAP, "green circle and orange triangle overlap: expected 0.002 m between them, found"),
        (GOOD[:20], r"expected 24 numbers, found shape \(20,\)"),
    ],
)
def test_scenes_of_a_file_that_cannot_be_built(scene: np.ndarray, expected: str) -> None:
    first = np.resize(GOOD, scene.shape)
    made(scenes=torch.from_numpy(np.stack([first, scene]))).save("demos.safetensors")
    starts = Demonstrations.load("demos.safetensors").fitted(DOMAIN.observed).initial_states
    number = 0 if scene.shape != GOOD.shape else 1
    for run in (lambda: roll_out(LOOP, starts, still), lambda: reset(LOOP, starts.require_scenes())):
        with pytest.raises(UserError, match=f"^episode {number}: table-top scene: {expected}") as told:
            run()
        assert "\n" not in str(told.value)


def test_demonstrations_without_scenes_are_not_executed() -> None:
    with pytest.raises(UserError, match=r"key 'scenes': expected \(sample, scene\), by which an environment is reset, found none"):
        roll_out(LOOP, made(scenes=None).initial_states, still)


def still(observed: Any, rows: list[int], step: int) -> torch.Tensor:
    """The hand stays."""
    return torch.tensor([[*map(float, GOOD[HAND][:3]), OPEN]] * len(rows))


def fragile(where: str, error: BaseException) -> Callable[[], TableTopEnvironment]:
    """Environments of which the first breaks."""
    count: list[str] = []

    class Fragile(TableTopEnvironment):
        def __init__(self) -> None:
            super().__init__()
            count.append("")
            self.breaks = len(count) == 1

        def reset(self, **options: Any) -> Any:
            if self.breaks and where == "reset":
                raise error
            return super().reset(**options)

        def step(self, action: Any) -> Any:
            if self.breaks and where == "step" and self._steps == 1:
                raise error
            return super().step(action)

    return Fragile


def starts() -> InitialStates:
    return made(count=3).initial_states


@pytest.mark.parametrize(("where", "when"), [("reset", "before its first step"), ("step", "step 1")])
def test_an_episode_that_breaks_fails_and_the_others_go_on(where: str, when: str, caplog: pytest.LogCaptureFixture) -> None:
    found = roll_out(replace(LOOP, environment=fragile(where, RuntimeError("broke")), steps=3), starts(), still)
    assert found.failed.tolist() == [True, False, False]
    assert f"episode 0, {when}: RuntimeError('broke'); the episode counts as failed" in caplog.text
    assert [len(told.get("trace", ())) for told in found.infos] == [0 if where == "reset" else 2, 4, 4]
    for task in TASKS:
        assert DOMAIN.judge(task, found)["success"].tolist() == [False] * 3


def test_an_evaluation_goes_on_whose_first_episode_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = replace(DOMAIN, closed_loop=replace(LOOP, environment=fragile("reset", RuntimeError("broke")), steps=2))
    plans = still({}, [0], 0)[:, None].repeat(3, 32, 1)
    monkeypatch.setattr(generation, "sampled_plans", lambda *_: fixed_plans(plans.repeat(2, 1, 1)))
    task = EvaluationTask("new concept", PUSH, (PUSH,))
    judged: Any = [TaskResult(task, plans, {}, starts()), TaskResult(task, plans, {}, starts())]
    module: Any = SimpleNamespace(model=SimpleNamespace(view=None), domain=domain, composition=lambda task: task)
    broken, whole = generation.execute(module, judged, generation.Generation())
    assert broken.followed is None
    assert broken.rollout.failed.tolist() == [True, False, False]
    assert broken.values["closed loop success"] == 0
    assert whole.followed.shape == (2, 32, 4)


def episode(success: bool = True) -> Episode:
    images = np.full((TIME, *FEATURES[IMAGE].shape), 7, dtype=np.uint8)
    zeros = np.zeros((TIME, 12), np.float32)
    return Episode(zeros[:, :4], zeros[1:, :4], images, zeros[:, 4:], success)


def performed(error: BaseException) -> Callable[..., Episode]:
    """Experts of whom the second one's simulator raises an error."""
    count: list[str] = []

    def perform(*_: Any, **__: Any) -> Episode:
        count.append("")
        if len(count) == 2:
            raise error
        return episode()

    return perform


def test_a_demonstration_that_breaks_is_left_out(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(source, "perform", performed(RuntimeError("broke")))
    found = source.Expert().draw(PUSH_ON_BOOK, 2, 0)
    assert (found.provenance["tried"], found.provenance["rejected"]) == (3, 1)
    assert "episode 1: RuntimeError('broke'); it counts as rejected" in caplog.text


@pytest.mark.parametrize("error", [MemoryError(), OSError("no space")])
def test_what_the_machine_lacks_stops_everything(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    for where in ("reset", "step"):
        with pytest.raises(type(error)):
            roll_out(replace(LOOP, environment=fragile(where, error), steps=3), starts(), still)
    monkeypatch.setattr(source, "perform", performed(error))
    with pytest.raises(type(error)):
        source.Expert().draw(PUSH_ON_BOOK, 2, 0)
    assert not list(Path.cwd().rglob("*.safetensors"))  # neither here nor in the cache
    monkeypatch.setattr(source, "perform", performed(error))
    with pytest.raises(type(error)):
        POLICIES["expert (oracle)"](PUSH, starts(), None, 0)


def test_an_oracle_that_breaks_has_no_action_there_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(source, "perform", performed(RuntimeError("broke")))
    three = starts()
    policy = POLICIES["expert (oracle)"](PUSH, three, None, 0)
    assert policy is not None
    actions = policy(three.observed, [0, 1, 2], 1)
    assert actions[1].isnan().all()  # the episode counts as failed
    assert torch.equal(actions[[0, 2]], torch.zeros(2, 4))
    assert "episode 1: RuntimeError('broke'); the reference policy has no action there" in caplog.text


def test_files_of_pictures_are_a_tenth_as_large_as_the_pictures_and_the_cache_holds_them() -> None:
    drawn = source.Expert().draw(PUSH, 1, 0)
    pictures = drawn.observed[IMAGE].nbytes
    (cached,) = Path("cache").rglob("*.safetensors")
    assert cached.stat().st_size < pictures / 10
    assert source.Expert().draw(PUSH, 1, 0).hash == drawn.hash
