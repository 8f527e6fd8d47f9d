"""Ablations: grids of configurations, each run through the same verbs as by hand, skipping what the results hold already."""

import itertools
import json
import time
from argparse import ArgumentError
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ftl_lightning.errors import UserError

if TYPE_CHECKING:
    from ftl_lightning.lightning_cli import CommandLine


@dataclass(frozen=True)
class Stage:
    """One verb with a grid of options. ``{seed}`` in any value stands for the seed.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: its configuration file.
        options: that all cells share, by their names on the command line.
        grid: options with a list of values each; the cells are their product.
        done: a file whose presence means that the stage need not run, such as a pretrained model; empty for never. It is the
            file alone that counts: remove it after a change of the stage's configuration.
    """

    verb: Literal["fit", "invert"]
    config: str
    options: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, list[Any]] = field(default_factory=dict)
    done: str = ""

    def cells(self, seed: int) -> Iterator[list[str]]:
        """The options of every cell for one seed."""
        for values in itertools.product(*self.grid.values()):
            options = {**self.options, **dict(zip(self.grid, values, strict=True))}
            yield [f"--config={self.config}", *(f"--{key}={_text(value, seed)}" for key, value in options.items())]


def _text(value: Any, seed: int) -> str:
    return (value if isinstance(value, str) else json.dumps(value)).replace("{seed}", str(seed))


def run_ablation(stages: Sequence[Stage], seeds: Sequence[int], results: str) -> None:
    """Run all cells of all seeds, stage after stage; a cell that fails is told at the end and does not stop the others.

    Args:
        stages: in order; a later one may read what an earlier one wrote.
        seeds: each stage runs once a seed.
        results: results file.

    Raises:
        UserError: at the end, naming the cells that failed.
    """
    plan = [(stage, seed, cell) for seed in seeds for stage in stages for cell in stage.cells(seed)]
    failed = []
    start = time.monotonic()
    for number, (stage, seed, cell) in enumerate(plan, start=1):
        left = (time.monotonic() - start) / max(number - 1, 1) * (len(plan) - number + 1)
        ahead = f", about {left / 60:.0f} min left" if number > 1 else ""
        print(f"[{number}/{len(plan)}{ahead}] {stage.verb} {' '.join(cell)}", flush=True)
        try:
            _run(stage, seed, cell, results)
        except (UserError, ArgumentError) as error:
            failed.append(f"{stage.verb} {' '.join(cell)}: {error}")
    if failed:
        raise UserError(f"ablation: {len(failed)} of {len(plan)} cells failed: " + "; ".join(failed))


def _run(stage: Stage, seed: int, cell: list[str], results: str) -> None:
    if stage.done and Path(_text(stage.done, seed)).is_file():
        print("  done before")
        return
    from ftl_lightning.lightning_cli import build  # seconds of import that parsing the plan does not need

    line = build([*cell, f"--evaluation.results={results}"])
    if stage.verb == "invert" and _hash(line) in _known(results):
        print("  in the results already")
        return
    getattr(line.trainer, stage.verb)(line.model, datamodule=line.datamodule)


def _hash(line: "CommandLine") -> str:
    from ftl_lightning.evaluation.evaluator import Evaluator

    callbacks = line.trainer.callbacks  # type: ignore[attr-defined]
    evaluator = next(callback for callback in callbacks if isinstance(callback, Evaluator))
    return evaluator.config_hash(line.model, line.datamodule)


def _known(results: str) -> set[str]:
    from ftl_lightning.evaluation.results import read_rows

    return set(read_rows(results)["config_hash"]) if Path(results).is_file() else set()
