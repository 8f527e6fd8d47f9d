"""Hours and price of every published configuration on three machines, from counted operations and the measured rate of an H100.

    python benchmarks/speed/price.py [--machines benchmarks/speed/machines.yaml] [--out results/price.json] \
        [--table results/price.md]

The time of a step is the maximum of three times: operations over the reached rate, bytes over the memory bandwidth, and calls times
the overhead of a call. Rate and overhead are from the pretrainings of ``results/paper_size_runs.json`` on an H100: the rate from
the compiled temporal U-Net (a lower bound, as two others ran beside it), the overhead from the uncompiled U-Net. The third run, an
MLP, is held out and gives the error. An A4000 is assumed to reach the same share of its peak and the same overhead (the host's);
eight H100s are assumed to share the windows of a step and to pass gradients twice over their link. All but the three rows is
extrapolated.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
import yaml
from counting import Counted, counted
from steps import FLOAT, Made, Published, Step, on_paper, ours, paper, published

from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parents[2]
NUMBERS = (1, 10, 1_000, 1_000_000)
"""Of concepts, and of users who ask for :data:`PLANS` plans each."""
PLANS, DENOISING, TOGETHER = 50, 100, 256
"""Plans, steps of denoising, and concepts or users of a batch, where memory holds them."""
HELD = 0.8
"""Share of a memory that activations may fill."""
HOUR = 3600.0


@dataclass(frozen=True)
class Machine:
    """What work is priced on.

    Attributes:
        count: of accelerators.
        rate: operations a second of one, at its peak.
        bandwidth: bytes a second of its memory.
        memory: bytes of one.
        dollars: an hour of all.
        link: bytes a second between two of them.
    """

    count: int
    rate: float
    bandwidth: float
    memory: float
    dollars: float
    link: float


@dataclass(frozen=True)
class Reached:
    """What was measured.

    Attributes:
        share: of the peak rate.
        call: seconds that a call of an operator takes.
    """

    share: float
    call: float


@dataclass(frozen=True)
class Needed:
    """What a step needs, as a line over its batch.

    Attributes:
        operations, moved, saved: each ``(fixed, for each of the batch)``; bytes, but for operations.
        calls: of operators, which do not grow with the batch.
        parameters: bytes of weights, optimiser and average.
    """

    operations: tuple[float, float]
    moved: tuple[float, float]
    calls: float
    saved: tuple[float, float]
    parameters: float

    def at(self, batch: float) -> tuple[float, float, float]:
        """Operations, bytes moved, and bytes held, of a batch."""
        operations, moved, saved = (fixed + each * batch for fixed, each in (self.operations, self.moved, self.saved))
        return operations, moved, self.parameters + saved


def line(first: Counted, second: Counted, at: tuple[int, int], made: Made) -> Needed:
    """Through two counts, which differ in the batch alone."""

    def through(low: float, high: float) -> tuple[float, float]:
        slope = (high - low) / (at[1] - at[0])
        return low - slope * at[0], slope

    return Needed(
        through(first.operations, second.operations),
        through(first.moved + made.updated, second.moved + made.updated),
        second.calls + 1,
        through(first.saved, second.saved),
        sum(made.resident.values()),
    )


@cache
def _counted(domain: str, form: str, kind: str, at: tuple[int, int]) -> Needed:
    one = ours(domain) if form == "ours" else paper(domain)
    step: Step = getattr(one, kind)
    sized = [replace(step, batch=size) if kind == "pretraining" else replace(step, concepts=size) for size in at]
    made = [on_paper(own) for own in sized]
    first, second = (counted(own.compute, own.parameters) for own in made)
    return line(first, second, at, made[1])


def needed(one: Published, kind: str) -> Needed:
    """What a step of a configuration needs over its batch: windows of pretraining, concepts otherwise."""
    return _counted(one.domain, one.form, kind, (16, 32) if kind == "pretraining" else (1, 2))


def step_seconds(need: Needed, batch: float, machine: Machine, reached: Reached) -> float:
    """Of a step whose batch is shared by the accelerators of a machine.

    Args:
        need: of the step.
        batch: of all accelerators together.
        machine: with its peak rate.
        reached: of it.
    """
    operations, moved, _ = need.at(batch / machine.count)
    passed = 0.0 if machine.count == 1 else 2 * need.parameters / FLOAT / machine.link
    return max(operations / (reached.share * machine.rate), moved / machine.bandwidth, need.calls * reached.call) + passed


def calibrated(runs: Mapping[str, Any], machine: Machine) -> tuple[Reached, dict[str, Any]]:
    """What an H100 reached, and how far the run that was left out is from it.

    Args:
        runs: ``paper_size_runs.json``.
        machine: one H100.
    """
    compiled, eager, left_out = runs["fits"]
    flat = replace(paper("agent").pretraining, batch=1)
    wide = ours("agent").pretraining
    wide = replace(wide, config=replace(wide.config, denoiser_args={**wide.config.denoiser_args, "width": eager["width"]}))
    plain = replace(paper("object_rearrangement").pretraining, batch=left_out["windows a step"])
    counts = []
    for step, run in ((flat, compiled), (wide, eager), (plain, left_out)):
        made = on_paper(step)
        count = counted(made.compute, made.parameters)
        scale = run["windows a step"] / step.batch
        counts.append((count.operations * scale, count.calls + 1))
    (operations, _), (_, calls), (others, their_calls) = counts
    reached = Reached(operations / compiled["seconds a step"] / machine.rate, eager["seconds a step"] / calls)
    says = max(others / (reached.share * machine.rate), their_calls * reached.call)
    return reached, {
        "share of the peak rate (TF32)": round(reached.share, 4),
        "microseconds a call": round(1e6 * reached.call, 1),
        "left out": left_out["network"],
        "left out, seconds a step": left_out["seconds a step"],
        "left out, model": round(says, 5),
        "left out, error": round(says / left_out["seconds a step"] - 1, 3),
    }


def batch_that_fits(need: Needed, machine: Machine) -> int:
    """Concepts or users of a batch of one accelerator, at most :data:`TOGETHER`."""
    batch = TOGETHER
    while batch > 1 and need.at(batch)[2] > HELD * machine.memory:
        batch //= 2
    return batch


def together(need: Needed, steps: int, number: int, machine: Machine, reached: Reached) -> float:
    """Hours of so many concepts or users, in batches that fit, shared by the accelerators.

    Args:
        need: of a step of one concept or user.
        steps: of each.
        number: of them.
        machine: with its peak rate.
        reached: of it.
    """
    one = replace(machine, count=1)
    own = -(-number // machine.count)
    size = min(batch_that_fits(need, one), own)
    whole, rest = divmod(own, size)
    seconds = whole * step_seconds(need, size, one, reached) + (step_seconds(need, rest, one, reached) if rest else 0.0)
    return steps * seconds / HOUR


def of_pretraining(one: Published, machines: Mapping[str, Machine], reached: Reached) -> dict[str, Any]:
    """Hours and dollars of a pretraining on each machine."""
    need, batch = needed(one, "pretraining"), one.pretraining.batch
    operations, _, held = need.at(batch)
    row: dict[str, Any] = {
        "windows a step": batch,
        "steps": one.pretraining_steps,
        "operations a step": round(operations),
        "calls a step": round(need.calls),
        "bytes": round(held),
    }
    for name, machine in machines.items():
        # Eight share the windows of eight steps of one, so that there is an eighth of the steps.
        hours = one.pretraining_steps / machine.count * step_seconds(need, batch * machine.count, machine, reached) / HOUR
        row[name] = {"hours": hours, "dollars": hours * machine.dollars}
    return row


def of_many(one: Published, kind: str, steps: int, machines: Mapping[str, Machine], reached: Reached) -> dict[str, Any]:
    """Hours and dollars of several concepts or users on each machine."""
    need = needed(one, kind)
    operations, _, _ = need.at(1)
    row: dict[str, Any] = {"steps": steps, "operations a step, one": round(operations), "calls a step": round(need.calls)}
    for name, machine in machines.items():
        # The published procedure takes one concept after another.
        size = 1 if one.form != "ours" and kind == "inversion" else batch_that_fits(need, machine)
        found = {}
        for number in NUMBERS:
            if size == 1:
                own = -(-number // machine.count)
                hours = own * steps * step_seconds(need, 1, replace(machine, count=1), reached) / HOUR
            else:
                hours = together(need, steps, number, machine, reached)
            found[str(number)] = {"hours": hours, "dollars": hours * machine.dollars}
        row[name] = {"together": size, **found}
    return row


def here(path: Path) -> dict[str, Any]:
    """Hours of so many concepts on the machine of ``batching.json``: in batches of the most that was measured, or one of fewer."""
    if not path.exists():
        return {}
    found = {}
    for title, own in json.loads(path.read_text(encoding="utf-8")).items():
        rows = own["rows"]
        best = max(rows, key=lambda row: row["concepts a second"])
        hours = {}
        for number in NUMBERS:
            fits = [row["seconds"] for row in rows if row["concepts"] >= number]
            hours[str(number)] = (min(fits) if fits else number / best["concepts a second"]) / HOUR
        error = own.get("curve", {}).get("largest error of one left out")
        found[title] = {name: own[name] for name in ("domain", "precision", "processes")}
        found[title] |= {"together": best["concepts"], "hours": hours, "error of the curve": error}
    return found


def read_machines(path: str | Path) -> dict[str, Machine]:
    """Those of a file like ``machines.yaml``, by name."""
    content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    link = float(content["link, bytes a second"])
    return {
        name: Machine(
            int(own["count"]),
            float(own["tf32"]),
            float(own["bytes a second"]),
            float(own["memory"]),
            float(own["dollars an hour"]),
            link,
        )
        for name, own in content["machines"].items()
    }


def shown(hours: float) -> str:
    """Short, in the unit that goes with it."""
    for unit, least, size in (
        ("years", 2 * 8760, 8760),
        ("days", 48, 24),
        ("h", 1, 1),
        ("min", 1 / 60, 1 / 60),
        ("s", 0, 1 / HOUR),
    ):
        if hours >= least:
            value = hours / size
            return f"{value:,.0f} {unit}" if value >= 10 else f"{value:.2g} {unit}"
    raise ValueError(f"expected hours, found {hours}")


def money(dollars: float) -> str:
    """Short."""
    return f"${dollars:,.0f}" if dollars >= 10 else f"${dollars:.2f}" if dollars >= 0.01 else "under a cent"


def table(found: Mapping[str, Any], names: Sequence[str]) -> str:
    """The tables of the page on speed."""
    lines = ["| pretraining | parameters, optimiser, activations | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
    for name, row in found["pretraining"].items():
        cells = [f"{shown(row[one]['hours'])}, {money(row[one]['dollars'])}" for one in names]
        lines.append(f"| {name} | {row['bytes'] / 1e9:.2g} GB | " + " | ".join(cells) + " |")
    for kind, told in (("learning", "concepts"), ("sampling", f"users, {PLANS} plans each")):
        lines += ["", f"| {kind}, one H100 | " + " | ".join(f"{number:,}" for number in NUMBERS) + f" {told} |"]
        lines.append("|---" * (1 + len(NUMBERS)) + "|")
        for name, row in found[kind].items():
            own = row["one H100"]
            cells = [f"{shown(own[str(number)]['hours'])}, {money(own[str(number)]['dollars'])}" for number in NUMBERS]
            lines.append(f"| {name}, {own['together']} together | " + " | ".join(cells) + " |")
        if kind == "learning":
            for own in found["here"].values():
                cells = [shown(own["hours"][str(number)]) for number in NUMBERS]
                cores = f"{own['processes']} core{'s' if own['processes'] > 1 else ''}"
                title = f"{own['domain']}, ours, {own['precision']}, on {cores}, measured up to {own['together']} together"
                lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def rounded(value: Any) -> Any:
    """Numbers with four digits, in whatever they stand."""
    if isinstance(value, dict):
        return {key: rounded(own) for key, own in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", default=str(ROOT / "benchmarks" / "speed" / "machines.yaml"))
    parser.add_argument("--runs", default=str(ROOT / "results" / "paper_size_runs.json"))
    parser.add_argument("--batching", default=str(ROOT / "results" / "batching.json"))
    parser.add_argument("--out", default="results/price.json")
    parser.add_argument("--table", default="results/price.md")
    options = parser.parse_args()
    torch.manual_seed(0)
    machines = read_machines(options.machines)
    reached, calibration = calibrated(json.loads(Path(options.runs).read_text(encoding="utf-8")), machines["one H100"])
    found: dict[str, Any] = {
        "machines": {name: asdict(machine) for name, machine in machines.items()},
        "calibration": calibration,
        "pretraining": {},
        "learning": {},
        "sampling": {},
        "here": here(Path(options.batching)),
    }
    every = published()
    with bar("counting", 3 * len(every)) as advance:
        for one in every:
            found["pretraining"][one.name] = of_pretraining(one, machines, reached)
            advance()
            found["learning"][one.name] = of_many(one, "inversion", one.learning_steps, machines, reached)
            advance()
            found["sampling"][one.name] = of_many(one, "sampling", DENOISING, machines, reached)
            advance()
    found["bytes of a learned concept"] = {one.name: _stored(one.inversion) for one in every}
    found = rounded(found)
    write_text(Path(options.out), json.dumps(found, indent=1) + "\n")
    write_text(Path(options.table), table(found, list(machines)))
    print(json.dumps(found["calibration"], indent=1))
    print(Path(options.table).read_text(encoding="utf-8"))


def _stored(step: Step) -> int:
    return FLOAT * step.components * (1 + step.knots * step.config.concept_dim)


if __name__ == "__main__":
    main()
