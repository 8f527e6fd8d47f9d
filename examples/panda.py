"""A robot arm of panda-gym: four tasks are pretrained, a fifth is learned from five demonstrations and executed.

pip install panda-gym
python examples/panda.py
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import panda_gym  # noqa: F401  registers the environments

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations, concatenate

TASKS = {  # whether the cube is carried; the target: shares of the cube's first place and of the goal, and the height above
    "hover over the cube": (False, 1, 0, 0.1),
    "hover over the goal": (False, 0, 1, 0.1),
    "lift the cube": (True, 1, 0, 0.15),
    "carry the cube to the goal": (True, 0, 1, 0),
}
NEW = {"hover between cube and goal": (False, 0.5, 0.5, 0.1), "carry the cube over the goal": (True, 0, 1, 0.12)}
STEPS, NEAR = 40, 0.04


class Arm(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An arm whose state is the hand, the width of its gripper and the cube; ``info`` says whether it is at the task's target."""

    def __init__(self, task: tuple[bool, float, float, float]) -> None:
        super().__init__(gymnasium.make("PandaPickAndPlace-v3", render_mode="rgb_array", max_episode_steps=STEPS))
        self.carries, *self.task = task

    def _seen(self, observation: dict[str, Any]) -> dict[str, Any]:
        hand, self.cube, self.goal = observation["observation"], observation["achieved_goal"], observation["desired_goal"]
        self.hand, self.width = hand[:3], hand[6]
        return {"state": np.array([*self.hand, self.width, *self.cube], np.float32), "goal": self.goal.astype(np.float32)}

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        seen = self._seen(self.env.reset(**options)[0])
        self.target = self.task[0] * self.cube + self.task[1] * self.goal + np.array([0, 0, self.task[2]])
        return seen, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, truncated, _ = self.env.step(action)
        seen = self._seen(observation)
        right = bool(np.linalg.norm((self.cube if self.carries else self.hand) - self.target) < NEAR)
        return seen, reward, False, truncated, {"is_success": right}

    def expert(self) -> Any:
        """Action ``(4,)``: displacement of the hand, and the gripper (1 open, -1 closed)."""
        away = self.cube - self.hand
        if not self.carries:
            return np.array([*np.clip(5 * (self.target - self.hand), -1, 1), 1])
        if np.linalg.norm(away) < 0.025 and self.width < 0.055:
            return np.array([*np.clip(5 * (self.target - self.cube), -1, 1), -1])
        if np.linalg.norm(away) < 0.015:
            return np.array([0, 0, 0, -1])
        above = np.array([0, 0, 0 if np.linalg.norm(away[:2]) < 0.02 else 0.08])
        return np.array([*np.clip(8 * (away + above), -1, 1), 1])


def shown(text: str, task: Any, count: int, seed: int) -> Demonstrations:
    """Demonstrations of the expert, whose hand trembles."""
    arm, rng, paths, acts, goals = Arm(task), np.random.default_rng(seed), [], [], []
    for episode in range(count):
        observation, path, done, ended = arm.reset(seed=1000 * seed + episode)[0], [], [], False
        goals.append(observation["goal"])
        while not ended:
            path.append(observation["state"])
            done.append(np.clip(arm.expert() + rng.normal(size=4) * (0.1, 0.1, 0.1, 0.02), -1, 1).astype(np.float32))
            observation, _, _, ended, _ = arm.step(done[-1])
        paths.append(np.array([*path, observation["state"]]))
        acts.append(np.array(done))
    arm.close()
    return Demonstrations.of(paths, text, actions=acts, observed={"goal": np.array(goals)})


def pretrained(folder: Path = Path("logs/panda")) -> FewShot:
    """The model of all tasks, pretrained unless it is there."""
    if not (folder / "fit" / "pretrained").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        parts = [shown(text, task, 60, 10 + row) for row, (text, task) in enumerate(TASKS.items())]
        concatenate(parts).save(folder / "tasks.npz")
        options = [f"--data.demonstrations={folder / 'tasks.npz'}", "--data.encoder=hashing", "--data.metrics={}"]
        logged = [f"--trainer.logger.save_dir={folder.parent}", f"--trainer.logger.name={folder.name}"]
        subprocess.run([sys.executable, "-m", "ftl_lightning", "fit", "--config=conf/own.yaml", *options, *logged], check=True)
    return FewShot.from_pretrained(folder / "fit" / "pretrained")


if __name__ == "__main__":
    model = pretrained()
    for text, task in NEW.items():
        policy = model.policy(model.learn(shown(text, task, 5, 500), name=text))
        episodes = model.rollout(policy, lambda task=task: Arm(task), episodes=50)
        episodes.save(f"{text.replace(' ', '_')}.gif")
        print(policy, episodes)
