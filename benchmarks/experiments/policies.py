"""Policies of new concepts from five demonstrations, in closed loop in two environments that no domain knows.

    python benchmarks/experiments/policies.py --models logs/policies --out results/policies.json

*Goals*: a point with a bounded velocity and three goals, shown as one observed vector. Models are pretrained on the way to two of
the goals. New are the third goal, the middle of two goals, and a point beyond a goal; the point is to be within 0.1 at the end.
*Pendulum* of Gymnasium: models are pretrained on four amplitudes of swinging, two directions of spinning and two of holding. New
are other amplitudes and angles; the largest angle of the last 60 steps is to be within 0.2 of the amplitude, or the mean distance
from the angle of the last 30 steps within 0.15. The rules accept the demonstrations. Both have a disturbed variant: noise on the
velocity, and noise on the torque. A policy of the same settings is made of each form; a shifted demonstration and the best
training concept (chosen with the rule, so an upper bound) need no learning.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.few_shot.learner import FewShot

SHOWN, FEW, EPISODES = 60, 5, 50
"""Demonstrations of each training concept and of a new one, and episodes of a cell."""


class Goals(gymnasium.Env[Any, Any]):
    """See this module; ``task`` are the weights of the goals, which add up to the target."""

    observation_space = Dict(state=Box(-4, 4, (2,), np.float32), goals=Box(-4, 4, (6,), np.float32))
    action_space = Box(-0.15, 0.15, (2,), np.float32)
    steps = 40

    def __init__(self, task: tuple[float, ...], noise: float = 0.0) -> None:
        self.task, self.noise, self.render_mode = np.array(task), noise, None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        apart = 0.0
        while apart < 0.6:
            self.goals = self.np_random.uniform(-1, 1, (3, 2))
            apart = min(float(np.linalg.norm(self.goals[i] - self.goals[j])) for i in range(3) for j in range(i))
        self.place, self.time = self.np_random.uniform(-1, 1, 2), 0
        return self._seen(), {}

    def _seen(self) -> dict[str, Any]:
        return {"state": self.place.astype(np.float32), "goals": self.goals.reshape(-1).astype(np.float32)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = self.place + np.clip(action, -0.15, 0.15) + self.noise * self.np_random.normal(size=2)
        self.time += 1
        right = bool(np.linalg.norm(self.place - self.task @ self.goals) < 0.1)
        return self._seen(), float(right), False, self.time == self.steps, {"is_success": right}

    def expert(self, observation: Any) -> NDArray[np.float32]:
        away = 0.2 * (self.task @ self.goals - self.place)
        return np.asarray(away * min(1.0, 0.1 / float(np.linalg.norm(away))), dtype=np.float32)


class Pendulum(gymnasium.Wrapper[Any, Any, Any, Any]):
    """See this module; ``task`` is ``('swing', amplitude)``, ``('spin', speed)`` or ``('hold', angle)``, from hanging."""

    def __init__(self, task: tuple[str, float], noise: float = 0.0) -> None:
        super().__init__(gymnasium.make("Pendulum-v1", max_episode_steps=120))
        (self.kind, self.value), self.noise = task, noise

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(**options)
        self.angles: list[float] = []
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        pushed = np.clip(action + self.noise * self.np_random.normal(size=1), -2, 2)
        observation, reward, terminated, truncated, _ = super().step(pushed)
        self.angles.append(float(np.arctan2(-observation[1], -observation[0])))
        largest, last = np.abs(self.angles[-60:]).max(), np.array(self.angles[-30:])
        swung = abs(largest - self.value) < 0.2
        right = swung if self.kind == "swing" else np.abs(last - self.value).mean() < 0.15
        return observation, reward, terminated, truncated, {"is_success": bool(right)}

    def expert(self, observation: Any) -> NDArray[np.float32]:
        cosine, sine, speed = observation
        angle = np.arctan2(-sine, -cosine)
        if self.kind == "swing":
            energy = speed**2 / 6 + 5 * (1 + cosine)
            push = 3 * (5 * (1 - np.cos(self.value)) - energy) * np.sign(speed if abs(speed) > 0.05 else 1)
        else:
            push = -8 * (angle - self.value) - 1.5 * speed + 5 * np.sin(self.value)
            push = push if self.kind == "hold" else 1.5 * (self.value - speed)
        return np.clip([push], -2, 2).astype(np.float32)


SETS: dict[str, tuple[Callable[..., Any], dict[str, Any], dict[str, Any], float]] = {
    "goals": (
        Goals,
        {"go to the first": (1, 0, 0), "go to the second": (0, 1, 0)},
        {"the third": (0, 0, 1), "the middle": (0.5, 0.5, 0), "beyond the first": (2, -1, 0)},
        0.03,
    ),
    "pendulum": (
        Pendulum,
        {
            **{f"swing by {amplitude}": ("swing", amplitude) for amplitude in (0.5, 1.0, 1.8, 2.3)},
            **{f"spin at {speed}": ("spin", speed) for speed in (5.0, -5.0)},
            **{f"hold at {angle}": ("hold", angle) for angle in (0.3, -0.3)},
        },
        {
            "swing by 0.75": ("swing", 0.75),
            "swing by 1.4": ("swing", 1.4),
            "swing by 2.05": ("swing", 2.05),
            "hold at 0": ("hold", 0.0),
        },
        0.5,
    ),
}
"""Environment, tasks of training concepts, new tasks, and the disturbance."""


def shown(make: Callable[[], Any], text: str, count: int, seed: int) -> Demonstrations:
    """Demonstrations of an environment's expert, whose actions tremble."""
    rng, paths, acts, seen = np.random.default_rng(seed), [], [], []
    for episode in range(count):
        env = make()
        observation, _ = env.reset(seed=1000 * seed + episode)
        states, done, ended = [observation], [], False
        while not ended:
            wide = 0.03 * env.action_space.high
            done.append((env.expert(observation) + rng.normal(size=wide.shape) * wide).astype(np.float32))
            observation, _, terminated, truncated, _ = env.step(done[-1])
            states.append(observation)
            ended = terminated or truncated
        named = isinstance(observation, dict)
        paths.append(np.array([state["state"] for state in states] if named else states))
        seen.append(np.array([state["goals"] for state in states] if named else np.zeros((len(states), 0))))
        acts.append(np.array(done))
    goals = {"observed": {"goals": torch.tensor(np.array(seen))}, "per_step": ("goals",)} if seen[0].size else {}
    return Demonstrations.of(paths, text, actions=acts, **goals)


def pretrained(name: str, models: Path) -> FewShot:
    """The model of a set; pretrained with default settings, if the folder has none."""
    folder = models / name / "fit" / "pretrained"
    if not folder.is_dir():
        make, training, _, _ = SETS[name]
        models.mkdir(parents=True, exist_ok=True)
        parts = [shown(partial(make, task), text, SHOWN, 10 + row) for row, (text, task) in enumerate(training.items())]
        concatenate(parts).save(models / f"{name}.npz")
        options = ["--data.demonstrations", f"{models / name}.npz", "--data.encoder", "hashing", "--data.metrics", "{}"]
        logged = ["--trainer.logger.save_dir", str(models), "--trainer.logger.name", name]
        subprocess.run([sys.executable, "-m", "ftl_lightning", "fit", "--config", "conf/own.yaml", *options, *logged], check=True)
    return FewShot.from_pretrained(folder)


def table(rows: list[dict[str, Any]]) -> str:
    """Mean success rates by task and form, and by settings of the policy of the chosen form."""

    def rate(**wanted: Any) -> str:
        rates = [row["success"] for row in rows if all(row.get(key) == value for key, value in wanted.items())]
        return f"{sum(rates) / len(rates):.2f}" if rates else "-"

    forms = ("chosen", "paper", "adapter", "shifted demonstration")
    lines = [
        "| new concept | form chosen | disturbed | paper's form | adapter | shifted demonstration | best training concept |",
        "|---" * 7 + "|",
    ]
    for name, (_, _, new, noise) in SETS.items():
        for task in new:
            plain = [rate(task=task, form=form, noise=0.0, settings="") for form in forms]
            disturbed = rate(task=task, form="chosen", noise=noise, settings="")
            best = rate(task=task, form="best training concept")
            lines.append(f"| {name}: {task} | {plain[0]} | {disturbed} | {' | '.join(plain[1:])} | {best} |")
    labels = dict.fromkeys(row["settings"] for row in rows if row.get("settings"))
    lines += ["", f"| form chosen, mean over tasks | as above | {' | '.join(labels)} |", "|---" * (2 + len(labels)) + "|"]
    for name, (_, _, _, noise) in SETS.items():
        for label, value in (("", 0.0), (", disturbed", noise)):
            rates = [rate(set=name, form="chosen", noise=value, settings=how) for how in ("", *labels)]
            lines.append(f"| {name}{label} | {' | '.join(rates)} |")
    times = [row["milliseconds"][0] for row in rows if row.get("settings") == "" and row["form"] == "chosen"]
    return "\n".join(lines) + f"\n\nAn action chunk takes {sorted(times)[len(times) // 2]:.0f} ms (median of the forms chosen).\n"


def main() -> None:
    """Measure both sets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--seeds", type=int, default=3, help="draws of five demonstrations")
    parser.add_argument("--models", type=Path, default=Path("logs/policies"))
    parser.add_argument("--out", type=Path, default=Path("results/policies.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for name in options.sets:
        make, training, new, disturbance = SETS[name]
        model = pretrained(name, options.models)
        whole = name == "goals"
        forms: dict[str, dict[str, Any]] = {"chosen": {}, "paper": {"form": "paper"}, "adapter": {"form": "adapter"}}
        forms |= {"shifted demonstration": {"form": "shifted demonstration"}} if whole else {}
        settings: dict[str, dict[str, Any]] = {
            "": {},
            "10 sampler steps": {"steps": 10},
            "a plan every 4 steps": {"execute": 4},
            "one plan": {"execute": 1000},
        }
        for text, task in new.items():
            for seed in range(options.seeds):
                five = shown(partial(make, task), text, FEW, 500 + seed)
                for form, changes in forms.items():
                    begin = time.process_time()
                    concept = model.learn(five, name=text, **changes)
                    seconds = time.process_time() - begin
                    for noise in (0.0, disturbance):
                        for label, how in settings.items() if form == "chosen" else [("", {})]:
                            episodes = model.rollout(
                                model.policy(concept, **how),
                                partial(make, task, noise),
                                EPISODES,
                                "info.is_success",
                            )
                            row = {"set": name, "task": text, "seed": seed, "form": form, "settings": label, "noise": noise}
                            row |= {"success": round(episodes.success, 4), "seconds": round(seconds, 1)}
                            rows.append({**row, "milliseconds": [round(value, 2) for value in episodes.latency]})
                            print(json.dumps(rows[-1]), flush=True)
            known = {other: model.rollout(model.policy(model[other]), partial(make, task), EPISODES).success for other in training}
            best = max(known, key=lambda other: known[other])
            rows.append({"set": name, "task": text, "form": "best training concept", "concept": best, "success": known[best]})
            options.out.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
            options.out.with_suffix(".md").write_text(table(rows), "utf-8")


if __name__ == "__main__":
    main()
