"""Test that a grid on a Ray cluster neither loses nor duplicates rows when its processes, nodes and head are killed.

    python benchmarks/stress/cluster_kills.py --count 20 --out results/cluster_kills.json

Two nodes run on this machine, each with one processor. A grid of six inversions is run by `ablate --executor ray`, and while it
runs, a process that runs a cell, the second node, or (every tenth time) the head with everything on it is killed at a random
moment and restarted. The same command is repeated until it succeeds. Then the rows are compared with those of the same grid in a
single undisturbed process. Grids follow each other until ``--count`` kills. Each cell is the target of at most a single kill for
each time that it is run first.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from ftl_lightning.apps.ablation.plan import Stage
from ftl_lightning.apps.ablation.record import CellRecord, read_record
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parents[2]
STAGE = {
    "verb": "invert",
    "config": str(ROOT / "conf" / "object_rearrangement.yaml"),
    "options": {
        "model.pretrained": str(ROOT / "pretrained" / "object_rearrangement"),
        "data.steps": 60,
        "evaluation.samples": 10,
        "evaluation.steps": 10,
        "evaluation.figures": 0,
        "evaluation.suites": ["paper"],
        "trainer.accelerator": "cpu",
        "trainer.enable_progress_bar": False,
        "trainer.logger.init_args.version": None,
    },
    "grid": {"model.omega": [0.8, 1.0, 1.2, 1.4, 1.6, 1.8]},
}
ORDER = ["omega", "setting", "task", "method", "metric"]
LONGEST_WAIT = 8.0
"""Seconds after the beginning of a cell within which something is killed; most of the first are imports."""
MOST_COMMANDS = 10
"""Of one grid, before it counts as one that does not end."""
LIMIT = 600.0
"""Seconds of one command."""
KINDS = ("process", "node", "head")


@dataclass
class Nodes:
    """The cluster, and what can be killed of it."""

    made: Any = None
    kills: Counter[str] = field(default_factory=Counter)

    def start(self) -> str:
        """What is not up; returns the head's address."""
        from ray.cluster_utils import Cluster

        if self.made is None:
            self.made = Cluster()
            self.made.add_node(num_cpus=1, include_dashboard=False)
        if not self.made.worker_nodes:
            self.made.add_node(num_cpus=1)
        return str(self.made.address)

    def kill(self, kind: str, cell: str, node: str) -> bool:
        """Kill what runs a cell; whether there was something to kill.

        Args:
            kind: of :data:`KINDS`.
            cell: name of its folder, which is also that of the process.
            node: the machine, as the record has it.
        """
        if self.made is None:  # the command has not missed it yet
            return False
        workers = [one for one in self.made.worker_nodes if one.node_id.startswith(node.rpartition("/")[2])]
        if kind == "process":
            found = _process(f"ray::{cell}")
            if found is None:
                return False
            with suppress(ProcessLookupError):
                os.kill(found, signal.SIGKILL)
        elif kind == "node":
            if not workers:
                return False
            self.made.remove_node(workers[0], allow_graceful=False)
        else:
            self.stop()
        self.kills[kind] += 1
        return True

    def stop(self) -> None:
        """Kill everything, the head first."""
        if self.made is not None:
            made, self.made = self.made, None
            made.remove_node(made.head_node, allow_graceful=False)
            for node in list(made.worker_nodes):
                with suppress(Exception):  # it may have ended with its head
                    made.remove_node(node, allow_graceful=False)


def _process(title: str) -> int | None:
    """The number of the process of this title."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if path.read_bytes().replace(b"\0", b" ").decode(errors="replace").strip() == title:
                return int(path.parent.name)
    return None


def ablate(folder: Path, plan: Path, *options: str, address: str = "") -> "subprocess.Popen[str]":
    """The command, begun."""
    command = [sys.executable, "-m", "ftl_lightning", "ablate", "--config", str(plan), *options]
    # Of this checkout, also where another is installed.
    environment = os.environ | {"RAY_ADDRESS": address, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (folder / "said.txt").open("a", encoding="utf-8") as said:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=said, stderr=said, text=True)


def disturbed(folder: Path, results: str, count: int, draw: random.Random, nodes: Nodes, advance: Any) -> int:
    """Run a grid to its end, with kills until there were so many in all; the number of commands that it took."""
    plan, names = write_plan(folder, results), {cell.name: cell.folder for cell in Stage(**STAGE).cells(0)}  # type: ignore[arg-type]
    killed: set[str] = set()
    for command in range(1, MOST_COMMANDS + 1):
        process = ablate(folder, plan, "--executor", "ray", address=nodes.start())
        deadline = time.monotonic() + LIMIT
        while process.poll() is None:
            if time.monotonic() > deadline:
                process.kill()
                raise TimeoutError(f"{folder / 'said.txt'}: the grid does not end")
            time.sleep(0.1)
            done = sum(nodes.kills.values())
            begun = [name for name, entry in running(folder / results).items() if entry.runs == 1 and name not in killed]
            if done >= count or not begun:
                continue
            name = draw.choice(begun)
            time.sleep(draw.uniform(0, LONGEST_WAIT))
            kind = "head" if done % 10 == 9 else KINDS[done % 2]
            entry = running(folder / results).get(name)
            if entry is not None and nodes.kill(kind, names[name], entry.node):
                killed.add(name)
                advance(1, f"{kind} of {name}")
                if kind == "node":
                    nodes.start()
        if process.returncode == 0:
            return command
    raise TimeoutError(f"{folder / 'said.txt'}: the grid did not end well after {MOST_COMMANDS} commands")


def running(results: Path) -> dict[str, CellRecord]:
    """The cells that run."""
    return {name: entry for name, entry in read_record(results).items() if entry.state == "running"}


def write_plan(folder: Path, results: str) -> Path:
    """The grid's file."""
    path = folder / f"{results}.yaml"
    write_text(path, yaml.safe_dump({"results": results, "stages": [STAGE]}))
    return path


def compared(found: pd.DataFrame, expected: pd.DataFrame) -> dict[str, int]:
    """Rows that are missing, that stand there twice, and that have another value."""
    keys = [name for name in found.columns if name != "value"]
    both = expected.merge(found.drop_duplicates(keys), on=keys, how="left", suffixes=("", " found"), indicator=True)
    there = both[both["_merge"] == "both"]
    return {
        "rows": len(expected),
        "lost": int((both["_merge"] == "left_only").sum()),
        "doubled": int(found.duplicated(keys).sum()) + len(found.drop_duplicates(keys)) - len(there),
        "different": int((there["value"] != there["value found"]).sum()),
    }


SUMS = ("lost", "doubled", "different")
"""Rows that should not be."""


def summary(nodes: Nodes, grids: Sequence[Mapping[str, int]], seconds: float) -> dict[str, Any]:
    """What the file holds, after each grid."""
    sums = {name: sum(grid[name] for grid in grids) for name in SUMS}
    return {"kills": dict(nodes.kills), **sums, "seconds": round(seconds), "grids": list(grids)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="results/cluster_kills.json")
    options = parser.parse_args()
    draw, nodes = random.Random(options.seed), Nodes()
    grids: list[dict[str, int]] = []
    folder = Path(tempfile.mkdtemp(prefix="ray"))  # a short name: those of sockets are limited
    os.environ |= {"RAY_TMPDIR": str(folder), "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    start = time.monotonic()
    try:
        alone = ablate(folder, write_plan(folder, "alone.csv"))
        if alone.wait(LIMIT):
            raise RuntimeError((folder / "said.txt").read_text("utf-8"))
        expected = read_rows(folder / "alone.csv").sort_values(ORDER, ignore_index=True)
        with bar("kills", options.count) as advance:
            while sum(nodes.kills.values()) < options.count:
                before = sum(nodes.kills.values())
                results = f"{len(grids)}.csv"
                commands = disturbed(folder, results, options.count, draw, nodes, advance)
                kills = sum(nodes.kills.values()) - before
                grids.append({"kills": kills, "commands": commands, **compared(read_rows(folder / results), expected)})
                print(grids[-1], flush=True)
                write_text(options.out, json.dumps(summary(nodes, grids, time.monotonic() - start), indent=1) + "\n")
    finally:
        nodes.stop()
        shutil.rmtree(folder, ignore_errors=True)
    sums = {name: count for name, count in summary(nodes, grids, 0).items() if name in SUMS}
    print(f"{sum(nodes.kills.values())} kills: rows {', '.join(f'{count} {name}' for name, count in sums.items())}")
    return 1 if any(sums.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
