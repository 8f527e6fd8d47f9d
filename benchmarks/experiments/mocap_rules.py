"""Rates at which the rules of human motion hold in recordings of the action and of training concepts.

python benchmarks/experiments/mocap_rules.py --root FOLDER --out results/mocap_rules.json
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from mocap_distances import stretches, windows
from torch import Tensor

from ftl_lightning.domains.mocap.measures import RULES
from ftl_lightning.domains.mocap.source import Recorded
from ftl_lightning.services.tensor_file import write_text

STRIDE = 8
"""Frames between windows of the training concepts' trials."""


def shown(source: Recorded, action: str) -> dict[str, Tensor]:
    """All windows ``(window, 32, 42)`` of an action by person."""
    found = dict[str, list[Tensor]]()
    for subject, states in stretches(source, action):
        found.setdefault(subject, []).extend(windows(states, 1))
    return {subject: torch.stack(own) for subject, own in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="recordings, as `prepare mocap` leaves them")
    parser.add_argument("--out", type=Path, default=Path("results/mocap_rules.json"))
    chosen = parser.parse_args(arguments)
    source = Recorded(chosen.root)
    training = source.split("train", 0, 0)
    half = range(len(training) // 2)  # the others are mirror images
    others = torch.stack([one for row in half for one in windows(training.states[row, : int(training.lengths[row])], STRIDE)])
    found = {}
    for action, rule in RULES.items():
        own = shown(source, action)
        held = {subject: round(float(rule(states).float().mean()), 4) for subject, states in own.items()}
        number = {subject: len(states) for subject, states in own.items()}
        demonstrations = float(rule(source.draw(action, 5, 0).states).float().mean())
        wrong = round(float(rule(others).float().mean()), 5)
        found[action] = {"windows": number, "holds": held, "demonstrations": demonstrations, "training concepts": wrong}
    text = json.dumps({"windows of training concepts": len(others), **found}, indent=1) + "\n"
    print(text)
    write_text(chosen.out, text)


if __name__ == "__main__":
    main()
