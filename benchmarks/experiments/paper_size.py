"""Cost of pretraining the paper's form at its size in navigation: counted operations and measured seconds of a step.

    python benchmarks/experiments/paper_size.py [--out results/paper_size.json]

Operations are multiplications and additions of forward and backward pass, independent of the machine. Seconds are processor time
of one thread, the minimum over several steps. Weights are random, as cost does not depend on them.
"""

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.networks import PAPER_SIZE, TemporalUNet
from ftl_lightning.networks.conditions import Sizes
from ftl_lightning.services.configuration import load
from ftl_lightning.services.tensor_file import write_text

DOMAIN, TEXT = "agent", {"ours": 384, "paper": 768}
"""The domain, and columns of an embedding of a text: MiniLM's and flan-t5-base's."""
PAPER = {"multipliers": (1, 2, 4, 8), "initial_encoder": "flat", "film": False, "broadcast": False, "clock": 0}
"""The paper's form of the network, as in conf/ablation/changes.yaml."""
REPEATS, STEPS = 3, 16_000
"""Repetitions of a measurement, and the length that was tried at a quarter of the width; the paper does not say its own."""
GPU, SHARE = 19.2e12, 0.3
"""An RTX A4000's single-precision operations a second by its data sheet, and the share of them that is assumed to be reached."""


def step(width: int, concept: int, batch: int, form: Mapping[str, Any]) -> tuple[int, float]:
    """Operations and seconds of one training step."""
    domain = load_domain(DOMAIN)
    sizes = Sizes(domain.plans.horizon, len(domain.plans.columns), concept, domain.observed)
    torch.manual_seed(0)
    net = TemporalUNet(sizes, width, **form)
    x, s0 = torch.randn(batch, domain.plans.horizon, len(domain.plans.columns)), torch.randn(batch, sizes.vector_dim)
    t, c = torch.randint(100, (batch,)), torch.randn(batch, 1, concept)
    own = torch.arange(batch)

    def train() -> None:
        net(x, t, c, own, net.observe(s0)).square().mean().backward()

    with FlopCounterMode(display=False) as counter:
        train()
    durations = []
    for _ in range(REPEATS):
        start = time.process_time()
        train()
        durations.append(time.process_time() - start)
    return counter.get_total_flops(), min(durations)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/paper_size.json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    fit = load(f"conf/{DOMAIN}.yaml", "fit")
    batch, own = fit["data"]["init_args"]["batch_size"], dict(fit["model"]["init_args"]["denoiser_args"])
    rows = []
    for name, width, concept, form in (
        ("ours", own.pop("width"), TEXT["ours"], own),
        ("the paper's form, a quarter of its width", 32, TEXT["ours"], PAPER),
        ("the paper's form and size", PAPER_SIZE["TemporalUNet"]["width"], TEXT["paper"], PAPER),
    ):
        count, seconds = step(width, concept, batch, form)
        told = {
            "network": name,
            "width": width,
            "operations a step, 1e9": round(count / 1e9, 2),
            "seconds a step": round(seconds, 3),
        }
        told["hours"], told["GPU hours"] = round(seconds * STEPS / 3600, 1), round(count * STEPS / (GPU * SHARE) / 3600, 2)
        rows.append(told)
    found = {"steps": STEPS, "windows a step": batch, "GPU": {"operations a second": GPU, "share": SHARE}, "rows": rows}
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
