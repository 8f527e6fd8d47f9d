"""How the cost of a step of inversion and of denoising grows with horizon, K, width and number of concepts (temporal U-Net).

    python benchmarks/cost.py [--out results/cost.json]

Weights are random: cost does not depend on them. One quantity varies at a time, the others keep the shipped values.
"""

import argparse
import json
import time
from pathlib import Path

import torch
from rich.progress import track

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.guidance import composed_epsilon
from ftl_lightning.diffusion import TemporalUNet
from ftl_lightning.diffusion.denoiser import Sizes
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.tensor_file import write_text

BASE = {"horizon": 128, "K": 2, "width": 32, "concepts": 5}
GRID = {"horizon": (32, 64, 128, 256), "K": (1, 2, 3), "width": (16, 32, 64), "concepts": (1, 5, 10)}
SAMPLES = 8
"""Noised demonstrations a concept and step."""
REPEATS = 3


def milliseconds(horizon: int, components: int, width: int, concepts: int) -> tuple[float, float]:
    """Of one step of inversion, and of one denoising step of as many plans without gradient; the fastest of some."""
    domain = load_domain("agent")
    states, n = len(domain.plans.columns), 384
    sizes = Sizes(horizon, states, n, domain.observed)
    net = TemporalUNet(sizes, width, initial_encoder="entities")
    net.requires_grad_(False).eval()
    batch = concepts * SAMPLES
    x, s0 = torch.randn(batch, horizon, states), torch.randn(batch, sizes.vector_dim)
    t = torch.randint(100, (batch,))
    embeddings = torch.randn(concepts, components, 1, n, requires_grad=True)
    weights = torch.ones(concepts, components)

    composition = Composition(embeddings, weights)

    def learn() -> None:
        composed_epsilon(net, x, t, composition, torch.zeros(n), net.observe(s0)).square().mean().backward()

    context = net.observe(s0)  # once a plan, not at every step

    @torch.no_grad()
    def generate() -> None:
        composed_epsilon(net, x, t, composition, torch.zeros(n), context)

    found = []
    for work in (learn, generate):
        work()
        durations = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            work()
            durations.append(time.perf_counter() - start)
        found.append(round(1000 * min(durations), 1))
    return found[0], found[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/cost.json")
    options = parser.parse_args()
    torch.manual_seed(0)
    rows = []
    for name, value in track([(name, value) for name, values in GRID.items() for value in values], "measuring"):
        chosen = BASE | {name: value}
        learn, generate = milliseconds(chosen["horizon"], chosen["K"], chosen["width"], chosen["concepts"])
        rows.append({"varied": name, "value": value, "inversion step, ms": learn, "denoising step, ms": generate})
    found = {"threads": torch.get_num_threads(), "samples a concept": SAMPLES, "base": BASE, "rows": rows}
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
