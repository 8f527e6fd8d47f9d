"""Which method is ahead in driving, episode by episode."""

import runpy

import torch

from tests.conftest import ROOT


def test_episodes_from_the_same_starts_are_paired() -> None:
    compared = runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "driving" / "paired.py"))["compared"]
    all_but_one = torch.arange(20) != 3
    every = {
        "ours": {"belief": all_but_one, "step": all_but_one},
        "BC": {"belief": torch.zeros(20, dtype=torch.bool), "step": torch.arange(20) != 4},
    }
    found = compared(every)
    assert found["ours"] == {"belief": 0.95, "step": 0.95}
    assert found["BC"]["belief"] == 0
    assert found["BC"]["ours is ahead by (belief)"].startswith("+0.95 [")
    assert found["BC"]["ours is ahead by (belief)"].endswith("p < .001, same outcome in 1 of 20")
    assert found["BC"]["ours is ahead by (step)"].endswith("p = 1, same outcome in 18 of 20")  # each wins once
