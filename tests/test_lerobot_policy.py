"""The example package `lerobot_policy_ftl`: LeRobot finds it, makes its policy, saves and loads it, and evaluates it.

LeRobot requires an older torch than this project's environment has, so that it has an environment of its own, which the variable
`LEROBOT_PYTHON` names: see the README of the example.
"""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from tests.conftest import CONF, ROOT, Once, environment, succeed

INTERPRETER = os.environ.get("LEROBOT_PYTHON") or (sys.executable if find_spec("lerobot") else "")
pytestmark = [
    pytest.mark.release,
    pytest.mark.skipif(not INTERPRETER, reason="LEROBOT_PYTHON names no interpreter that has LeRobot"),
    pytest.mark.skipif(not find_spec("pyarrow"), reason="the extra 'lerobot' is not installed"),
]
PLUGIN = "lerobot_policy_ftl"
STEPS = 30
QUICK = ["--evaluation.samples=2", "--evaluation.figures=0", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]

POINTS = """
import json, sys
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig


class Points(gymnasium.Env):
    '''A point, moved by its action, that has to reach one of three goals.'''

    observation_space = Dict(agent_pos=Box(-2, 2, (2,), np.float32), environment_state=Box(-2, 2, (6,), np.float32))
    action_space = Box(-0.2, 0.2, (2,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, goal=0, render_mode="rgb_array"):
        self.goal, self.render_mode = goal, render_mode

    def _seen(self):
        return {"agent_pos": self.x.astype(np.float32), "environment_state": self.goals.reshape(-1).astype(np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goals, self.x = self.np_random.uniform(-1, 1, (3, 2)), self.np_random.uniform(-1, 1, 2)
        return self._seen(), {"is_success": False}

    def step(self, action):
        self.x = self.x + np.clip(action, -0.2, 0.2)
        right = bool(np.linalg.norm(self.x - self.goals[self.goal]) < 0.1)
        return self._seen(), float(right), False, False, {"is_success": right}

    def render(self):
        return np.zeros((64, 64, 3), np.uint8)


@EnvConfig.register_subclass("points")
@dataclass
class PointsConfig(EnvConfig):
    task: str = "Points-v0"
    goal: int = 0
    features: dict = field(default_factory=lambda: {
        "action": PolicyFeature(FeatureType.ACTION, (2,)),
        "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
        "environment_state": PolicyFeature(FeatureType.ENV, (6,)),
    })
    features_map: dict = field(default_factory=lambda: {
        "action": "action", "agent_pos": "observation.state", "environment_state": "observation.environment_state",
    })

    @property
    def gym_kwargs(self):
        return {"goal": self.goal}


gymnasium.register("gym_points/Points-v0", Points, max_episode_steps=30)
"""
"""An environment as LeRobot has them: registered with Gymnasium, with a configuration that names its features."""
ASK = (
    POINTS
    + """
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class, make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

model, concept, data = sys.argv[1:]
found = {"before": "ftl" in PreTrainedConfig.get_known_choices()}
register_third_party_plugins()
found["after"] = "ftl" in PreTrainedConfig.get_known_choices()
found["class"] = get_policy_class("ftl").__name__
meta = LeRobotDatasetMetadata("of/tasks", root=data)
found["tasks"] = list(meta.tasks.index)
batch = {"observation.state": torch.tensor([[0.1, 0.2], [0.5, -0.5], [-0.9, 0.9]]), "task": ["", "", ""]}
batch["observation.environment_state"] = torch.linspace(-0.8, 0.8, 18).unflatten(0, (3, 6))
one = {key: value[:1] for key, value in batch.items()}


def asked(policy, seen=batch):
    policy.reset()
    with torch.inference_mode():
        return torch.stack([policy.select_action(seen) for _ in range(5)], dim=1)


def refused(call):
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


for name, chosen in (("learned", concept), ("training", "go to 0")):
    made = lambda: make_policy_config("ftl", model=model, concept=chosen, execute=4, steps=2, device="cpu")
    policy = make_policy(made(), ds_meta=meta)
    first = asked(policy)
    policy.save_pretrained(name)
    config = PreTrainedConfig.from_pretrained(name)
    config.pretrained_path = Path(name)
    loaded = make_policy(config, env_cfg=PointsConfig())
    before, after = make_pre_post_processors(config, pretrained_path=name)
    fresh = make_pre_post_processors(config)
    processed = before(dict(batch))
    found[name] = {
        "saved": sorted(str(path.relative_to(name)) for path in Path(name).rglob("*") if path.is_file()),
        "config": {key: getattr(config, key) for key in ("type", "model", "concept", "execute", "steps")},
        "features": [list(policy.config.input_features), list(policy.config.output_features)],
        "shapes": [list(first.shape), list(asked(policy, one).shape)],
        "finite": bool(first.isfinite().all()),
        "equal": bool((asked(loaded) == first).all()),
        "again": bool((asked(loaded) == first).all()),
        "of class": bool((asked(get_policy_class("ftl").from_pretrained(name)) == first).all()),
        "alone": not any(str(Path(model).parent) in path.read_text() for path in Path(name).rglob("*.json")),
        "unchanged": all(bool((processed[key] == batch[key]).all()) for key in batch if key != "task"),
        "actions": bool((after(first[:, 0]) == first[:, 0]).all()),
        "batched": list(before({"observation.state": torch.zeros(2)})["observation.state"].shape),
        "steps": [[type(step).__name__ for step in each.steps] == [type(step).__name__ for step in other.steps]
                  for each, other in zip(fresh, (before, after))],
    }
found["forward"] = refused(lambda: policy.forward(batch))
found["optimizer"] = refused(policy.config.get_optimizer_preset)
found["chunk"] = refused(lambda: policy.predict_action_chunk(batch))
found["nothing"] = refused(lambda: make_policy(make_policy_config("ftl", device="cpu"), env_cfg=PointsConfig()))
found["unknown"] = refused(lambda: make_policy(make_policy_config("ftl", model=model, concept="go to 9"), env_cfg=PointsConfig()))
found["blind"] = refused(lambda: policy.select_action({"task": [""]}))
print(json.dumps(found))
"""
)
EVALUATE = (
    POINTS
    + """
from lerobot.scripts.lerobot_eval import main

sys.argv = ["lerobot-eval", *sys.argv[1:]]
main()
"""
)
SAVE = """
import sys
from lerobot_policy_ftl import FtlConfig, FtlPolicy

model, concept = sys.argv[1:]
FtlPolicy(FtlConfig(model=model, concept=concept, device="cpu")).save_pretrained("saved")
"""


def shown(goal: int, count: int, seed: int) -> Demonstrations:
    """Demonstrations of an expert that goes straight to a goal, of three that are observed."""
    draw = np.random.default_rng(seed)
    goals, x = draw.uniform(-1, 1, (count, 3, 2)), draw.uniform(-1, 1, (count, 2))
    states, actions = [x], []
    for _ in range(STEPS):
        away = 0.25 * (goals[:, goal] - x)
        actions.append(away * np.minimum(1, 0.15 / np.linalg.norm(away, axis=1, keepdims=True)) + draw.normal(0, 0.003, x.shape))
        x = x + actions[-1]
        states.append(x)
    observed = np.repeat(goals.reshape(count, 1, 6), STEPS + 1, axis=1).astype(np.float32)
    return Demonstrations.of(
        list(np.stack(states, axis=1).astype(np.float32)),
        f"go to {goal}",
        actions=list(np.stack(actions, axis=1).astype(np.float32)),
        observed={"environment_state": torch.from_numpy(observed)},
        per_step=("environment_state",),
    )


@pytest.fixture(scope="module")
def learned(once: Once) -> Path:
    """Folder with data sets of LeRobot, a model of two tasks, and a concept that was learned from five episodes of a third."""

    def make(folder: Path) -> None:
        concatenate([shown(goal, 40, 1 + goal) for goal in (0, 1)]).save("lerobot:tasks")
        shown(2, 5, 3).save("lerobot:five")
        own = [f"--config={CONF / 'own.yaml'}", "--trainer.logger.save_dir=.", *QUICK]
        fit = ["--data.demonstrations=tasks", "--data.encoder=hashing", "--data.metrics={}", "--trainer.max_steps=1500"]
        succeed("fit", *own, *fit)
        succeed("invert", *own, "--data.demonstrations=five", "--model.pretrained=own/fit/pretrained")

    return once("lerobot_policy", make)


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the package is installed, for LeRobot's environment."""
    folder = tmp_path_factory.mktemp("plugin")
    source = shutil.copytree(ROOT / "examples" / PLUGIN, folder / "source", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(folder / "installed")]
    subprocess.run([INTERPRETER, "-m", "pip", "install", *options, str(source)], check=True)
    return folder / "installed"


def in_lerobot(plugin: Path, program: str, *arguments: str | Path) -> str:
    """What a program prints in LeRobot's environment, to its end."""
    known = environment(PYTHONPATH=os.pathsep.join(map(str, (plugin, ROOT))), HF_HOME=str(Path("huggingface").resolve()))
    done = subprocess.run([INTERPRETER, "-c", program, *arguments], env=known, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_lerobot_makes_saves_and_loads_a_policy_of_a_concept(learned: Path, plugin: Path) -> None:
    model, concept = learned / "own" / "fit" / "pretrained", learned / "own" / "invert" / "concepts" / "go_to_2.safetensors"
    told = in_lerobot(plugin, ASK, model, concept, learned / "tasks")
    found: dict[str, Any] = json.loads(told.splitlines()[-1])
    assert (found["before"], found["after"], found["class"]) == (False, True, "FtlPolicy")
    assert found["tasks"] == ["go to 0", "go to 1"]
    processors = ["policy_postprocessor.json", "policy_preprocessor.json"]
    of_model = ["model/README.md", "model/config.json", "model/demonstrations.safetensors", "model/model.safetensors"]
    for name, kept in (("learned", "concept.safetensors"), ("training", "go to 0")):
        of = found[name]
        assert of["config"] == {"type": "ftl", "model": "model", "concept": kept, "execute": 4, "steps": 2}
        assert of["saved"] == sorted({"config.json", *of_model, *processors} | ({kept} if name == "learned" else set()))
        assert of["features"] == [["observation.state", "observation.environment_state"], ["action"]]
        assert of["shapes"] == [[3, 5, 2], [1, 5, 2]]
        assert of["batched"] == [1, 2]
        assert all(of[key] for key in ("finite", "equal", "of class", "alone", "unchanged", "actions"))
        assert of["steps"] == [True, True]
        assert not of["again"], "each reset draws new noise"
    for key in ("forward", "optimizer"):
        assert found[key].startswith("NotImplementedError: ftl: nothing is trained here")
    assert found["chunk"].startswith("NotImplementedError: ftl: an action depends on the state")
    assert found["nothing"] == "ValueError: policy.model: expected the folder of a pretrained model, found none"
    assert found["unknown"].startswith("UserError: concept 'go to 9': expected a training concept of the model: go to ")
    assert found["blind"].startswith("UserError: observation: expected 'environment_state' of shape (6,)")


@pytest.mark.parametrize("goal", [0, 2])
def test_lerobot_eval_runs_a_policy(learned: Path, plugin: Path, goal: int, tmp_path: Path) -> None:
    """The program finds the package: a training concept by the model and its text, a new one by the folder of a saved policy."""
    model = learned / "own" / "fit" / "pretrained"
    options = ["--policy.type=ftl", f"--policy.model={model}", f"--policy.concept=go to {goal}"]
    if goal == 2:
        in_lerobot(plugin, SAVE, model, learned / "own" / "invert" / "concepts" / "go_to_2.safetensors")
        options = ["--policy.path=saved"]
    options += ["--policy.device=cpu", "--env.type=points", f"--env.goal={goal}", "--seed=100000"]
    options += ["--eval.n_episodes=10", "--eval.batch_size=5", f"--output_dir={tmp_path / 'out'}"]
    in_lerobot(plugin, EVALUATE, *options)
    overall = json.loads((tmp_path / "out" / "eval_info.json").read_text("utf-8"))["overall"]
    assert overall["n_episodes"] == 10
    assert overall["pc_success"] >= 50
