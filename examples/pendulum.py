"""Gymnasium's pendulum: three amplitudes of swinging are pretrained, a fourth is learned from five demonstrations and executed.

python examples/pendulum.py
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations, concatenate

STEPS = 120


class Swing(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A pendulum; ``info`` says whether the largest angle of the last 60 steps is within 0.2 of the ``amplitude`` in radians."""

    def __init__(self, amplitude: float) -> None:
        super().__init__(gymnasium.make("Pendulum-v1", render_mode="rgb_array", max_episode_steps=STEPS))
        self.amplitude, self.angles = amplitude, [0.0]

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.seen, reward, _, truncated, _ = self.env.step(action)
        self.angles = [*self.angles, abs(float(np.arctan2(self.seen[1], -self.seen[0])))][-60:]
        return self.seen, reward, False, truncated, {"is_success": abs(max(self.angles) - self.amplitude) < 0.2}

    def demonstrations(self, count: int, seed: int) -> Demonstrations:
        """Demonstrations of an expert that pumps energy until the amplitude is reached."""
        paths, acts = [], []
        for episode in range(count):
            seen, path, done = self.reset(seed=1000 * seed + episode)[0], [], []
            for _ in range(STEPS):
                path.append(seen)
                missing = 5 * (1 - np.cos(self.amplitude)) - (seen[2] ** 2 / 6 + 5 * (1 + seen[0]))
                done.append(np.clip([3 * missing * (1 if abs(seen[2]) < 0.05 else np.sign(seen[2]))], -2, 2))
                seen = self.step(done[-1])[0]
            paths.append(np.array([*path, seen]))
            acts.append(np.array(done, np.float32))
        return Demonstrations.of(paths, f"swing by {self.amplitude}", actions=acts)


if __name__ == "__main__":
    folder = Path("logs/pendulum")
    if not (folder / "fit" / "pretrained").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        concatenate([Swing(size).demonstrations(60, row) for row, size in enumerate((0.6, 1.0, 1.8))]).save(folder / "swings.npz")
        options = [f"--data.demonstrations={folder / 'swings.npz'}", "--data.encoder=hashing", "--data.metrics={}"]
        command = [sys.executable, "-m", "ftl_lightning", "fit", "--config=conf/own.yaml", "--trainer.logger.name=pendulum"]
        subprocess.run([*command, *options], check=True)
    model = FewShot.from_pretrained(folder / "fit" / "pretrained")
    policy = model.policy(model.learn(Swing(1.4).demonstrations(5, 500), name="swing by 1.4"))
    episodes = model.rollout(policy, lambda: Swing(1.4), episodes=50)
    episodes.save("swing.gif")
    print(policy, episodes)
