"""The plan of an ablation: stages of a configuration file, and their cells."""

import itertools
import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ftl_lightning.apps.ablation.resources import Resources, read_resources
from ftl_lightning.services.errors import UserError


@dataclass(frozen=True)
class Stage:
    """A verb with a grid of options. In values, ``{seed}`` stands for the seed, ``{name}`` for a value of ``each``.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: configuration file, or several files to merge in order.
        name: part of the cells' names, for stages that differ only in their options.
        each: lists of texts by name, for placeholders in other values; the stage runs for their product.
        options: options of all cells, by their names on the command line.
        grid: lists of values by option; the cells are their product.
        done: file whose presence means that the stage need not run, such as a pretrained model; empty for none. Its content is
            not checked: remove it after a change of the stage's configuration.
        seeds: subset of the ablation's seeds; empty for all.
        resources: resources of each cell on a cluster: ``cpus`` (default 1), ``gpus``, ``memory_gb``, and any resource with which
            the nodes of a Ray cluster were started.
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
        """The configuration files.

        Raises:
            UserError: if there is none.
        """
        if not self.config:
            raise UserError("config: expected a configuration file or a list of them, found none")
        return [self.config] if isinstance(self.config, str) else self.config

    def cells(self, seed: int) -> Iterator["Cell"]:
        """The cells of a seed."""
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
    """A run: verb, configuration files, options, ``done`` file, name and resources."""

    verb: Literal["fit", "invert"]
    configs: tuple[str, ...]
    options: Mapping[str, str]
    done: str
    name: str
    resources: Resources = field(default_factory=Resources)

    @property
    def arguments(self) -> list[str]:
        """Command-line arguments, without the verb."""
        files = [f"--config={config}" for config in self.configs]
        return [*files, *(f"--{key}={value}" for key, value in self.options.items())]

    @property
    def command(self) -> str:
        """Shell command of the cell."""
        return shlex.join(("python", "-m", "ftl_lightning", self.verb, *self.arguments))

    @property
    def folder(self) -> str:
        """The name as a folder name."""
        return re.sub(r"[^\w.+-]+", "_", self.name).strip("_")

    def __str__(self) -> str:
        return self.name


def _text(value: Any, names: Mapping[str, str]) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    for name, standing in names.items():
        text = text.replace(f"{{{name}}}", standing)
    return text


def part(plan: Sequence[Sequence[Cell]], shard: str) -> list[list[Cell]]:
    """Shard i of n (``'i/n'``) of a plan: every n-th cell, counted across stages.

    Raises:
        UserError: for an invalid shard.
    """
    match = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if not match or int(match[1]) > int(match[2]):
        raise UserError(f"shard: expected 'number/shards' such as 3/8, found {shard!r}")
    number, shards = int(match[1]), int(match[2])
    position = itertools.count()
    return [[cell for cell in cells if next(position) % shards == number - 1] for cells in plan]
