"""Policies of a user's data: observations, actions, and episodes in an environment of one's own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning import FewShot
from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from tests.conftest import CONF, Once, succeed

STEPS, NEAR = 30, 0.1


class Goals(gymnasium.Env[Any, Any]):
    """A point, moved by its action, that has to reach one of three goals, or the middle of two."""

    observation_space = Dict(state=Box(-2, 2, (2,), np.float32), goals=Box(-2, 2, (6,), np.float32))
    action_space = Box(-0.2, 0.2, (2,), np.float32)

    def __init__(self, task: int | str = 0, render_mode: str | None = None) -> None:
        self.task, self.render_mode = task, render_mode

    def _seen(self) -> dict[str, Any]:
        return {"state": self.x.astype(np.float32), "goals": self.goals.reshape(-1).astype(np.float32)}

    @property
    def target(self) -> Any:
        return (self.goals[0] + self.goals[1]) / 2 if self.task == "middle" else self.goals[int(self.task)]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.goals, self.x, self.time = self.np_random.uniform(-1, 1, (3, 2)), self.np_random.uniform(-1, 1, 2), 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.time = self.x + np.clip(action, -0.2, 0.2), self.time + 1
        right = bool(np.linalg.norm(self.x - self.target) < NEAR)
        return self._seen(), float(right), False, self.time == STEPS, {"is_success": right, "distance": 0.0}

    def render(self) -> Any:
        picture = np.full((32, 32, 3), 255, np.uint8)
        row, column = ((self.x.clip(-1.4, 1.4) + 1.5) * 10).astype(int)
        picture[row, column] = 0
        return picture


def shown(task: int | str, count: int, seed: int, flat: bool = False) -> Demonstrations:
    """Demonstrations of an expert that goes straight to its target."""
    rng, paths, done, seen = np.random.default_rng(seed), [], [], []
    env = Goals(task)
    for episode in range(count):
        observation, _ = env.reset(seed=1000 * seed + episode)
        path, acts = [observation["state"]], []
        for _ in range(STEPS):
            away = 0.25 * (env.target - env.x)
            acts.append((away * min(1, 0.15 / np.linalg.norm(away)) + rng.normal(0, 0.003, 2)).astype(np.float32))
            path.append(env.step(acts[-1])[0]["state"])
        goals = np.repeat(observation["goals"][None], len(path), axis=0)
        paths.append(np.concatenate((path, goals), axis=1) if flat else np.array(path))
        done.append(np.array(acts))
        seen.append(goals)
    features = {} if flat else {"observed": {"goals": torch.tensor(np.array(seen))}, "per_step": ("goals",)}
    return Demonstrations.of(paths, f"go to {task}", actions=done, **features)


def trained(once: Once, name: str, steps: int, flat: bool = False) -> FewShot:
    def fit(folder: Path) -> None:
        from ftl_lightning.data.demonstrations import concatenate

        concatenate([shown(task, 40, 1 + task, flat) for task in (0, 1)]).save("goals.npz")
        options = ["--data.encoder=hashing", "--data.metrics={}", "--trainer.logger.save_dir=.", f"--trainer.max_steps={steps}"]
        succeed("fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=goals.npz", *options)

    return FewShot.from_pretrained(once(name, fit) / "own" / "fit" / "pretrained")


@pytest.fixture(scope="module")
def quick(once: Once) -> FewShot:
    return trained(once, "goals_quick", 20)


def test_a_policy_acts_for_an_environment_or_a_batch(quick: FewShot) -> None:
    env = Goals()
    policy = quick.policy(quick["go to 0"], execute=8)
    assert policy.plan is None
    first = [env.reset(seed=seed)[0] for seed in (0, 1)]
    policy.reset(seed=3)
    action = policy.act(first[0])
    assert action.shape == (2,)
    plan = policy.plan
    assert plan is not None
    assert plan.shape == (STEPS + 1, 4)
    assert plan[0, :2].tolist() == pytest.approx(first[0]["state"].tolist(), abs=1e-5)
    policy.reset(seed=3)
    assert (policy.act(first[0]) == action).all()
    policy.reset(seed=4)
    assert (policy.act(first[0]) != action).any()
    policy.reset(seed=3)
    both = policy.act({name: np.stack([seen[name] for seen in first]) for name in first[0]})
    assert both.shape == (2, 2)
    assert both[0] == pytest.approx(action, abs=1e-4)
    with pytest.raises(UserError, match="act: expected a batch of 2, found 1"):
        policy.act(first[0])


@pytest.mark.parametrize("name", ["observation", "agent_pos", "position"])
def test_the_present_state_has_one_of_several_names(quick: FewShot, name: str) -> None:
    seen = Goals().reset(seed=0)[0]
    policy = quick.policy(quick["go to 0"])
    expected = policy.act(seen)
    policy.reset()
    assert (policy.act({name: seen["state"], "goals": seen["goals"]}) == expected).all()
    policy.reset()
    assert (policy.act(np.concatenate((seen["state"], seen["goals"]))) == expected).all()
    observed = quick.policy(quick["go to 0"], observe=lambda pair: {"state": pair[0], "goals": pair[1]})
    assert (observed.act((seen["state"], seen["goals"])) == expected).all()


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        ({"goals": np.zeros(6)}, r"the present state \(key 'state'\) of shape \(2,\)"),
        ({"state": np.zeros(2)}, r"'goals' of shape \(6,\)"),
        (np.zeros(7), r"a vector of 6 \(goals\) \+ 2 \(state\) numbers|a vector of 2 \(state\) \+ 6 \(goals\) numbers"),
        ({"state": np.array([np.nan, 0]), "goals": np.zeros(6)}, "expected finite numbers"),
        ({"state": np.zeros(2), "goals": np.zeros((2, 6))}, "a batch of every feature, or of none"),
        ("left", "expected numbers"),
    ],
)
def test_other_observations_are_refused(quick: FewShot, observation: Any, expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        quick.policy(quick["go to 0"]).act(observation)


def test_a_controller_of_the_user_gets_present_and_next_planned_state(quick: FewShot) -> None:
    seen, calls = Goals().reset(seed=0)[0], []

    def control(present: Any, following: Any) -> Any:
        calls.append((present, following))
        return following - present

    policy = quick.policy(quick["go to 0"], act=control)
    action = policy.act(seen)
    assert "given controller" in str(policy)
    assert policy.plan is not None
    assert action == pytest.approx((policy.plan[1, :2] - policy.plan[0, :2]).numpy(), abs=1e-5)
    assert calls[0][0].shape == (1, 2)


@pytest.mark.slow
def test_demonstrations_are_moved_to_the_places_of_the_model(quick: FewShot) -> None:
    concept = quick.learn(shown(2, 5, 50), name="new", form="shifted demonstration")
    assert concept.concept.reference is not None
    assert concept.concept.reference.setting.places == quick.model.places  # the few examples alone show fewer
    assert len(quick.model.places) == 3


def test_plans_are_made_every_so_many_steps(quick: FewShot) -> None:
    env, made = Goals(), []
    policy = quick.policy(quick["go to 0"], execute=5)
    observation, _ = env.reset(seed=0)
    for _ in range(12):
        observation, *_ = env.step(policy.act(observation))
        made.append(policy.plan)
    changes = [step for step in range(1, 12) if not torch.equal(made[step], made[step - 1])]
    assert changes == [5, 10]


@pytest.mark.parametrize(
    ("success", "expected"),
    [("info.is_success", None), (None, None), (lambda info: True, 1.0), ("info.distance", 0.0)],
)
def test_success_is_read_where_it_is_named(quick: FewShot, success: Any, expected: float | None) -> None:
    episodes = quick.rollout(quick.policy(quick["go to 0"]), Goals, episodes=3, success=success)
    assert len(episodes) == 3
    assert episodes.lengths == (STEPS,) * 3
    assert episodes.success == (np.mean([info["is_success"] for info in episodes.infos]) if expected is None else expected)
    low, high = episodes.interval
    assert 0 <= low <= episodes.success <= high <= 1
    assert episodes.latency[0] > 0


def test_rollouts_that_cannot_be_are_refused(quick: FewShot) -> None:
    policy = quick.policy(quick["go to 0"])
    with pytest.raises(UserError, match=r"success: expected 'info.KEY' with one of is_success, distance, found 'info.won'"):
        quick.rollout(policy, Goals, episodes=1, success="info.won")
    with pytest.raises(UserError, match="environment: expected the name of a Gymnasium environment"):
        quick.rollout(policy, "NoSuchEnvironment-v0")
    with pytest.raises(UserError, match="policy: expected a policy"):
        quick.rollout(quick["go to 0"], Goals)  # type: ignore[arg-type]


def test_the_first_episode_is_filmed_if_the_environment_renders(quick: FewShot, tmp_path: Path) -> None:
    policy = quick.policy(quick["go to 0"])
    episodes = quick.rollout(policy, lambda: Goals(render_mode="rgb_array"), episodes=2)
    assert len(episodes.frames) == STEPS + 1
    episodes.save(tmp_path / "film.gif")
    assert (tmp_path / "film.gif").stat().st_size > 100
    with pytest.raises(UserError, match="render_mode"):
        quick.rollout(policy, Goals, episodes=1).save(tmp_path / "none.gif")


def test_an_environment_that_breaks_loses_its_episode(quick: FewShot) -> None:
    class Breaking(Goals):
        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            if self.time == 3 and self.x[0] > 0:
                raise RuntimeError("broken")
            return super().step(action)

    episodes = quick.rollout(quick.policy(quick["go to 0"]), Breaking, episodes=8, success=lambda info: True)
    assert 0 < sum(episodes.failed) < 8
    assert episodes.successes == tuple(not lost for lost in episodes.failed)


def test_policies_of_domains_with_an_environment_use_its_planner() -> None:
    model = FewShot.from_pretrained("driving")
    policy = model.policy(model[model.training_concepts[0]], execute=1)
    assert "the domain's planner" in str(policy)
    starts = model.starts(model.training_concepts[0], 1)
    action = policy.act({name: values[0].numpy() for name, values in starts.observed.items()})
    assert np.isfinite(action).all()
    with pytest.raises(UserError, match="act: expected none"):
        model.policy(model[model.training_concepts[0]], act=lambda present, following: present)


MODULE = """
from tests.evaluation.test_policy import Goals

def make(goal):
    return Goals(int(goal.split()[-1]))

def broken():
    return 3
"""


@pytest.mark.slow
def test_policies_act_in_an_environment_that_the_command_line_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_goals.py").write_text(MODULE)
    from ftl_lightning.data.demonstrations import concatenate

    concatenate([shown(task, 6, 1 + task) for task in (0, 1)]).save("goals.npz")
    shown(2, 3, 9).save("three.npz")
    few = ["--trainer.logger.save_dir=.", "--evaluation.figures=0", "--evaluation.samples=3"]
    place = ["--evaluation.environment=my_goals:make", "--evaluation.success=info.is_success"]
    fit = [f"--config={CONF / 'own.yaml'}", "--data.demonstrations=goals.npz", "--data.encoder=hashing", "--data.metrics={}"]
    succeed("fit", *fit, *few, *place, "--evaluation.fit_episodes=2", "--trainer.max_steps=20", "--data.steps_per_epoch=10")
    names = EventAccumulator("own/fit").Reload().Tags()["scalars"]
    assert {"closed loop success/training concept", "closed loop return/training concept"} <= set(names)
    invert = ["--data.demonstrations=three.npz", "--model.pretrained=own/fit/pretrained", "--data.steps=5", "--model.form=paper"]
    succeed("invert", f"--config={CONF / 'own.yaml'}", *invert, *few, *place)
    rows = {row.metric: row for row in read_rows("own/invert/results.csv").itertuples()}
    assert rows["closed loop success"].task == "go to 2"
    assert rows["closed loop success"].n == 3
    assert rows["closed loop return"].value >= 0
    Path("place.yaml").write_text("evaluation: {environment: 'my_goals:make'}")
    for wrong, expected in (
        (["--config=place.yaml"], "evaluation.environment: expected a function that the command line names"),
        (["--evaluation.environment=my_goals:other"], "evaluation.environment: expected 'package.module:function'"),
        (["--evaluation.environment=my_goals:broken"], "environment: expected a Gymnasium environment, found 3"),
        (["--evaluation.environment=No-v0"], "environment: expected the name of a Gymnasium environment"),
        ([*place[:1], "--evaluation.success=info.won"], "success: expected 'info.KEY' with one of is_success, distance"),
    ):
        assert main(["invert", f"--config={CONF / 'own.yaml'}", *invert, *few, *wrong]) == 2
        assert expected in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("flat", [False, True])
def test_a_new_goal_is_reached_from_five_demonstrations(once: Once, flat: bool) -> None:
    model = trained(once, f"goals_{flat}", 600, flat)

    class Flat(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
        observation_space = Box(-2, 2, (8,), np.float32)

        def observation(self, observation: Any) -> Any:
            return np.concatenate((observation["state"], observation["goals"]))

    for task in (2, "middle"):
        make: Callable[[], Any] = (lambda task=task: Flat(Goals(task))) if flat else (lambda task=task: Goals(task))  # type: ignore[misc]
        concept = model.learn(shown(task, 5, 50, flat), name="new")
        episodes = model.rollout(model.policy(concept), make, episodes=30)
        assert episodes.success >= 0.9, (task, episodes)


class Thing(gymnasium.Env[Any, Any]):
    """A hand and a thing, whose position is part of the state: the hand has to go to a target, or to carry the thing there."""

    observation_space = Dict(state=Box(-3, 3, (4,), np.float32), goal=Box(-3, 3, (2,), np.float32))
    action_space = Box(-0.2, 0.2, (2,), np.float32)

    def __init__(self, task: tuple[bool, float, float, float]) -> None:
        # Whether the thing is carried; shares of its first place and of the goal in the target, and the height above them.
        self.carries, *self.task = task

    @property
    def target(self) -> Any:
        return self.task[0] * self.begin + self.task[1] * self.goal + np.array([0, self.task[2]])

    def _seen(self) -> dict[str, Any]:
        return {"state": np.concatenate((self.hand, self.thing)).astype(np.float32), "goal": self.goal.astype(np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.hand, self.held, self.time = self.np_random.uniform(-0.1, 0.1, 2), False, 0
        self.begin, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.thing = self.begin.copy()
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.hand, self.time = self.hand + np.clip(action, -0.2, 0.2), self.time + 1
        self.held = self.carries and (self.held or bool(np.linalg.norm(self.hand - self.thing) < NEAR))
        self.thing = self.hand.copy() if self.held else self.thing
        right = bool(np.linalg.norm((self.thing if self.carries else self.hand) - self.target) < NEAR)
        return self._seen(), 0.0, False, self.time == STEPS, {"is_success": right}

    def demonstrations(self, text: str, count: int, seed: int) -> Demonstrations:
        rng, paths, done, goals = np.random.default_rng(seed), [], [], []
        for episode in range(count):
            observation, path, acts = self.reset(seed=1000 * seed + episode)[0], [], []
            for _ in range(STEPS):
                path.append(observation["state"])
                away = 0.5 * ((self.target if self.held or not self.carries else self.thing) - self.hand)
                acts.append((away * min(1, 0.18 / np.linalg.norm(away)) + rng.normal(0, 0.003, 2)).astype(np.float32))
                observation, *_ = self.step(acts[-1])
            paths.append(np.array([*path, observation["state"]]))
            done.append(np.array(acts))
            goals.append(self.goal.astype(np.float32))
        return Demonstrations.of(paths, text, actions=done, observed={"goal": torch.tensor(np.array(goals))})


@pytest.mark.slow
def test_a_hand_goes_to_a_thing_that_is_part_of_the_state(once: Once) -> None:
    def fit(folder: Path) -> None:
        from ftl_lightning.data.demonstrations import concatenate

        tasks = {"above the thing": (False, 1, 0, 0.2), "above the goal": (False, 0, 1, 0.2), "carry it": (True, 0, 1, 0)}
        parts = [Thing(task).demonstrations(text, 40, len(text)) for text, task in tasks.items()]
        concatenate(parts).save("things.npz")
        options = ["--data.encoder=hashing", "--data.metrics={}", "--trainer.logger.save_dir=.", "--trainer.max_steps=600"]
        succeed("fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=things.npz", *options)

    model = FewShot.from_pretrained(once("things", fit) / "own" / "fit" / "pretrained")
    assert model.model.config.places == {
        "goal": (0, 1),
        "goal at 2": (2, 3),
        "initial state[2:4] at 0": (0, 1),
        "initial state[2:4] at 2": (2, 3),
        "initial state[0:2] at 0": (0, 1),
    }
    task = False, 0.5, 0.5, 0.0
    concept = model.learn(Thing(task).demonstrations("to the middle", 5, 70), name="go to the middle")
    episodes = model.rollout(model.policy(concept), lambda: Thing(task), episodes=30)
    assert episodes.success >= 0.9, episodes


def test_actions_of_a_discrete_space_are_rounded(quick: FewShot, monkeypatch: pytest.MonkeyPatch) -> None:
    class Two(Goals):
        action_space = gymnasium.spaces.Discrete(2)  # type: ignore[assignment]
        taken: list[Any] = []  # noqa: RUF012

        def step(self, action: Any) -> Any:
            assert self.action_space.contains(action)
            self.taken.append(action)
            return super().step([0.1, 0.1])

    with pytest.raises(UserError, match=r"act: expected actions of shape \(1,\), found \(2,\)"):
        quick.rollout(quick.policy(quick["go to 0"]), Two, episodes=2)
    monkeypatch.setattr(Goals, "action_space", gymnasium.spaces.MultiBinary(2))
    with pytest.raises(UserError, match="environment: expected a Box or Discrete action space, found 'MultiBinary'"):
        quick.rollout(quick.policy(quick["go to 0"]), Goals, episodes=2)
    one = quick.policy(quick["go to 0"], act=lambda present, following: present[:, :1])
    assert not any(quick.rollout(one, Two, episodes=2).failed)
    assert set(Two.taken) == {0, 1}


class Cart(gymnasium.Env[Any, Any]):
    """A cart that is pushed and does not show its velocity; it is to stand at a place."""

    observation_space, action_space = Box(-9, 9, (1,), np.float32), Box(-1, 1, (1,), np.float32)

    def __init__(self, place: float) -> None:
        self.place = place

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.speed, self.time = self.np_random.uniform(-1, 1), self.np_random.uniform(-0.3, 0.3), 0
        return np.array([self.x], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.speed += 0.1 * float(np.clip(action[0], -1, 1))
        self.x, self.time = self.x + self.speed, self.time + 1
        right = abs(self.x - self.place) < 0.15 and abs(self.speed) < 0.1
        return np.array([self.x], np.float32), 0.0, False, self.time == 80, {"is_success": right}

    def demonstrations(self, count: int, seed: int) -> Demonstrations:
        rng, paths, done = np.random.default_rng(seed), [], []
        for episode in range(count):
            observation, path, acts = self.reset(seed=1000 * seed + episode)[0], [], []
            for _ in range(80):
                path.append(observation)
                push = -1.5 * (self.x - self.place) - 4 * self.speed + rng.normal(0, 0.1)
                acts.append(np.clip([push], -1, 1).astype(np.float32))
                observation, *_ = self.step(acts[-1])
            paths.append(np.array([*path, observation]))
            done.append(np.array(acts))
        return Demonstrations.of(paths, f"stand at {self.place}", actions=done)


@pytest.mark.slow
def test_a_history_shows_a_velocity_that_is_not_observed(once: Once) -> None:
    def fit(folder: Path) -> None:
        from ftl_lightning.data.demonstrations import concatenate

        concatenate([Cart(place).demonstrations(40, 1 + row) for row, place in enumerate((-1.0, 0.0, 1.0))]).save("carts.npz")
        options = ["--data.encoder=hashing", "--data.metrics={}", "--trainer.logger.save_dir=.", "--trainer.max_steps=1500"]
        options += ["--data.demonstrations=carts.npz", "--data.history=2", "--data.horizon=16"]
        succeed("fit", f"--config={CONF / 'own.yaml'}", *options)

    model = FewShot.from_pretrained(once("carts", fit) / "own" / "fit" / "pretrained")
    assert model.domain.observed["present state"].shape == (2,)
    policy = model.policy(model.learn(Cart(0.5).demonstrations(5, 60), name="stand at 0.5"), execute=4)
    episodes = model.rollout(policy, lambda: Cart(0.5), episodes=30)
    assert episodes.success >= 0.9, episodes


@pytest.mark.slow
def test_pendulums_are_swung_by_windows_from_the_present_state(once: Once) -> None:
    def swings(amplitude: float, count: int, seed: int) -> Demonstrations:
        env, paths, done = gymnasium.make("Pendulum-v1", max_episode_steps=100), [], []
        for episode in range(count):
            observation, _ = env.reset(seed=1000 * seed + episode)
            path, acts = [observation], []
            for _ in range(100):
                energy = observation[2] ** 2 / 6 + 5 * (1 + observation[0])
                push = 3 * (5 * (1 - np.cos(amplitude)) - energy) * np.sign(observation[2] if abs(observation[2]) > 0.05 else 1)
                acts.append(np.clip([push], -2, 2).astype(np.float32))
                observation, *_ = env.step(acts[-1])
                path.append(observation)
            paths.append(np.array(path))
            done.append(np.array(acts))
        return Demonstrations.of(paths, f"swing by {amplitude}", actions=done)

    def fit(folder: Path) -> None:
        from ftl_lightning.data.demonstrations import concatenate

        concatenate([swings(amplitude, 40, number) for number, amplitude in enumerate((0.6, 1.0, 1.8))]).save("swings.npz")
        options = ["--data.encoder=hashing", "--data.metrics={}", "--trainer.logger.save_dir=.", "--trainer.max_steps=1000"]
        succeed("fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=swings.npz", *options)

    class Swung(gymnasium.Wrapper):  # type: ignore[type-arg]
        def step(self, action: Any) -> Any:
            observation, *rest, _ = super().step(action)
            self.angles = [*getattr(self, "angles", []), abs(np.arctan2(-observation[1], -observation[0]))][-50:]
            return observation, *rest, {"is_success": abs(max(self.angles) - 1.4) < 0.2}

    model = FewShot.from_pretrained(once("swings", fit) / "own" / "fit" / "pretrained")
    assert model.model.horizon == 32  # actions follow the present state
    concept = model.learn(swings(1.4, 5, 60), name="swing by 1.4")
    episodes = model.rollout(model.policy(concept), lambda: Swung(gymnasium.make("Pendulum-v1", max_episode_steps=100)), 30)
    assert episodes.success >= 0.8, episodes
