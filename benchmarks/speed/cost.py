"""Run time of a step by horizon, K, width and number of concepts, and a model of it from counted operations.

    python benchmarks/speed/cost.py [--out results/cost.json] [--kept logs/cost_steps.json] [--budget SECONDS] [--rounds 3]

Weights are random: cost does not depend on them. In the grid one quantity varies at a time, the others keep the shipped values.

The model is ``time = products + convolutions + functions that bend + bytes / bandwidth + calls x overhead``. The first three are
the calls that ``counting.py`` counts, each times what it takes by itself (``operator_time.py``): no formula tells that. Factors of
the others, zero or more, are fitted on grids of sizes, of the temporal U-Net and of the MLP (least squares of relative errors), and
checked on configurations that they have not seen: every step of the models that ship, and steps of networks of the paper's size.
The error of the published inversion, which takes one window at a time, is told apart. Seconds are of processor time of one thread,
the fastest of some steps, in the fastest of several rounds, minutes apart: what else a machine does slows it down for a while.
What was measured is kept, so that a run goes on where another was stopped or had used up its budget.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
import operator_time
import torch
from counting import PRODUCTS, Counted, counted, told
from rich.progress import track
from scipy.optimize import nnls
from steps import DOMAINS, Kind, Made, Step, made, ours, paper

from ftl_lightning.services.tensor_file import write_text

BASE = {"horizon": 128, "K": 2, "width": 32, "concepts": 5}
GRID = {"horizon": (32, 64, 128, 256), "K": (1, 2, 3), "width": (16, 32, 64), "concepts": (1, 5, 10)}
SAMPLES = 8
"""Noised demonstrations a concept and step."""
MEASURED = ("multiplied", "convolved", "bent")
"""Seconds of products, of convolutions and of functions that bend, all by themselves: they count as they are."""
FITTED = ("near", "far", "calls", "recorded", "backward")
"""Of :class:`counting.Counted`, bytes of the other calls, and calls: each times a factor."""
CACHE = 2**26
"""Bytes that no cache of a processor holds."""
LEAST, MOST = 3, 12
"""Repeats of a step; between the two, as many as a quarter of a second holds."""
WITHIN = 0.10
"""Relative error that the model is to keep."""


def seconds(work: Callable[[], None]) -> float:
    """Processor time of a step, the fastest of some."""
    work()
    found: list[float] = []
    while len(found) < LEAST or (len(found) < MOST and sum(found) < 0.25):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return min(found)


def features(step: Made, count: Counted) -> list[float]:
    """What the model is a sum over; the optimiser is one more call, which passes over what it learns."""
    own = dict.fromkeys(MEASURED, 0.0) | {name: float(getattr(count, name)) for name in FITTED}
    between = min(2 ** (step.resident["parameters"] - 1).bit_length(), CACHE)
    for call, times in count.heavy.items():
        kind = "multiplied" if call.name.startswith(PRODUCTS) else "convolved" if "convolution" in call.name else "bent"
        # What a function bends was just put out, and is at hand.
        own[kind] += times * operator_time.seconds(call, between if kind != "bent" else 0)
    own["far"] += step.updated
    own["calls"] += 1
    return list(own.values())


def fitted(rows: Sequence[Sequence[float]], durations: Sequence[float]) -> dict[str, float]:
    """Factors of zero or more with the least relative errors.

    Args:
        rows: of :func:`features`.
        durations: seconds of each.
    """
    every, target = np.asarray(rows, dtype=float), np.asarray(durations)
    measured, table = every[:, : len(MEASURED)].sum(axis=1), every[:, len(MEASURED) :]
    scale = table.max(axis=0)
    scale[scale == 0] = 1
    found, _ = nnls(table / scale / target[:, None], 1 - measured / target)
    return dict(zip(FITTED, map(float, found / scale), strict=True))


def predicted(coefficients: Mapping[str, float], row: Sequence[float]) -> float:
    """Seconds of a step."""
    counts = dict(zip((*MEASURED, *FITTED), row, strict=True))
    return sum(counts[name] for name in MEASURED) + sum(coefficients[name] * counts[name] for name in FITTED)


def of_grid(kind: Kind, chosen: Mapping[str, int]) -> Step:
    """A step of the temporal U-Net of the shipped navigation model with some quantities changed."""
    own = ours("agent").pretraining.config
    arguments = {**own.denoiser_args, "width": chosen["width"]}
    config = replace(own, horizon=chosen["horizon"], denoiser_args=arguments)
    return Step(kind, config, SAMPLES, concepts=chosen["concepts"], components=chosen["K"])


def to_fit() -> dict[str, Step]:
    """Steps that the model is fitted on, beside those of the grid."""
    steps = {}
    plain = ours("object_rearrangement").pretraining.config
    for hidden in (128, 256, 512, 1024):
        config = replace(plain, denoiser_args={**plain.denoiser_args, "hidden_dim": hidden})
        for batch in (64, 1024):
            steps[f"MLP {hidden}, pretraining, {batch}"] = Step("pretraining", config, batch)
        for concepts in (1, 6):
            steps[f"MLP {hidden}, inversion, {concepts}"] = Step("inversion", config, 16, concepts=concepts)
            steps[f"MLP {hidden}, sampling, {concepts}"] = Step("sampling", config, 40, concepts=concepts)
    for width, horizon, batch in ((16, 64, 32), (32, 64, 8), (32, 128, 16), (64, 32, 8), (64, 64, 16), (96, 32, 4)):
        own = of_grid("pretraining", {**BASE, "width": width, "horizon": horizon, "concepts": 1})
        steps[f"U-Net {width} x {horizon}, pretraining, {batch}"] = replace(own, batch=batch)
    wide = paper("agent").pretraining
    for width, horizon, batch in ((64, 8, 2), (64, 32, 2), (96, 8, 2), (96, 16, 4), (112, 8, 4), (80, 64, 2)):
        config = replace(wide.config, horizon=horizon, denoiser_args={**wide.config.denoiser_args, "width": width})
        steps[f"U-Net {width} x {horizon} in the paper's form, pretraining, {batch}"] = replace(wide, config=config, batch=batch)
    flat = paper("object_rearrangement").inversion
    for hidden in (512, 768):
        config = replace(flat.config, denoiser_args={**flat.config.denoiser_args, "hidden_dim": hidden})
        steps[f"MLP {hidden}, published inversion"] = replace(flat, config=config)
    return steps


def to_check() -> dict[str, Step]:
    """Steps that the model has not seen: all of those that ship, and of the paper's size what fits into seconds."""
    steps = {
        f"{one.name}: {step.kind}": step for one in map(ours, DOMAINS) for step in (one.pretraining, one.inversion, one.sampling)
    }
    for one in map(paper, DOMAINS[:5]):
        steps[f"{one.name}: inversion"] = one.inversion
        steps[f"{one.name}: pretraining, batch 2"] = replace(one.pretraining, batch=2)
    return steps


def measured(name: str, step: Step) -> dict[str, Any]:
    """A step counted and timed."""
    work = made(step)
    count = counted(work.compute, work.parameters)
    return {"step": name, "seconds": seconds(work), "features": features(work, count), "counted": told(count), **work.resident}


def faster(one: Mapping[str, Any] | None, other: dict[str, Any]) -> dict[str, Any]:
    """A step of two rounds: the least seconds of it and of its calls by themselves, the rounds' number, and the highest load."""
    if one is None:
        return {**other, "rounds": 1}
    lesser = [min(pair) for pair in zip(one["features"], other["features"], strict=True)]
    least, most = min(one["seconds"], other["seconds"]), max(one["load"], other["load"])
    return {**other, "seconds": least, "features": lesser, "load": most, "rounds": one["rounds"] + 1}


def with_errors(rows: Sequence[Mapping[str, Any]], coefficients: Mapping[str, float]) -> list[dict[str, Any]]:
    """For the file: seconds, what the model says, and its relative error."""
    found = []
    for row in rows:
        says = predicted(coefficients, row["features"])
        kept = {key: value for key, value in row.items() if key not in ("features", "seconds", "load", "rounds")}
        error = says / row["seconds"] - 1
        found.append({**kept, "seconds": round(row["seconds"], 6), "model": round(says, 6), "error": round(error, 4)})
    return found


def errors(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of rows with errors: their mean, median and largest size, and the share within :data:`WITHIN`."""
    sizes = [abs(float(row["error"])) for row in rows]
    return {
        "mean": round(mean(sizes), 4),
        "median": round(median(sizes), 4),
        "largest": round(max(sizes), 4),
        "within ten per cent": round(mean(size <= WITHIN for size in sizes), 4),
        "steps": len(sizes),
    }


def of_the_grid() -> dict[str, Step]:
    """Steps in which one quantity varies, by :func:`grid_name`."""
    steps = {}
    for varied, values in GRID.items():
        for value in values:
            for kind in KINDS:
                steps[grid_name(kind, varied, value)] = of_grid(kind, BASE | {varied: value})
    return steps


def grid_name(kind: str, varied: str, value: int) -> str:
    """Of a step in the file."""
    return f"U-Net, {kind}, {varied} {value}"


KINDS: tuple[Kind, ...] = ("inversion", "sampling")


def summary(measured: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """What the file says, of all steps by name."""
    rows = []
    for varied, values in GRID.items():
        for value in values:
            learn, generate = (1000 * measured[grid_name(kind, varied, value)]["seconds"] for kind in KINDS)
            row = {
                "varied": varied,
                "value": value,
                "inversion step, ms": round(learn, 1),
                "denoising step, ms": round(generate, 1),
            }
            rows.append(row)
    fit, check = ([measured[name] for name in steps] for steps in ({**of_the_grid(), **to_fit()}, to_check()))
    coefficients = fitted([row["features"] for row in fit], [row["seconds"] for row in fit])
    own, others = with_errors(fit, coefficients), with_errors(check, coefficients)
    loads = [row["load"] for row in measured.values()]
    return {
        "threads": 1,
        "torch": torch.__version__,
        "capability": torch.backends.cpu.get_cpu_capability(),
        "load": [max(loads), round(mean(loads), 2)],
        "rounds": min(row["rounds"] for row in measured.values()),
        "samples a concept": SAMPLES,
        "base": BASE,
        "rows": rows,
        "model": {
            "seconds per": coefficients,
            "fitted on": errors(own),
            "checked on": errors(others),
            "checked, ours": errors([row for row in others if ", ours" in row["step"]]),
            "checked, the paper's size": errors([row for row in others if ", the paper: pretraining" in row["step"]]),
            "checked, one window at a time": errors([row for row in others if ", the paper: inversion" in row["step"]]),
        },
        "fitted": own,
        "checked": others,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/cost.json")
    parser.add_argument("--kept", default="logs/cost_steps.json", help="steps that were measured already")
    parser.add_argument("--budget", type=float, help="seconds of processor time after which to stop")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    operator_time.keep_memory()
    kept = Path(options.kept)
    known = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    kept.parent.mkdir(parents=True, exist_ok=True)
    every = {**of_the_grid(), **to_fit(), **to_check()}
    turns = [(turn, name) for turn in range(options.rounds) for name in every]
    for turn, name in track(turns, "steps"):
        if options.budget is not None and time.process_time() > options.budget:
            break
        if name == next(iter(every)):
            operator_time.seconds.cache_clear()
        if known.get(name, {}).get("rounds", 0) <= turn:
            now = {**measured(name, every[name]), "load": round(os.getloadavg()[0], 2)}
            known[name] = faster(known.get(name), now)
            write_text(kept, json.dumps(known) + "\n")
    if missing := sum(known.get(name, {}).get("rounds", 0) <= turn for turn, name in turns):
        print(f"{missing} of {len(turns)} measurements are not made yet; run it again")
        return
    found = summary(known)
    write_text(Path(options.out), json.dumps(found, indent=1) + "\n")
    print(json.dumps(found["model"], indent=1))
    for row in found["checked"]:
        print(f"{row['step']:55s} {1000 * row['seconds']:9.1f} ms {100 * row['error']:+6.1f} %")


if __name__ == "__main__":
    main()
