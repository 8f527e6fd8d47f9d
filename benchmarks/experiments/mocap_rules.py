"""Set the thresholds of the rules of human motion from recordings, and measure how often the rules hold in recordings.

    python benchmarks/experiments/mocap_rules.py --root FOLDER --out results/mocap_rules.json

Each threshold accepts 95 % of the windows of every person who shows the action. A window starts within four frames of a moment
nearest to standing, as demonstrations do. ``samples`` are the shares of samples of committed concepts that satisfy each condition.
"""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from mocap_distances import stretches, windows
from torch import Tensor

from ftl_lightning.domains.mocap import measures
from ftl_lightning.domains.mocap.measures import CONDITIONS, arm_rotation
from ftl_lightning.domains.mocap.skeleton import HORIZON
from ftl_lightning.domains.mocap.source import Recorded, at_rest
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.tensor_file import write_text

QUANTILE = 0.05  # Share of each person's windows that a threshold refuses
AROUND = 4  # Maximum frames between the start of a window and a moment nearest to standing
STRIDE = 8  # Frames between windows of the training concepts' trials
SAMPLES = 200  # Samples of each concept
FILE = Path(measures.__file__).parent / "rules.json"
Thresholds = Mapping[str, float]


def shown(source: Recorded, action: str, around: int | None = AROUND) -> dict[str, Tensor]:
    """Windows ``(window, 32, 42)`` of an action by person; ``None`` for windows that start at any frame."""
    by_person = dict[str, list[Tensor]]()
    for subject, states in stretches(source, action):
        rest = at_rest(states)
        starts = range(len(states) - HORIZON + 1)
        chosen = [start for start in starts if around is None or any(abs(start - frame) <= around for frame in rest)]
        by_person.setdefault(subject, []).extend(states[start : start + HORIZON] for start in chosen)
    return {subject: torch.stack(some) for subject, some in by_person.items()}


def thresholds(action: str, people: Sequence[Tensor]) -> dict[str, float]:
    """Threshold of each condition: the loosest of the people's quantiles, rounded to the looser side."""
    limits = {}
    for name, (measure, least) in CONDITIONS[action].items():
        values = [float(measure(states).quantile(QUANTILE if least else 1 - QUANTILE)) for states in people]
        limits[name] = math.floor(min(values) * 1000) / 1000 if least else math.ceil(max(values) * 1000) / 1000
    return limits


def rate(action: str, limits: Thresholds, states: Tensor) -> float:
    """Share of windows that satisfy an action's rule with these thresholds."""
    return round(float(measures.satisfied(action, states, limits).float().mean()), 4)


def of_samples(model: FewShot, source: Recorded, action: str, files: Sequence[Path]) -> dict[str, float]:
    """Share of samples of concepts, from new initial poses, that satisfy each condition of an action's rule."""
    starts = [source.starts(action, SAMPLES, seed) for seed in range(len(files))]
    plans = [model.sample(model.load(file), observed=starts[seed], seed=seed).states for seed, file in enumerate(files)]
    return {name: round(float(measures.holds(action, name, torch.cat(plans)).float().mean()), 4) for name in CONDITIONS[action]}


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder of prepared recordings")
    parser.add_argument("--out", type=Path, default=Path("results/mocap_rules.json"))
    parser.add_argument(
        "--concepts", type=Path, default=Path("results/concepts/mocap_adapter"), help="a folder of concepts for each seed"
    )
    chosen = parser.parse_args(arguments)
    source = Recorded(chosen.root)
    training = source.split("train", 0, 0)
    half = range(len(training) // 2)  # the others are mirror images
    others = torch.stack([one for row in half for one in windows(training.states[row, : int(training.lengths[row])], STRIDE)])
    limits, results = {}, {}
    for action in CONDITIONS:
        people, anywhere = shown(source, action), shown(source, action, None)
        limits[action] = thresholds(action, [*people.values()])
        rest = {one: [states for other, states in people.items() if other != one] for one in people}
        results[action] = {
            "windows": {one: len(states) for one, states in people.items()},
            "holds": {one: rate(action, limits[action], states) for one, states in people.items()},
            "holds at any phase": {one: rate(action, limits[action], states) for one, states in anywhere.items()},
            "holds, set by the others": {
                one: rate(action, thresholds(action, rest[one]), people[one]) for one in people if rest[one]
            },
            "training concepts": rate(action, limits[action], others),
        }
        if files := sorted(chosen.concepts.glob(f"*/{action.replace(' ', '_')}.safetensors")):
            results[action]["samples"] = of_samples(FewShot.from_pretrained("mocap"), source, action, files)
        if action == "arm circle":
            turned = {one: (arm_rotation(states) >= measures.FULL_TURN).all(dim=-1) for one, states in people.items()}
            results[action]["full turn"] = {one: round(float(full.float().mean()), 4) for one, full in turned.items()}
    write_text(FILE, json.dumps(limits, indent=1) + "\n")
    text = json.dumps({"windows of training concepts": len(others), **results}, indent=1) + "\n"
    print(text)
    write_text(chosen.out, text)


if __name__ == "__main__":
    main()
