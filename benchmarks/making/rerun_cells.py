"""Run committed cells again and compare every value with its row in ``results/``, to the last digit.

    python benchmarks/making/rerun_cells.py --root FOLDER --processes 2 --out logs/rerun

The cells use models that ship. Each runs by the command of its plan, in a process of its own on one thread, with its results and
concepts in ``--out``. A cell whose results are there is compared, not run again. ``OUT/rerun.jsonl`` gets a line for each
cell. Rows of other processors than in ``results/README.md`` differ in the last digits, and learning amplifies that.
"""

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import yaml

from ftl_lightning.apps.ablation.plan import Cell, Stage
from ftl_lightning.apps.ablation.run import planned
from ftl_lightning.evaluation.results import METHOD

CELLS = {
    "conf/ablation/comparison.yaml": r"invert (object_rearrangement|agent), .*seed \d|invert driving, .*seed 0",
    "conf/ablation/object_rearrangement.yaml": r"invert object_rearrangement, .*seed 0",
    "conf/ablation/agent.yaml": r"invert agent, omega .*seed 0",
    "conf/ablation/driving.yaml": r"invert driving, omega .*seed 0",
    "conf/ablation/tabletop.yaml": r"invert .*seed 0",
    "conf/ablation/mocap.yaml": r"invert .*seed 0",
}
"""Patterns of the names of cells by plan: all five domains and all methods."""
KEY = ("domain", "setting", "task", "method", "form", "variant", "role", "K", "omega", "demonstrations", "seed", "n", "metric")
"""Columns that identify a row beside its hash."""
ROLE = KEY.index("role")


def cells_of(plan: str, pattern: str, root: str) -> Iterator[tuple[str, Cell]]:
    """Results file and cell of each matching cell.

    Seed 0 of models that a plan pretrains is the model that ships, which the configurations name.
    """
    content = yaml.safe_load(Path(plan).read_text("utf-8"))
    stages = [Stage(**keys) for keys in content["stages"]]
    for group in planned(stages, content["seeds"], root).values():
        for cell in group:
            if cell.verb == "invert" and re.fullmatch(pattern, cell.name):
                options = {key: value for key, value in cell.options.items() if key != "model.pretrained"}
                yield content["results"], replace(cell, options=options)


def read(file: Path) -> dict[tuple[str, ...], str]:
    """Values by :data:`KEY` and hash."""
    with file.open(encoding="utf-8", newline="") as lines:
        return {(*(row[column] for column in KEY), row["config_hash"]): row["value"] for row in csv.DictReader(lines)}


def run(results: str, cell: Cell, folder: Path) -> dict[str, object]:
    """Run a cell unless its results are there, and compare them with the committed rows."""
    place = folder / f"{Path(results).stem}_{cell.folder}"
    measured, begun = place / "results.csv", time.monotonic()
    if not measured.is_file():
        place.mkdir(parents=True, exist_ok=True)
        running = place / "running.csv"
        running.unlink(missing_ok=True)
        options = [f"--evaluation.results={running}", f"--model.output={place / 'concepts'}", "--evaluation.films=null"]
        logger = [f"--trainer.logger.init_args.save_dir={place}", "--trainer.logger.init_args.version=log"]
        command = [sys.executable, "-m", "ftl_lightning", cell.verb, *cell.arguments, *options, *logger]
        with (place / "output.txt").open("w", encoding="utf-8") as output:
            done = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, env=os.environ | {"OMP_NUM_THREADS": "1"})
        if done.returncode or not running.is_file():
            return {"cell": cell.name, "results": results, "state": "failed", "output": str(place / "output.txt")}
        running.replace(measured)
    known, values = read(Path(results)), read(measured)
    (own,) = {key[-1] for key in values if key[ROLE] == METHOD}
    compared = [key for key in values if key in known]
    differ = [key for key in compared if known[key] != values[key]]
    missing = [key for key in known if key[-1] == own and key not in values]
    return {
        "cell": cell.name,
        "results": results,
        "state": "missing rows" if missing or not compared else "differs" if differ else "equal",
        "compared": len(compared),
        "not committed": len(values) - len(compared),  # such as metrics that are newer than the row
        "different": [{"row": ", ".join(key), "committed": known[key], "again": values[key]} for key in differ],
        "missing": [", ".join(key) for key in missing],
        "seconds": round(time.monotonic() - begun, 1),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", default="", help="folder of the recordings of human motion; without it these cells are left out")
    parser.add_argument("--processes", type=int, default=1, help="cells at the same time")
    parser.add_argument("--out", type=Path, default=Path("logs/rerun"), help="folder of results, concepts and the log")
    parser.add_argument(
        "--only", default="", help="pattern that the plan's file and the cell's name, separated by a space, contain"
    )
    parser.add_argument("--list", action="store_true", help="list the cells, and run none")
    options = parser.parse_args(arguments)
    cells = []
    for plan, pattern in CELLS.items():
        if "mocap" in plan and not options.root:
            continue
        root = options.root if "mocap" in plan else ""
        cells += [found for found in cells_of(plan, pattern, root) if re.search(options.only, f"{plan} {found[1].name}")]
    print("\n".join(f"{results}: {cell}" for results, cell in cells) if options.list else f"{len(cells)} cells", flush=True)
    if options.list:
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    states = []
    with ThreadPoolExecutor(options.processes) as pool, (options.out / "rerun.jsonl").open("a", encoding="utf-8") as log:
        for ended in as_completed([pool.submit(run, results, cell, options.out) for results, cell in cells]):
            outcome = ended.result()
            states.append(outcome["state"])
            log.write(json.dumps(outcome) + "\n")
            log.flush()
            print(f"[{len(states)}/{len(cells)}] {outcome['results']}: {outcome['cell']}: {outcome['state']}", flush=True)
    print(", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)))
    return int(any(state != "equal" for state in states))


if __name__ == "__main__":
    sys.exit(main())
