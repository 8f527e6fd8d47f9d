"""A robot arm's new tasks from five demonstrations: ours beside behaviour cloning, fine-tuning, LoRA and shifted demonstrations.

    pip install '.[arm]'
    python benchmarks/experiments/arm.py --out results/arm.json

The arm, its four training tasks and two new ones are those of ``examples/panda.py``. Behaviour cloning is an MLP of the present
state, the goal and an embedding of the task (3 layers of 256, 4,000 steps of 256 transitions): *BC, concept* learns the embedding
of a new task (the paper's baseline), *BC, fine-tuning* all weights, *BC, five* is learned from the five demonstrations alone.
*LoRA* adapts all layers of our model (rank 8). *Shifted demonstration*, *warped demonstrations* and the best training concept need
no learning. 100 episodes a cell.
"""

import argparse
import copy
import importlib.util
import json
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from ftl_lightning.data.demonstrations import Demonstrations

ROOT = Path(__file__).parent.parent.parent
EPISODES, FEW, SIZE = 100, 5, 16
FORMS: dict[str, dict[str, Any]] = {
    "ours, form chosen": {},
    "ours, paper's form": {"form": "paper"},
    "LoRA": {"form": "adapter", "adapter": 8, "adapter_scope": "all"},
    "shifted demonstration": {"form": "shifted demonstration"},
    "warped demonstrations": {"form": "warped demonstrations"},
}


def example() -> Any:
    """The module of the example."""
    spec = importlib.util.spec_from_file_location("panda", ROOT / "examples" / "panda.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Cloning(nn.Module):
    """Action ``(batch, action)`` of normalised states and goals, and embeddings of tasks."""

    def __init__(self, inputs: Tensor, actions: int, tasks: int) -> None:
        super().__init__()
        self.centre, self.scale = inputs.mean(dim=0), inputs.std(dim=0).clamp(min=1e-3)
        self.tasks = nn.Parameter(0.1 * torch.randn(tasks, SIZE))
        widths = (inputs.shape[1] + SIZE, 256, 256, 256)
        layers = [part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.SiLU())]
        self.network = nn.Sequential(*layers, nn.Linear(256, actions))

    def forward(self, inputs: Tensor, task: Tensor) -> Tensor:
        return self.network(torch.cat(((inputs - self.centre) / self.scale, self.tasks[task]), dim=1))


def transitions(shown: Demonstrations) -> tuple[Tensor, Tensor]:
    """States with goals ``(transition, 10)``, and actions."""
    assert shown.actions is not None
    goals = shown.observed["goal"][:, None].expand(-1, shown.states.shape[1], -1)
    return torch.cat((shown.states.float(), goals), dim=2)[:, :-1].flatten(0, 1), shown.actions[:, :-1].flatten(0, 1)


def taught(model: Cloning, inputs: Tensor, actions: Tensor, task: Tensor, steps: int, parameters: list[Any]) -> Cloning:
    """Train some parameters."""
    adam, draw = torch.optim.Adam(parameters, 1e-3), torch.Generator().manual_seed(0)
    for _ in range(steps):
        rows = torch.randint(len(inputs), (256,), generator=draw)
        adam.zero_grad()
        mse_loss(model(inputs[rows], task[rows]), actions[rows]).backward()
        adam.step()
    return model.eval()


def cloned(parts: list[Demonstrations], seed: int) -> Cloning:
    """Behaviour cloning of tasks."""
    torch.manual_seed(seed)
    each = [transitions(part) for part in parts]
    inputs, actions = torch.cat([one for one, _ in each]), torch.cat([one for _, one in each])
    task = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor([len(one) for one, _ in each]))
    model = Cloning(inputs, actions.shape[1], len(parts))
    return taught(model, inputs, actions, task, 4000, list(model.parameters()))


def adapted(model: Cloning, five: Demonstrations, whole: bool) -> Cloning:
    """The model with the embedding, or all weights, adapted to a new task."""
    model = copy.deepcopy(model)
    model.tasks = nn.Parameter(model.tasks.detach().mean(dim=0, keepdim=True))
    inputs, actions = transitions(five)
    parameters = list(model.parameters()) if whole else [model.tasks]
    return taught(model, inputs, actions, torch.zeros(len(inputs), dtype=torch.int64), 1000, parameters)


def success(make: Callable[[], Any], act: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> float:
    """Success rate of a reactive policy, on the seeds of ``FewShot.rollout``."""
    from ftl_lightning.services.randomness import EVALUATION_SEED

    arm, right = make(), 0
    for episode in range(EPISODES):
        seen, ended, info = arm.reset(seed=EVALUATION_SEED + episode)[0], False, {"is_success": False}
        while not ended:
            seen, _, _, ended, info = arm.step(act(np.concatenate((seen["state"], seen["goal"]))).clip(-1, 1))
        right += info["is_success"]
    arm.close()
    return right / EPISODES


@torch.no_grad()
def action_of(model: Cloning, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    return model(torch.from_numpy(inputs)[None], torch.zeros(1, dtype=torch.int64))[0].numpy()


def table(rows: list[dict[str, Any]]) -> str:
    """Mean and range over draws of the success rates."""
    tasks, methods = list(dict.fromkeys(row["task"] for row in rows)), list(dict.fromkeys(row["method"] for row in rows))
    lines = [f"| success in {EPISODES} episodes | {' | '.join(tasks)} |", "|---" * (1 + len(tasks)) + "|"]
    for method in methods:
        cells = []
        for task in tasks:
            rates = [row["success"] for row in rows if (row["task"], row["method"]) == (task, method)]
            spread = f" ({min(rates):.2f} to {max(rates):.2f})" if len(rates) > 1 else ""
            cells.append(f"{sum(rates) / len(rates):.2f}{spread}" if rates else "-")
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure all cells."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="draws of five demonstrations")
    parser.add_argument("--model", type=Path, default=Path("logs/panda"))
    parser.add_argument("--out", type=Path, default=Path("results/arm.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    panda = example()
    model = panda.pretrained(options.model)
    rows: list[dict[str, Any]] = []

    def add(task: str, method: str, seed: int, rate: float, seconds: float) -> None:
        rows.append({"task": task, "method": method, "seed": seed, "success": round(rate, 4), "seconds": round(seconds, 1)})
        print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
        options.out.with_suffix(".md").write_text(table(rows), "utf-8")

    training = [panda.shown(text, task, 60, 10 + row) for row, (text, task) in enumerate(panda.TASKS.items())]
    bases = [cloned(training, seed) for seed in range(options.seeds)]
    for text, task in panda.NEW.items():
        make = partial(panda.Arm, task)
        for seed in range(options.seeds):
            five = panda.shown(text, task, FEW, 500 + seed)
            for method, changes in FORMS.items():
                begin = time.process_time()
                concept = model.learn(five, name=text, **changes)
                seconds = time.process_time() - begin
                add(text, method, seed, model.rollout(model.policy(concept), make, EPISODES).success, seconds)
            for method, make_model in {
                "BC, concept": partial(adapted, bases[seed], five, False),
                "BC, fine-tuning": partial(adapted, bases[seed], five, True),
                "BC, five": partial(cloned, [five], seed),
            }.items():
                begin = time.process_time()
                clone = make_model()
                seconds = time.process_time() - begin
                add(text, method, seed, success(make, partial(action_of, clone)), seconds)
        known = {other: model.rollout(model.policy(model[other]), make, EPISODES).success for other in panda.TASKS}
        add(text, "best training concept", 0, max(known.values()), 0.0)


if __name__ == "__main__":
    main()
