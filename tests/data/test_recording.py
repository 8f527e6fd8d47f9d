"""Episodes of Gymnasium environments, recorded and read back."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT, succeed

gymnasium = pytest.importorskip("gymnasium", reason="no extra with gymnasium is installed")

from ftl_lightning.data.recording import Recorder  # noqa: E402

Box = gymnasium.spaces.Box
PLACE = Box(-np.inf, np.inf, (2,), np.float64)


class Point(gymnasium.Env[Any, Any]):  # type: ignore[misc,name-defined]
    """A point that goes where it is pushed, until it is beyond 3."""

    observation_space = PLACE
    action_space = PLACE

    def __init__(self) -> None:
        self.place = np.zeros(2)

    def seen(self) -> Any:
        return self.place  # the same array each time, as some environments do

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place[:] = 0
        return self.seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place += action
        return self.seen(), 0.0, bool(self.place[0] >= 3), False, {}


class Seeing(Point):
    """The same with a target and a picture."""

    observation_space = gymnasium.spaces.Dict({"observation": PLACE, "target": PLACE, "picture": Box(0, 255, (4, 5, 3), np.uint8)})

    def seen(self) -> Any:
        picture = np.zeros((4, 5, 3), np.uint8)
        picture[0, 1, 2] = 9
        return {"observation": self.place, "target": self.place + 10, "picture": picture}


def run(env: Any, steps: int) -> None:
    env.reset(seed=0)
    for _ in range(steps):
        env.step([1.0, 0.5])


def test_vectors_are_recorded_without_arguments() -> None:
    env = Recorder(Point())
    run(env, 5)  # two steps after its end
    run(env, 3)
    found = env.demonstrations()
    assert found.states.tolist() == [[[0, 0], [1, 0.5], [2, 1], [3, 1.5]]] * 2
    assert (found.concepts, found.observed, found.state_names) == (("", ""), {}, ("0", "1"))
    assert found.provenance["environment"] == str(env.env)


def test_episodes_that_were_reset_early_are_dropped_unless_they_are_asked_for() -> None:
    for keep, lengths in ((False, [4]), (True, [3, 4, 2])):
        env = Recorder(Point(), keep_unfinished=keep)
        for steps in (2, 3, 0, 1):  # one without a step is no demonstration
            run(env, steps)
        assert env.demonstrations().lengths.tolist() == lengths
        assert env.demonstrations().lengths.tolist() == lengths, "asking changes nothing"
        assert env.dropped == (2 if not keep else 1)
    empty = Recorder(Point())
    run(empty, 2)
    with pytest.raises(UserError, match="expected an episode that ended, found none, and 1 that did not; step the environment to"):
        empty.demonstrations()


def test_texts_names_and_features_are_those_that_are_asked_for() -> None:
    names = {"state_names": ("x", "y"), "state_units": ("m", "m"), "domain": "points"}
    env = Recorder(Seeing(), observed=["target", "picture"], concept="go right", **names)
    run(env, 3)
    env.concept = "go far right"
    run(env, 3)
    found = env.demonstrations()
    assert found.concepts == ("go right", "go far right")
    assert (found.domain, found.state_names, found.state_units) == ("points", ("x", "y"), ("m", "m"))
    assert found.per_step == ("target", "picture")
    assert found.observed["target"][0, :, 0].tolist() == [10, 11, 12, 13]
    assert found.observed["picture"].shape == (2, 4, 3, 4, 5)
    assert found.observed["picture"][0, 0, 2, 0, 1] == 9
    env = Recorder(Seeing(), state="target", observed={"x": lambda seen: seen["observation"][0], "here": "observation"})
    run(env, 3)
    found = env.demonstrations()
    assert found.states[0, :, 0].tolist() == [10, 11, 12, 13]
    assert found.observed["x"].tolist() == [[[0], [1], [2], [3]]]
    assert found.observed["here"].shape == (1, 4, 2)


def test_parts_that_are_not_there_are_told() -> None:
    with pytest.raises(UserError, match="the key of the states, one of observation, target, found 'speed'"):
        Recorder(Seeing(), state="speed")
    with pytest.raises(UserError, match="observed: expected some of observation, picture, target, found 'speed'"):
        Recorder(Seeing(), observed=["speed"])
    with pytest.raises(UserError, match="observed: expected some of none, found 'target'"):
        Recorder(Point(), observed=["target"])
    with pytest.raises(UserError, match=r"state: expected shape \(1,\), as in the first observation, found \(2,\)"):
        run(Recorder(Point(), state=lambda seen: seen[: 1 + int(seen[0] > 0)]), 2)


@pytest.mark.parametrize("name", ["robot.safetensors", "robot.npz", "lerobot:robot", "minari:point/robot-v0"])
def test_what_was_recorded_is_saved_in_every_format(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if ":" in name:
        pytest.importorskip({"lerobot": "pyarrow", "minari": "minari"}[name.partition(":")[0]])
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    env = Recorder(Seeing(), observed=["target", "picture"], concept="go right", keep_unfinished=True)
    run(env, 3)
    run(env, 2)
    env.save(name)
    found, recorded = Demonstrations.load(name), env.demonstrations()
    assert found.hash == recorded.hash
    assert (found.concepts, found.per_step) == (recorded.concepts, recorded.per_step)


def test_the_example_of_the_page_runs() -> None:
    page = (ROOT / "docs" / "own-data.md").read_text("utf-8")
    (example,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Recorder" in block]
    exec(compile(example, "own-data.md", "exec"), {})
    found = Demonstrations.load("swing.npz")
    assert found.states.shape == (3, 201, 3)
    assert set(found.concepts) == {"swing"}


def test_navigation_is_recorded(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pybullet", reason="the extra 'navigation' is not installed")
    from ftl_lightning.domains.agent.environment import AgentEnvironment
    from ftl_lightning.domains.agent.scenes import STATE
    from ftl_lightning.domains.from_file import read_demonstrations
    from ftl_lightning.domains.registry import load_domain

    domain = load_domain("agent")
    (feature,) = domain.observed
    names = {"concept": "go straight on", "state_names": domain.plans.columns, "domain": "agent"}
    env = Recorder(AgentEnvironment(), state=lambda seen: seen[feature][:STATE], observed=[feature], keep_unfinished=True, **names)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(12):
            env.step(np.array([0.0, 1.0], np.float32))
    env.save("agent.safetensors")
    found = read_demonstrations("agent.safetensors", domain)
    assert found.states.shape == (3, 13, STATE)
    assert (found.states == found.observed[feature][..., :STATE]).all()
    assert found.states[0, -1, 2] > found.states[0, 0, 2]
    succeed("check", "agent.safetensors")
    assert "go straight on: 3 demonstrations of 13 steps" in capsys.readouterr().out
