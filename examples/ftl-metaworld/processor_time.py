"""Processor time of one core for demonstrations, pretraining, learning and acting: ``results/cost.json``.

python processor_time.py
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from ftl_metaworld.source import demonstrations

from ftl_lightning import FewShot
from ftl_lightning.cli.main import main as run
from ftl_lightning.domains.registry import load_domain

OUT = Path(__file__).resolve().parent / "results" / "cost.json"
SHOWN, STEPS = 5, 500
"""Demonstrations of a task and steps of pretraining that are measured."""


def seconds(work: Callable[[], Any]) -> float:
    """Processor seconds of this process."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def ran(arguments: list[str]) -> None:
    """Run a command; raises ``SystemExit`` if it fails."""
    if code := run(arguments):
        raise SystemExit(code)


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    out: Path = parser.parse_args().out
    torch.set_num_threads(1)
    tasks = load_domain("ml45").concepts.training
    shown = sum(seconds(partial(demonstrations, task, SHOWN, 5_000_000, lambda: None)) for task in tasks)
    with tempfile.TemporaryDirectory() as folder:
        options = ["--trainer.enable_progress_bar=false", f"--model.output={folder}/model", f"--trainer.default_root_dir={folder}"]
        options += [f"--trainer.logger.save_dir={folder}"]
        fit = ["fit", "--config", "conf/metaworld.yaml", *options]
        few, more = (seconds(partial(ran, [*fit, f"--trainer.max_steps={steps}"])) for steps in (10, 10 + STEPS))
    model = FewShot.from_pretrained("pretrained/ml10", settings="conf/metaworld.yaml")
    task = "pull a drawer open by its handle"
    five, starts = model.domain.source(None).draw(task, 5, 1), model.starts(task, 1)
    learned = seconds(lambda: model.learn(five, name=task))
    acting = seconds(lambda: model.sample(model["reach a goal with the hand"], observed=starts))
    found = {
        "demonstrations, 45 tasks x 50, minutes": shown / SHOWN * 50 / 60,
        "pretraining, 16000 steps, minutes": (more - few) / STEPS * 16000 / 60,
        "learning a task in the form chosen, seconds": learned,
        "a plan of 16 actions, milliseconds": acting * 1000,
    }
    out.write_text(json.dumps({name: round(value, 1) for name, value in found.items()}, indent=1) + "\n", "utf-8")
    print(out.read_text("utf-8"))


if __name__ == "__main__":
    main()
