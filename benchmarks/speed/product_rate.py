"""Share of the processor's matrix product rate that inversion of ten concepts and sampling reach.

    python benchmarks/speed/product_rate.py [--out results/product_rate.json]

The rate is the maximum of ``torch.mm`` over the sizes that occur and others. Operations are torch's count for the whole call of
``invert`` or ``sample``, whose time includes everything besides products. A profile of the same call gives the remaining time by
operator. Seconds are processor time of a single thread.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import read_model

SIZES = ((32, 512, 512), (64, 512, 512), (320, 512, 512), (640, 512, 512), (1500, 512, 512), (640, 64, 4096), (1024, 1024, 1024))
"""Rows, inner size and columns; the first ones are those of one concept and of ten, learned and sampled."""
STEPS, DENOISING, LISTED = 20, 30, 8
"""Of learning and of sampling, and operators that are told."""


def fastest(work: Callable[[], Any], repeats: int) -> float:
    """Processor time of a call, the least of some."""
    work()
    found = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return min(found)


def rate(rows: int, inner: int, columns: int) -> float:
    """Operations a second of a matrix product."""
    left, right = torch.randn(rows, inner), torch.randn(columns, inner)
    repeats = max(3, int(2e9 / (2 * rows * inner * columns)))

    def products() -> None:
        for _ in range(10):
            torch.mm(left, right.T)

    return 20 * rows * inner * columns / fastest(products, repeats // 10 + 2)


def share(work: Callable[[], Any], best: float, repeats: int) -> dict[str, Any]:
    """Counted operations of a call, its seconds, and what share of the best rate that is; and where the time goes."""
    with FlopCounterMode(display=False) as count:
        work()
    operations, seconds = count.get_total_flops(), fastest(work, repeats)
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        work()
    found = [(event.key, event.self_cpu_time_total) for event in profiled.key_averages()]
    whole = sum(duration for _, duration in found)
    top = sorted(found, key=lambda pair: -pair[1])[:LISTED]
    return {
        "operations": operations,
        "seconds": round(seconds, 4),
        "operations a second": round(operations / seconds),
        "share of the best rate": round(operations / seconds / best, 4),
        "share of time by operator": {name: round(duration / whole, 3) for name, duration in top},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/object_rearrangement")
    parser.add_argument("--out", default="results/product_rate.json")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    load = os.getloadavg()[0]
    model = read_model(GenerativeModel, options.pretrained)
    data = InversionData(model.config.domain, suite="validation", seed=0).demonstrations
    names = list(dict.fromkeys(data.concepts))
    tuned = ModelSettings.read(f"conf/{model.config.domain}.yaml")
    settings = tuned.inversion.changed(tolerance=None)
    rates = {" x ".join(map(str, size)): rate(*size) for size in SIZES}
    best = max(rates.values())
    pair = Composition(model.training_embeddings[:2, None], torch.full((2,), 1.2))
    draws = [generator("cpu", index) for index in range(10)]
    sampling = Sampling("ddpm", DENOISING, 0.1)
    found: dict[str, Any] = {
        "machine": {
            "capability": torch.backends.cpu.get_cpu_capability(),
            "threads": 1,
            "torch": torch.__version__,
        },
        "products, operations a second": {name: round(value) for name, value in rates.items()},
        "best": round(best),
        "ten concepts together": share(lambda: invert(model, data, settings, STEPS), best, options.repeats),
        "one concept": share(lambda: invert(model, data.select(names[0]), settings, STEPS), best, options.repeats),
        "sampling 500 plans": share(lambda: model.sample([pair] * 10, 50, sampling, draws), best, options.repeats),
        "sampling 50 plans": share(lambda: model.sample([pair], 50, sampling, draws[:1]), best, options.repeats),
        "load": [round(load, 2), round(os.getloadavg()[0], 2)],
    }
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
