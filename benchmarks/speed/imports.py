"""Start-up cost of each verb: seconds, modules and the largest packages, measured on an idle machine.

    python benchmarks/speed/imports.py [--runs 5] [--out results/imports.json]
    python benchmarks/speed/imports.py --page  # writes the table in results/imports.md from that file

Each verb runs in a separate process several times after a warm-up run; numbers are medians. *Help* is the time of ``VERB --help``.
*Start* is the time from the start of the process to the first step of learning, or to the end of verbs without learning. *Imports*
is its part for importing modules by ``-X importtime``, in separate, slightly slower runs. Seconds of a package are those of its
modules without modules of other packages that they import.
"""

import argparse
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ftl_lightning.cli.main import COMMANDS, TRAINER_VERBS
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parents[2]
MODEL, GOAL = "object_rearrangement", "square diagonal to triangle"
TRAINED = ["--config=conf/object_rearrangement.yaml", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
SMALL = ["--data.samples_per_concept=50", "--data.validation_per_concept=4"]
NETWORK = "--model.denoiser_args={hidden_dim: 64, depth: 2, condition_dim: 32}"
STARTS = {
    "fit": ["fit", *TRAINED, *SMALL, NETWORK],
    "invert": ["invert", *TRAINED, "--data.demonstrations=five.npz", f"--model.pretrained={MODEL}"],
    "invert MODEL FILE": ["invert", MODEL, "five.npz"],
    "generate": ["generate", MODEL, "--task", GOAL, "--count", "5", "--out", "five.npz"],
    "check": ["check", "five.npz"],
    "sample": ["sample", "--pretrained", MODEL, "--compose", "circle above square", "--count", "1"],
    "concepts": ["concepts", MODEL],
}
"""Those whose start is measured, as they are run."""
LARGEST, SHOWN = 10, 4
"""Packages that are told of each, in the file and on the page."""
LEAST = 0.05
"""Seconds of a package that is told on the page."""
PROGRAM = """
import functools, os, sys, time

def told():
    sys.stdout.flush()
    print("\\nTOLD", time.time(), len(sys.modules), flush=True)
    os._exit(0)

def stopping(kind, name):
    def step(self, batch, *more):
        told()
    setattr(kind, name, functools.wraps(getattr(kind, name))(step))

arguments = {arguments!r}
from ftl_lightning.cli import main as cli
if arguments[0] == "fit":
    import ftl_lightning.apps.lightning_cli
    from ftl_lightning.training.pretraining import Pretraining
    stopping(Pretraining, "training_step")
elif arguments[0] == "invert":
    if arguments[1].startswith("-"):
        import ftl_lightning.apps.lightning_cli
    from ftl_lightning.igm.inversion import Inversion
    stopping(Inversion, "step_losses")
assert cli.main(arguments) == 0
told()
"""
"""Runs a verb until it has begun to learn, or to its end; it imports what the verb imports, in the same order."""
IMPORTED = re.compile(r"^import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)$", re.M)
"""Microseconds of a module itself, and its name."""


def started(arguments: list[str], folder: Path, *options: str) -> tuple[float, int, str]:
    """Seconds until a verb has started, how many modules there are then, and what went to standard error."""
    command = [sys.executable, *options, "-c", PROGRAM.format(arguments=arguments)]
    begin = time.time()
    done = subprocess.run(command, cwd=folder, env=environment(), capture_output=True, text=True, check=False)
    if done.returncode or not (found := re.search(r"^TOLD ([\d.]+) (\d+)$", done.stdout, re.M)):
        raise SystemExit(f"error: {' '.join(arguments)}: expected a start, found\n{done.stdout}{done.stderr}")
    return float(found[1]) - begin, int(found[2]), done.stderr


def environment() -> dict[str, str]:
    """The package of this checkout, on one thread."""
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def start(arguments: list[str], folder: Path, runs: int) -> dict[str, Any]:
    """The start of a verb."""
    started(arguments, folder)
    timed = [started(arguments, folder) for _ in range(runs)]
    own: list[Counter[str]] = []
    for _ in range(runs):
        packages: Counter[str] = Counter()
        for microseconds, module in IMPORTED.findall(started(arguments, folder, "-X", "importtime")[2]):
            packages[module.partition(".")[0]] += int(microseconds)
        own.append(packages)
    names = {name for packages in own for name in packages}
    median = Counter({name: round(statistics.median(packages[name] for packages in own) / 1e6, 3) for name in names})
    return {
        "seconds": round(statistics.median(seconds for seconds, *_ in timed), 2),
        "imports": round(statistics.median(packages.total() for packages in own) / 1e6, 2),
        "modules": timed[-1][1],
        "largest": dict(median.most_common(LARGEST)),
    }


def shown(verb: str, folder: Path, runs: int) -> float:
    """Seconds of a verb's help."""
    seconds = []
    for _ in range(runs + 1):
        begin = time.monotonic()
        command = [sys.executable, "-m", "ftl_lightning", verb, "--help"]
        subprocess.run(command, cwd=folder, env=environment(), capture_output=True, check=True)
        seconds.append(time.monotonic() - begin)
    return round(statistics.median(seconds[1:]), 2)


def table(found: Mapping[str, Any]) -> str:
    """Markdown: the start of each verb, and what is not measured so."""
    lines = ["| command | start | imports | modules | largest packages | `--help` |", "|---|---|---|---|---|---|"]
    for verb, measured in found["start"].items():
        packages = ", ".join(
            f"{name} {seconds:.1f} s" for name, seconds in list(measured["largest"].items())[:SHOWN] if seconds >= LEAST
        )
        cells = [f"`{verb}`", f"{measured['seconds']:.1f} s", f"{measured['imports']:.1f} s", f"{measured['modules']:,}", packages]
        lines.append(f"| {' | '.join([*cells, _help(found, verb)])} |")
    rest = [verb for verb in found["help"] if verb not in found["start"]]
    lines += ["", f"`--help` of the others: {', '.join(f'`{verb}` {_help(found, verb)}' for verb in rest)}."]
    machine = found["machine"]
    lines += ["", f"{machine['cores']} cores, Python {machine['python']}, load {machine['load before']:.1f} before."]
    return "\n".join(lines) + "\n"


def _help(found: Mapping[str, Any], verb: str) -> str:
    return f"{found['help'][verb]:.1f} s" if verb in found["help"] else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="that count, of each measurement")
    parser.add_argument("--out", default="results/imports.json")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the table")
    options = parser.parse_args()
    out = Path(options.out)
    if options.page:
        write_text(out.with_suffix(".md"), table(json.loads(out.read_text("utf-8"))))
        return
    found: dict[str, Any] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
            "python": platform.python_version(),
            "torch": torch.__version__,
            "load before": round(os.getloadavg()[0], 2),
        },
        "runs": options.runs,
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        started(STARTS["generate"], folder)  # the file that others read
        found["start"] = {verb: start(arguments, folder, options.runs) for verb, arguments in STARTS.items()}
        found["help"] = {verb: shown(verb, folder, options.runs) for verb in (*TRAINER_VERBS, *COMMANDS)}
    write_text(out, json.dumps(found, indent=2) + "\n")
    write_text(out.with_suffix(".md"), table(found))
    for verb, measured in found["start"].items():
        print(f"{verb}: start {measured['seconds']} s, imports {measured['imports']} s, {measured['modules']} modules")
    print("help:", ", ".join(f"{verb} {seconds} s" for verb, seconds in found["help"].items()))


if __name__ == "__main__":
    main()
