"""Plan of an ablation: stages of a configuration file, their cells, and the resources of each cell."""

import itertools
import json
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ftl_lightning.services.errors import UserError, require, short

CPUS, GPUS, MEMORY = "cpus", "gpus", "memory_gb"  #: Resources of every cluster; others are custom resources of Ray.
GIGABYTE = 10**9
MOST_CELLS = 20_000
"""Maximum number of cells of a stage and a seed."""
_PLACEHOLDER = re.compile(r"\{(\w[^{}\"',\s]*)\}")
_NAME = re.compile(r"[A-Za-z][\w.-]{0,63}")


@dataclass(frozen=True)
class Resources:
    """Resources of a cell.

    Attributes:
        cpus, gpus: number of processors and of GPUs; whole, or a fraction below 1.
        memory_gb: gigabytes of 10^9 bytes; 0 for no request. Slurm enforces the limit, Ray does not.
        custom: custom resources of a Ray cluster by name, such as ``{'big': 1}`` of nodes started with it.
    """

    cpus: float = 1
    gpus: float = 0
    memory_gb: float = 0
    custom: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, amounts: Mapping[str, Any]) -> "Resources":
        """Read resources from a configuration. Raise UserError for an invalid name or amount."""
        for name, amount in amounts.items():
            require(_NAME.fullmatch(name), "resources", f"{CPUS}, {GPUS}, {MEMORY} or a custom resource of the cluster", name)
            number = isinstance(amount, int | float) and not isinstance(amount, bool) and math.isfinite(amount) and amount >= 0
            if name == MEMORY:
                require(number, f"resources.{name}", "a number of 0 or more", amount)
            else:
                whole = number and (amount <= 1 or amount % 1 == 0)
                require(whole, f"resources.{name}", "a whole number of 0 or more, or a fraction of 1", amount)
        custom = {name: amount for name, amount in amounts.items() if name not in (CPUS, GPUS, MEMORY)}
        return cls(amounts.get(CPUS, 1), amounts.get(GPUS, 0), amounts.get(MEMORY, 0), custom)

    def ray(self) -> dict[str, Any]:
        """Options of a Ray task."""
        options: dict[str, Any] = {"num_cpus": self.cpus, "num_gpus": self.gpus}
        if self.memory_gb:
            options["memory"] = int(self.memory_gb * GIGABYTE)
        return options | ({"resources": dict(self.custom)} if self.custom else {})

    def fit(self, node: Mapping[str, float]) -> bool:
        """Whether an idle ``node``, given by its resources in Ray's names (memory in bytes), has these resources."""
        needs = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory_gb * GIGABYTE, **self.custom}
        return all(node.get(name, 0) >= amount for name, amount in needs.items())

    def __str__(self) -> str:
        amounts = {CPUS: self.cpus, GPUS: self.gpus, MEMORY: self.memory_gb, **self.custom}
        return ", ".join(f"{name} {amount:g}" for name, amount in amounts.items() if amount) or "nothing"


@dataclass(frozen=True)
class Cell:
    """Run of a verb with configuration files, options, ``done`` file, name, resources, and the pretraining of its model if the plan
    has it.
    """

    verb: Literal["fit", "invert"]
    configs: tuple[str, ...]
    options: Mapping[str, str]
    done: str
    name: str
    resources: Resources = field(default_factory=Resources)
    pretraining: "Cell | None" = None

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


@dataclass(frozen=True)
class Stage:
    """Verb with a grid of options. In values, ``{seed}`` is replaced by the seed, ``{name}`` by a value of ``each``.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: configuration file, or several files to merge in order.
        name: part of the cells' names, for stages that differ only in their options.
        each: lists of texts by name, for placeholders in other values; the stage runs for their product.
        options, grid: options of all cells by their names on the command line, and lists of values, of whose product each cell has
            one.
        done: file whose presence means that the stage need not run; empty for none. Its content is not checked: remove it after a
            change of the stage's configuration.
        seeds: subset of the ablation's seeds; empty for all.
        resources: resources of each cell on a cluster: ``cpus`` (default 1), ``gpus``, ``memory_gb``, and custom resources of Ray's
            nodes.
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

    def cells(self, seed: int) -> Iterator[Cell]:
        """The cells of a seed. Raise UserError without a configuration file, or for invalid resources."""
        if self.seeds and seed not in self.seeds:
            return
        require(self.config, "config", "a configuration file or a list of them", "none")
        count = math.prod(map(len, (*self.each.values(), *self.grid.values())))
        require(count <= MOST_CELLS, "stages", f"at most {MOST_CELLS} cells of a stage and a seed", str(count))
        files = [self.config] if isinstance(self.config, str) else self.config
        for texts in itertools.product(*self.each.values()):
            names = {"seed": str(seed), **dict(zip(self.each, texts, strict=True))}
            for values in itertools.product(*self.grid.values()):
                options = {**self.options, **dict(zip(self.grid, values, strict=True))}
                filled = {key: _filled(value, names) for key, value in options.items()}
                configs = tuple(_filled(config, names) for config in files)
                first, *added = (Path(config).stem for config in configs)
                given = [*added, *(text for text in texts if text not in (first, *added))]
                varied = [f"{key.partition('.')[2]} {filled[key]}" for key in self.grid]
                parts = [f"{self.verb} {first}", *given, _filled(self.name, names), *varied, f"seed {seed}"]
                name = ", ".join(filter(None, parts))
                yield Cell(self.verb, configs, filled, _filled(self.done, names), name, Resources.read(self.resources))


def _filled(value: Any, names: Mapping[str, str]) -> str:
    """Text of a value, with placeholders replaced. Raise UserError for an unknown placeholder."""
    text = value if isinstance(value, str) else json.dumps(value)
    for name in _PLACEHOLDER.findall(text):
        known = ", ".join(f"{{{known}}}" for known in names)
        require(name in names, f"stages: {short(text)!r}", f"placeholders among {short(known, 80)}", f"{{{short(name)}}}")
    return _PLACEHOLDER.sub(lambda match: names[match[1]], text)


def part(plan: Sequence[Sequence[Cell]], shard: str) -> list[list[Cell]]:
    """Shard i of n (``'i/n'``) of a plan: every n-th cell, counted across stages. Raise UserError for an invalid shard."""
    match = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if not match or int(match[1]) > int(match[2]):
        raise UserError(f"shard: expected 'number/shards' such as 3/8, found {short(shard)!r}")
    number, shards = int(match[1]), int(match[2])
    position = itertools.count()
    return [[cell for cell in cells if next(position) % shards == number - 1] for cells in plan]
