"""Concepts learned per second, for 1 to 256 concepts learned together, with the shipped settings.

    python benchmarks/speed/batching.py [--domain object_rearrangement] [--most 256] [--out results/batching.json]
                                  [--precision bf16-mixed] [--processes 2]

Concepts are those of the domain's suite with other demonstrations each (of driving, whose episodes take long to simulate, with
the same ones), of strokes training concepts, five demonstrations each. Every number is of whole calls of ``invert``, to their
end, where a concept stops by itself, or of ``--steps`` steps; of few concepts the mean over several disjoint groups. What was
measured is kept after each number of concepts, and a run that is started again goes on from there. In one process seconds are of
its processor time, which other work disturbs less. Several processes are started anew by each call, and its seconds are those
until all concepts are there, imports included. Every process has one thread.

A curve ``rate(n) = limit n / (n + half)`` is fitted to the rates: a call costs a fixed time and a time for each concept. Its error
is the largest of those of rates that were left out one at a time; that of the limit is by the jackknife.
"""

import argparse
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.few_shot.tuned import ModelSettings, settings_of
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.settings import FULL, PRECISIONS, REDUCED
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.in_processes import learned_in_processes
from ftl_lightning.training.model_folder import read_model

SUITES = {"object_rearrangement": "validation", "agent": "paper", "driving": "paper", "strokes": ""}
"""Of each domain; none where concepts are those of the demonstrations beside the model."""
SLOW = ("driving",)
"""Domains whose demonstrations take long to simulate."""
FEW = 5
GROUPS = 8
"""Concepts that are learned at least, in groups of the number that is measured."""


def concepts(domain: str, examples: Demonstrations | None) -> Iterator[Demonstrations]:
    """Without end: a domain's concepts, again and again with other demonstrations, under names of their own."""
    from ftl_lightning.training.data import InversionData  # not for the processes, which import this file: it takes seconds

    for seed in count():
        data = (
            InversionData(domain, suite=SUITES[domain], seed=0 if domain in SLOW else seed).demonstrations
            if examples is None
            else examples
        )
        for name in dict.fromkeys(data.concepts):
            own = data.select(name)
            if examples is not None:
                own = own.rows([(FEW * seed + row) % len(own) for row in range(FEW)])
            yield replace(own, concepts=(f"{name} ({seed})",) * len(own))


def curve(numbers: Sequence[int], rates: Sequence[float]) -> tuple[float, float]:
    """Limit and half of ``limit n / (n + half)``, least squares of relative errors of the time of a call, which is linear in n."""
    seconds = np.asarray(numbers, dtype=float) / np.asarray(rates)
    table = np.stack((np.ones(len(numbers)), np.asarray(numbers, dtype=float)), axis=1) / seconds[:, None]
    (fixed, each), *_ = np.linalg.lstsq(table, np.ones(len(numbers)), rcond=None)
    return float(1 / each), float(fixed / each)


def with_error(numbers: Sequence[int], rates: Sequence[float]) -> dict[str, float]:
    """The curve, the largest relative error of a rate that was left out, and the limit's standard error."""
    limit, half = curve(numbers, rates)
    limits, errors = [], []
    for place, (number, rate) in enumerate(zip(numbers, rates, strict=True)):
        rest = [index for index in range(len(numbers)) if index != place]
        own, at = curve([numbers[index] for index in rest], [rates[index] for index in rest])
        limits.append(own)
        errors.append(abs(own * number / (number + at) / rate - 1))
    several = len(numbers)
    spread = (several - 1) / several * sum((own - mean(limits)) ** 2 for own in limits)
    return {
        "limit": round(limit, 4),
        "limit's standard error": round(spread**0.5, 4),
        "half": round(half, 3),
        "largest error of one left out": round(max(errors), 4),
        "mean error of one left out": round(mean(errors), 4),
    }


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the rows say, fewest concepts first."""
    numbers = [int(row["concepts"]) for row in rows]
    rates = [float(row["concepts a second"]) for row in rows]
    found: dict[str, Any] = {"most over one": round(max(rates) / rates[0], 2), "last over one": round(rates[-1] / rates[0], 2)}
    return found | ({"curve": with_error(numbers, rates)} if len(rows) > 3 else {})


def name(domain: str, precision: str, processes: int) -> str:
    """In the file."""
    more = [*(["bfloat16"] if precision == REDUCED else []), *([f"{processes} processes"] if processes > 1 else [])]
    return ", ".join([domain, *more])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domain", default="object_rearrangement", choices=sorted(SUITES))
    parser.add_argument("--most", type=int, default=256)
    parser.add_argument("--out", default="results/batching.json")
    parser.add_argument("--precision", choices=PRECISIONS, default=FULL)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--least", type=int, default=1)
    parser.add_argument("--steps", type=int, help="of learning, at most, in place of the configuration's")
    parser.add_argument("--again", action="store_true", help="measure what is in the file already, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    alone = options.processes == 1
    clock = time.process_time if alone else time.perf_counter
    path, title = Path(options.out), name(options.domain, options.precision, options.processes)
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    own = {} if options.again else kept.get(title, {})
    rows = {int(row["concepts"]): row for row in own.get("rows", [])}
    folder = f"pretrained/{options.domain}"
    model = read_model(GenerativeModel, folder)
    tuned = ModelSettings.read(settings_of(model.config.domain))
    most = options.steps or tuned.learning_steps
    endless = concepts(options.domain, model.examples)
    known = [next(endless) for _ in range(max(options.most, GROUPS))]
    settings = tuned.inversion.changed(modes=1, knots=1, precision=options.precision)
    invert(model, known[0], settings, 3)  # torch loads much when it is first used
    for number in (2**power for power in range(options.most.bit_length())):
        if number in rows or number < options.least:
            continue
        load, durations, steps, losses = os.getloadavg()[0], [], [], []
        for first in range(0, max(GROUPS, number), number):
            group, told = concatenate(known[first : first + number]), list[float]()
            start = clock()
            if alone:
                found = invert(model, group, settings, most, told.append)
            else:
                found = learned_in_processes(folder, model.device, group, settings, most, options.processes)
            durations.append(clock() - start)
            steps.append(len(told))
            losses += [concept.origin.loss for concept in found.values()]
        rows[number] = {
            "concepts": number,
            "seconds": round(mean(durations), 4),
            **({"steps": round(mean(steps), 1)} if alone else {}),
            "loss": round(mean(losses), 5),
            "concepts a second": round(number / mean(durations), 4),
            "load": round(load, 2),
        }
        print(rows[number], flush=True)
        kept[title] = {
            "domain": options.domain,
            "precision": options.precision,
            "processes": options.processes,
            "steps at most": most,
            "torch": torch.__version__,
            "capability": torch.backends.cpu.get_cpu_capability(),
            "rows": [rows[known] for known in sorted(rows)],
        }
        kept[title] |= summary(kept[title]["rows"])
        if not alone and (one := kept.get(name(options.domain, FULL, 1))):
            kept[title]["most over one concept in a process"] = round(
                max(row["concepts a second"] for row in kept[title]["rows"]) / one["rows"][0]["concepts a second"], 2
            )
        write_text(path, json.dumps(kept, indent=1) + "\n")
    print(json.dumps({key: value for key, value in kept[title].items() if key != "rows"}, indent=1))


if __name__ == "__main__":
    main()
