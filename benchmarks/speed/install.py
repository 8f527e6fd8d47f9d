"""Time from an empty environment to the first sample: torch, the wheel, and the program outside of the checkout.

    python benchmarks/speed/install.py [--python python3.11 ...] [--out results/install.json]

Builds the wheel, then for each interpreter: fills a separate package cache, creates an environment without the system's packages,
installs torch and the wheel in the versions of ``constraints.txt``, samples with a shipped model, and fits and evaluates a small
model. Torch is from pip's index, or from ``--torch-index``. Needs the network, or an index in pip's configuration, and space for
two copies of torch. Seconds depend on the machine and its load.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from ftl_lightning.services.tensor_file import write_text

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.checkout import copied

ROOT = Path(__file__).parents[2]
SAMPLE = ["sample", "--pretrained", "object_rearrangement", "--compose", "circle above square", "--count", "4"]
FIT = [
    "fit",
    "--config=conf/object_rearrangement.yaml",
    "--model.denoiser_args={hidden_dim: 64, depth: 2, condition_dim: 32}",
    "--data.samples_per_concept=50",
    "--data.validation_per_concept=4",
    "--data.steps_per_epoch=10",
    "--trainer.max_steps=20",
    "--trainer.accelerator=cpu",
    "--evaluation.samples=4",
]
"""A small model, with the validation and the evaluation that end every fit."""


def wheel(folder: Path) -> Path:
    """The wheel of this checkout, built in a folder."""
    source = copied(folder / "source")  # setuptools would leave its work in the checkout
    _timed([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)])
    (built,) = folder.glob("*.whl")
    return built


def installed(python: str, built: Path, torch_index: str | None, folder: Path) -> dict[str, float | str]:
    """Seconds of each step in an environment of an interpreter, in a folder that is empty before."""
    environment = folder / "environment"
    _timed([python, "-m", "venv", str(environment)])
    own = str(environment / "bin" / "python")
    pip = [
        own,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--constraint",
        str(ROOT / "constraints.txt"),
        "--cache-dir",
        str(folder / "cache"),
    ]
    for_torch = [*pip, *(["--index-url", torch_index] if torch_index else []), "torch"]
    for warm in (for_torch, [*pip, str(built)]):
        _timed([*warm, "--dry-run"])
    begin = time.monotonic()
    seconds = {"torch": _timed(for_torch), "wheel": _timed([*pip, str(built)])}
    empty = folder / "empty"
    empty.mkdir()
    seconds["first sample"] = _timed([own, "-m", "ftl_lightning", *SAMPLE], empty)
    seconds["from nothing to the first sample"] = time.monotonic() - begin
    seconds["second sample"] = _timed([own, "-m", "ftl_lightning", *SAMPLE], empty)
    seconds["fit"] = _timed([own, "-m", "ftl_lightning", *FIT], empty)
    told = "import platform, torch; print(platform.python_version(), torch.__version__)"
    version, of_torch = subprocess.run([own, "-c", told], check=True, capture_output=True, text=True).stdout.split()
    return {"python": version, "torch": of_torch, **{f"seconds: {name}": round(value, 1) for name, value in seconds.items()}}


def _timed(command: list[str], folder: Path | None = None) -> float:
    """Run a command, which must succeed; returns its seconds. Nothing of this process's environment for Python goes with it."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    begin = time.monotonic()
    done = subprocess.run(command, cwd=folder, env=kept, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"error: {' '.join(command)}: expected exit code 0, found {done.returncode}\n{done.stdout}{done.stderr}")
    return time.monotonic() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters, by name or path")
    parser.add_argument("--torch-index", help="address of the index that torch comes from")
    parser.add_argument("--out", default="results/install.json")
    options = parser.parse_args()
    machine = {
        "processor": platform.processor() or platform.machine(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "cores": len(os.sched_getaffinity(0)),
    }
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        built = wheel(Path(folder))
        size = round(built.stat().st_size / 1e6, 1)
        for python in options.python:
            with tempfile.TemporaryDirectory() as place:
                runs.append(installed(python, built, options.torch_index, Path(place)))
            print(json.dumps(runs[-1]), flush=True)
            content = {"machine": machine, "wheel, megabytes": size, "runs": runs}
            write_text(Path(options.out), json.dumps(content, indent=2) + "\n")  # after each, since the next takes minutes


if __name__ == "__main__":
    main()
