"""Ablations: a grid of configurations, each run through the same verbs as by hand, skipping what the results hold already."""

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ftl_lightning.errors import UserError


@dataclass(frozen=True)
class Stage:
    """One verb with a grid of overrides.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: its configuration file.
        overrides: options that all cells share; ``{seed}`` stands for the seed, in values as in ``done``.
        grid: options with a list of values each; the cells are their product.
        done: a file whose presence means that this stage need not run (a pretrained model); empty for never.
    """

    verb: str
    config: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, list[Any]] = field(default_factory=dict)
    done: str = ""

    def cells(self, seed: int) -> Iterator[list[str]]:
        """The command line of every cell for one seed."""
        for values in itertools.product(*self.grid.values()):
            options = {**self.overrides, **dict(zip(self.grid, values, strict=True))}
            yield [self.verb, "--config", self.config, *(_option(key, value, seed) for key, value in options.items())]


def _option(key: str, value: Any, seed: int) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return f"--{key}={text.replace('{seed}', str(seed))}"
