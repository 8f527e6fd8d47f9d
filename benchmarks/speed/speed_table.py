"""Write the tables of the page on speed from the measurements: results/peers.md, batching.md, product_rate.md, cost.md and
fit_options.md.

python benchmarks/speed/speed_table.py
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ftl_lightning.services.tensor_file import write_text

RESULTS = Path(__file__).parents[2] / "results"
NOT_QUIET = 1.2
"""Load before a measurement from which on the machine was busy."""


LIMIT, BY_OPERATOR = "limit's standard error", "share of time by operator"


def cells(*values: object) -> str:
    """A line of a table."""
    return "| " + " | ".join(map(str, values)) + " |"


def head(*titles: str) -> list[str]:
    """Its first lines."""
    return [cells(*titles), "|---" * len(titles) + "|"]


def told(machine: str, loads: list[float]) -> str:
    """Where it was measured, and whether other work was going on."""
    busy = f"load {max(loads):.1f}, of other work or of the benchmark before"
    return f"\n{machine}, {busy if loads[0] > NOT_QUIET else 'on an otherwise idle machine'}.\n"


def threads(count: int) -> str:
    """In words."""
    return f"{count} thread{'s' if count > 1 else ''}"


def peers(found: Mapping[str, Any]) -> str:
    """Beside diffusers."""
    lines: list[str] = []
    for what in ("sampling", "learning"):
        lines += ["", *head(what, "seconds (smallest to largest)", "theirs over ours")]
        for name, (middle, least, most) in found[f"{what}, seconds"].items():
            ratio = found["ratio"][what].get(name)
            seconds = f"{middle:.2f} ({least:.2f} to {most:.2f})"
            lines.append(cells(name, seconds, "" if ratio is None else f"{ratio:.1f}"))
    machine, work = found["machine"], found["work"]
    where = f"{machine['capability']}, {threads(machine['threads'])}, diffusers {machine['diffusers']}, peft {machine['peft']}"
    where += (
        f"; {work['concepts']} concepts"
        f", {work['plans of each']} plans of each, {work['denoising steps']} steps; {work['steps of learning']} steps of learning"
    )
    losses = found["loss of learned concepts"]
    differences = found["same noise, largest difference of plans"]
    same = f"\nFrom the same noise plans differ by at most {100 * max(differences.values()):.2g} % of their range. "
    same += f"Mean loss of the learned concepts: ours {losses['ours, mean']:.4f}, theirs {losses['theirs, mean']:.4f}.\n"
    before, after = found["load"]
    return "\n".join(lines[1:]) + "\n" + same + told(where, [max(before, after - machine["threads"])])


def batching(found: Mapping[str, Any]) -> str:
    """Concepts a second."""
    numbers = sorted({row["concepts"] for own in found.values() for row in own["rows"]})
    names = [f"{title.replace('_', ' ')}, at most {own['steps at most']} steps" for title, own in found.items()]
    lines = head("concepts a second, together", *names)
    for number in numbers:
        rates = [{row["concepts"]: f"{row['concepts a second']:.2g}" for row in own["rows"]} for own in found.values()]
        lines.append(cells(number, *(rate.get(number, "") for rate in rates)))
    lines.append(cells("best over first", *(f"{own['most over one']:.1f}" for own in found.values())))
    beside = "most over one concept in a process"
    lines.append(cells(f"{beside}, single precision", *(f"{own[beside]:.1f}" if beside in own else "" for own in found.values())))
    curves = [own.get("curve") for own in found.values()]
    limits = (f"{curve['limit']:.2g} ± {curve[LIMIT]:.1g}" if curve else "" for curve in curves)
    lines.append(cells("limit of the curve", *limits))
    own = next(iter(found.values()))
    alone = [own for own in found.values() if own["processes"] == 1]  # several are a load themselves
    loads = [max(row["load"] for own in alone for row in own["rows"])]
    return "\n".join(lines) + "\n" + told(f"{own['capability']}, a thread for each process", loads)


def product_rate(found: Mapping[str, Any]) -> str:
    """The share of the rate of matrix products."""
    best = found["best"]
    lines = head("what", "operations a second", "share of the best product's", "costliest operations")
    for name, rate in found["products, operations a second"].items():
        lines.append(cells(f"product {name}", f"{rate / 1e9:.0f} G", f"{100 * rate / best:.0f} %", ""))
    for name, own in found.items():
        if isinstance(own, dict) and "operations a second" in own:
            most = ", ".join(
                f"{key.removeprefix('aten::')} {100 * value:.0f} %" for key, value in list(own[BY_OPERATOR].items())[:4]
            )
            rate = own["operations a second"]
            lines.append(cells(name, f"{rate / 1e9:.0f} G", f"{100 * own['share of the best rate']:.0f} %", most))
    machine = found["machine"]
    return "\n".join(lines) + "\n" + told(f"{machine['capability']}, {threads(machine['threads'])}", found["load"])


def cost(found: Mapping[str, Any]) -> str:
    """What a step costs, and how well the model of its time does."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in found["rows"]:
        groups.setdefault(row["varied"], []).append(row)
    titles = [f"{name} {' / '.join(str(row['value']) for row in rows)}" for name, rows in groups.items()]
    lines = head("milliseconds", *titles)
    for kind in ("inversion step, ms", "denoising step, ms"):
        own = (" / ".join(f"{row[kind]:.0f}" for row in rows) for rows in groups.values())
        lines.append(cells(kind.removesuffix(", ms"), *own))
    model = found["model"]
    lines += ["", *head("model of a step's time", "steps", "mean error", "median", "largest", "within 10 %")]
    for name in ("fitted on", "checked on", "checked, ours", "checked, the paper's size", "checked, one window at a time"):
        own = model[name]
        shown = (f"{100 * own[key]:.1f} %" for key in ("mean", "median", "largest"))
        lines.append(cells(name, own["steps"], *shown, f"{100 * own['within ten per cent']:.0f} %"))
    return "\n".join(lines) + "\n" + told(f"{found['capability']}, {threads(found['threads'])}", found["load"])


def fit_options(found: Mapping[str, Any]) -> str:
    """Steps of a fit with other options."""
    lines = head("`fit`", "a step", "times as fast", "until the first step", "loss at the end")
    for config, rows in found.items():
        if not config.endswith(".yaml"):
            continue
        for name, row in rows.items():
            step, until = f"{1000 * row['seconds a step']:.0f} ms", f"{row['seconds until the first step is made']:.0f} s"
            title = f"{config.removesuffix('.yaml').replace('_', ' ')}, {name}"
            lines.append(cells(title, step, f"{row['times as fast']:.2f}", until, f"{row['loss at the end']:.4f}"))
    machine = found["machine"]
    return "\n".join(lines) + "\n" + told(f"{machine['capability']}, {threads(machine['threads'])}", [found["load"]])


TABLES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "peers": peers,
    "batching": batching,
    "fit_options": fit_options,
    "product_rate": product_rate,
    "cost": cost,
}


def main() -> None:
    for name, table in TABLES.items():
        content = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        write_text(RESULTS / f"{name}.md", table(content))


if __name__ == "__main__":
    main()
