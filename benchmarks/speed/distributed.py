"""Compare ``fit`` in two processes with a single process: losses of every domain and method, throughput, and resuming after a kill.

    python benchmarks/speed/distributed.py [--out results/distributed.json] [--mocap FOLDER] [--parts losses throughput kills]

Losses: 50 steps of each configuration at its shipped size, in two processes with 4 windows each and in one with 8; the largest
difference of any logged loss, as a share of it where it is above 1. Throughput: windows a second of two processes with one thread
each, over those of one process with one thread and of one with two, at the shipped batch size for each process, and of the small
network also at one where exchanging gradients takes long beside a step; on two cores, which should be idle. Kills: in turn the
second process, the first, and both are killed at a random moment of a run, which then goes on from its last checkpoint in turn in
two processes and in one; every loss is compared with those of a run that nobody killed.
"""

import argparse
import itertools
import json
import os
import platform
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

CONF = Path(__file__).parents[2] / "conf"
OWN = ("object_rearrangement.yaml", "agent.yaml", "driving.yaml", "mocap.yaml", "tabletop.yaml")
METHODS = ("bc", "cvae", "in_context")
FEW = {"tabletop": {"samples_per_concept": 1, "validation_per_concept": 1, "recoveries": 1}, "mocap": {}}
"""Demonstrations a domain is asked for, so that drawing them takes no time; of the others :data:`USUAL`."""
USUAL = {"samples_per_concept": 4, "validation_per_concept": 1}
QUIET = ["--trainer.limit_val_batches=0", "--trainer.enable_progress_bar=false", "--trainer.log_every_n_steps=1"]
QUIET += ["--trainer.accelerator=cpu"]
TWO = ["--trainer.devices=2", "--trainer.strategy=ddp"]
SMALL = ["--model.denoiser_args={hidden_dim: 32, depth: 2, condition_dim: 16, dropout: 0.1}", "--data.samples_per_concept=20"]
SMALL += ["--trainer.callbacks.init_args.every_n_train_steps=50", "--data.steps_per_epoch=100", "--trainer.max_steps=400"]
STEPS, PATIENCE = 50, 600.0
TIMED = {"object_rearrangement.yaml": {512: 100, 64: 400}, "agent.yaml": {32: 100}}
"""Of a configuration, windows of a step of each process, the shipped number first, and steps that are timed; those before
:data:`WARM` do not count."""
WARM = 10
CLOSE = 1e-5


def command(config: Path, folder: Path, options: Sequence[str]) -> list[str]:
    """A fit that writes to a folder."""
    written = [f"--trainer.logger.init_args.save_dir={folder}", f"--model.output={folder}/model", *QUIET]
    return [sys.executable, "-m", "ftl_lightning", "fit", "--config", str(config), *written, *options]


def run(arguments: Sequence[str], threads: int = 1) -> None:
    done = subprocess.run(arguments, env=environment(threads), capture_output=True, text=True, timeout=PATIENCE, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments[3:6])}: exit code {done.returncode}: {done.stderr.strip()[-500:]}")


def environment(threads: int = 1) -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONPATH": str(CONF.parent)}


def curve(folder: Path) -> dict[int, tuple[float, float]]:
    """Loss and time of each step that was logged."""
    board = EventAccumulator(str(next(folder.rglob("events.*")).parent))
    board.Reload()
    return {event.step: (event.value, event.wall_time) for event in board.Scalars("loss/train")}


def difference(one: dict[int, tuple[float, float]], two: dict[int, tuple[float, float]]) -> float:
    """The largest of any step's losses, as a share of those that are above 1; infinite where steps are missing."""
    if set(one) != set(two):
        return float("inf")
    return max(abs(one[step][0] - two[step][0]) / max(1.0, abs(one[step][0])) for step in one)


def losses(folder: Path, mocap: str | None) -> dict[str, float]:
    """The largest difference of each configuration."""
    configs = [CONF / name for name in OWN] + sorted(path for method in METHODS for path in (CONF / method).glob("*.yaml"))
    configs = [path for path in configs if mocap or path.stem != "mocap"]
    found = {}
    with bar("configurations", len(configs)) as advance:
        for config in configs:
            name = str(config.relative_to(CONF))
            options = [f"--data.{key}={value}" for key, value in FEW.get(config.stem, USUAL).items()]
            options += [f"--data.root={mocap}"] if config.stem == "mocap" else []
            options += [f"--trainer.max_steps={STEPS}", f"--data.steps_per_epoch={STEPS}"]
            place = folder / name
            run(command(config, place / "one", [*options, "--data.batch_size=8"]))
            run(command(config, place / "two", [*options, "--data.batch_size=4", *TWO]))
            found[name] = difference(curve(place / "one"), curve(place / "two"))
            print(f"{name}: {found[name]:.1e}", flush=True)
            advance()
    return found


def throughput(folder: Path) -> dict[str, dict[str, float]]:
    """Windows a second of each configuration and number of windows; ``gain`` is two processes' over one's with a thread."""
    found: dict[str, dict[str, float]] = {}
    timed = [(name, windows, steps) for name, sizes in TIMED.items() for windows, steps in sizes.items()]
    with bar("timings", 3 * len(timed)) as advance:
        for name, windows, steps in timed:
            options = [f"--trainer.max_steps={steps}", f"--data.steps_per_epoch={steps}", f"--data.batch_size={windows}"]
            rates, title = {}, f"{name}, {windows} windows"
            for kind, threads, more, together in (
                ("one process", 1, [], windows),
                ("one process, two threads", 2, [], windows),
                ("two processes", 1, TWO, 2 * windows),
            ):
                place = folder / f"{title} {kind}"
                run(command(CONF / name, place, [*options, *more]), threads)
                times = [at for step, (_, at) in sorted(curve(place).items()) if step >= WARM]
                # The median: what else the machine does once costs a few steps alone.
                rates[kind] = together / statistics.median(later - at for at, later in itertools.pairwise(times))
                advance()
            found[title] = rates | {"gain": rates["two processes"] / rates["one process"]}
            print(title, found[title], flush=True)
    return found


def kills(folder: Path, count: int, seed: int) -> dict[str, Any]:
    """Runs that were killed and went on, and those of them whose losses are not all there, once, and the same."""
    draw, wrong = random.Random(seed), []
    config = CONF / "object_rearrangement.yaml"
    run(command(config, folder / "unbroken", [*SMALL, "--data.batch_size=8"]))
    unbroken = curve(folder / "unbroken")
    with bar("killed", count) as advance:
        for number in range(count):
            place = folder / str(number)
            both = [*SMALL, "--data.batch_size=4", *TWO]
            process = subprocess.Popen(
                command(config, place, both), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            end = time.monotonic() + PATIENCE
            while not list(place.rglob("last.ckpt")) and process.poll() is None and time.monotonic() < end:
                time.sleep(0.02)
            time.sleep(draw.uniform(0, 1))
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
            second = [int(one) for one in children.read_text().split()] if children.is_file() else []
            who = ("second", "first", "both")[number % 3]
            for pid in {"second": second, "first": [process.pid], "both": [process.pid, *second]}[who]:
                os.kill(pid, signal.SIGKILL)
            _, told = process.communicate(timeout=PATIENCE)
            ended = process.returncode
            while any(Path(f"/proc/{pid}").exists() for pid in second):  # it ends with the first one
                time.sleep(0.05)
            alone = number % 2 == 1
            again = [*SMALL, "--data.batch_size=8"] if alone else both
            run(command(config, place, [*again, "--ckpt_path=last"]))
            apart = difference(unbroken, curve(place))
            said = ended == -signal.SIGKILL if who != "second" else ended in (0, 2)
            if apart > CLOSE or not said:
                wrong.append(f"{number}: {who} killed, exit code {ended}, losses apart by {apart:.1e}: {told.strip()[-200:]}")
                print(wrong[-1], flush=True)
            advance()
    return {"kills": count, "seed": seed, "wrong": wrong}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/distributed.json")
    parser.add_argument("--mocap", help="folder of prepared recordings; without it human motion is left out")
    parser.add_argument("--parts", nargs="+", choices=("losses", "throughput", "kills"), default=["losses", "throughput", "kills"])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    out = Path(options.out)
    found: dict[str, Any] = json.loads(out.read_text("utf-8")) if out.is_file() else {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in options.parts:
            match part:
                case "losses":
                    found[part] = losses(folder / part, options.mocap)
                case "throughput":
                    found[part] = throughput(folder / part)
                case _:
                    found[part] = kills(folder / part, options.kills, options.seed)
            found["machine"] = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
            write_text(out, json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
