"""The plan of an ablation: stages as they stand in a configuration file, and the cells that they come to."""

import itertools
import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ftl_lightning.ablation.resources import Resources, read_resources
from ftl_lightning.errors import UserError


@dataclass(frozen=True)
class Stage:
    """One verb with a grid of options. ``{seed}`` in any value stands for the seed, ``{name}`` for a value of ``each``.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: its configuration file, or several that are added to one another in order.
        name: stands in the names of the cells, for stages that differ in their options alone.
        each: names with a list of texts each, which stand in the other values; the stage runs for their product.
        options: that all cells share, by their names on the command line.
        grid: options with a list of values each; the cells are their product.
        done: a file whose presence means that the stage need not run, such as a pretrained model; empty for none. Its content
            is not looked at: remove it after a change of the stage's configuration.
        seeds: of the ablation's seeds those that the stage runs for; empty for all.
        resources: that each of its cells books on a cluster: ``cpus`` (1 if it is not named), ``gpus``, ``memory_gb``, and any
            resource that the nodes of a Ray cluster were started with.
    """

    verb: Literal["fit", "invert"]
    config: str | list[str]
    each: Mapping[str, list[str]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, list[Any]] = field(default_factory=dict)
    done: str = ""
    name: str = ""
    seeds: Sequence[int] = ()
    resources: Mapping[str, float] = field(default_factory=dict)

    @property
    def configs(self) -> list[str]:
        """Its configuration files.

        Raises:
            UserError: for none.
        """
        if not self.config:
            raise UserError("config: expected a configuration file or a list of them, found none")
        return [self.config] if isinstance(self.config, str) else self.config

    def cells(self, seed: int) -> Iterator["Cell"]:
        """Every cell for one seed."""
        if self.seeds and seed not in self.seeds:
            return
        for texts in itertools.product(*self.each.values()):
            names = {"seed": str(seed), **dict(zip(self.each, texts, strict=True))}
            for values in itertools.product(*self.grid.values()):
                options = {**self.options, **dict(zip(self.grid, values, strict=True))}
                texts_of = {key: _text(value, names) for key, value in options.items()}
                configs = tuple(_text(config, names) for config in self.configs)
                first, *added = (Path(config).stem for config in configs)
                said = [*added, *(text for text in texts if text not in (first, *added))]
                varied = [f"{key.partition('.')[2]} {texts_of[key]}" for key in self.grid]
                parts = [f"{self.verb} {first}", *said, _text(self.name, names), *varied, f"seed {seed}"]
                name = ", ".join(filter(None, parts))
                yield Cell(self.verb, configs, texts_of, _text(self.done, names), name, read_resources(self.resources))


@dataclass(frozen=True)
class Cell:
    """One run: a verb, its configuration files, options, the file that says that it need not run, its name, and what it books."""

    verb: Literal["fit", "invert"]
    configs: tuple[str, ...]
    options: Mapping[str, str]
    done: str
    name: str
    resources: Resources = field(default_factory=Resources)

    @property
    def arguments(self) -> list[str]:
        """As on the command line, without the verb."""
        files = [f"--config={config}" for config in self.configs]
        return [*files, *(f"--{key}={value}" for key, value in self.options.items())]

    @property
    def command(self) -> str:
        """What runs the cell by hand."""
        return shlex.join(("python", "-m", "ftl_lightning", self.verb, *self.arguments))

    @property
    def folder(self) -> str:
        """The name as that of a folder."""
        return re.sub(r"[^\w.+-]+", "_", self.name).strip("_")

    def __str__(self) -> str:
        return self.name


def _text(value: Any, names: Mapping[str, str]) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    for name, standing in names.items():
        text = text.replace(f"{{{name}}}", standing)
    return text


def part(plan: Sequence[Sequence[Cell]], shard: str) -> list[list[Cell]]:
    """Every n-th cell of each stage of a plan, for shard i of n (``'i/n'``); counting goes on from stage to stage.

    Raises:
        UserError: for another text.
    """
    found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if not found or int(found[1]) > int(found[2]):
        raise UserError(f"shard: expected 'number/shards' such as 3/8, found {shard!r}")
    number, shards = int(found[1]), int(found[2])
    position = itertools.count()
    return [[cell for cell in cells if next(position) % shards == number - 1] for cells in plan]
