"""How many concepts a second are learned, of 1 to 256 that are learned together, with the settings that ship.

    python benchmarks/batching.py [--domain object_rearrangement] [--most 256] [--out results/batching.json] [--threads 2]

Concepts are those of the domain's suite with other demonstrations each (of driving, whose episodes take long to simulate, with
the same ones), of strokes training concepts, five demonstrations each. Every number is of whole calls of ``invert``, to their
end, where a concept stops by itself, or of ``--steps`` steps; of few concepts the mean over several disjoint groups. What was
measured is kept after each number of concepts, and a run that is started again goes on from there. With one thread, seconds are of
processor time, which other work disturbs less.

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

from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.data import InversionData
from ftl_lightning.learning.inversion import invert
from ftl_lightning.learning.model_folder import read_model
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.tensor_file import write_text
from ftl_lightning.tuned import Tuned, settings_of

SUITES = {"object_rearrangement": "validation", "agent": "paper", "driving": "paper", "strokes": ""}
"""Of each domain; none where concepts are those of the demonstrations beside the model."""
SLOW = ("driving",)
"""Domains whose demonstrations take long to simulate."""
FEW = 5
GROUPS = 8
"""Concepts that are learned at least, in groups of the number that is measured."""


def concepts(domain: str, examples: Demonstrations | None) -> Iterator[Demonstrations]:
    """Without end: a domain's concepts, again and again with other demonstrations, under names of their own."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domain", default="object_rearrangement", choices=sorted(SUITES))
    parser.add_argument("--most", type=int, default=256)
    parser.add_argument("--out", default="results/batching.json")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, help="of learning, at most, in place of the configuration's")
    parser.add_argument("--again", action="store_true", help="measure what is in the file already, too")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    path = Path(options.out)
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    own = {} if options.again else kept.get(options.domain, {})
    if own and own["threads"] != options.threads:
        parser.error(f"{path}: expected {own['threads']} threads, as what is there was measured with, found {options.threads}")
    rows = {int(row["concepts"]): row for row in own.get("rows", [])}
    model = read_model(GenerativeModel, f"pretrained/{options.domain}")
    tuned = Tuned.read(settings_of(model.config.domain))
    most = options.steps or tuned.learning_steps
    endless = concepts(options.domain, model.examples)
    known = [next(endless) for _ in range(max(options.most, GROUPS))]
    settings = tuned.inversion.changed(modes=1, knots=1)
    invert(model, known[0], settings, 3)  # torch loads much when it is first used
    for number in (2**power for power in range(options.most.bit_length())):
        if number in rows:
            continue
        load, durations, steps = os.getloadavg()[0], [], []
        for first in range(0, max(GROUPS, number), number):
            group, losses = concatenate(known[first : first + number]), list[float]()
            start = clock()
            invert(model, group, settings, most, losses.append)
            durations.append(clock() - start)
            steps.append(len(losses))
        rows[number] = {
            "concepts": number,
            "seconds": round(mean(durations), 4),
            "steps": round(mean(steps), 1),
            "concepts a second": round(number / mean(durations), 4),
            "load": round(load, 2),
        }
        print(rows[number], flush=True)
        kept[options.domain] = {
            "threads": options.threads,
            "steps at most": most,
            "torch": torch.__version__,
            "capability": torch.backends.cpu.get_cpu_capability(),
            "rows": [rows[known] for known in sorted(rows)],
        }
        kept[options.domain] |= summary(kept[options.domain]["rows"])
        write_text(path, json.dumps(kept, indent=1) + "\n")
    print(json.dumps({name: value for name, value in kept[options.domain].items() if name != "rows"}, indent=1))


if __name__ == "__main__":
    main()
