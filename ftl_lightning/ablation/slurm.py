"""A grid as array jobs of Slurm: scripts for sbatch, each a set of stages whose cells wait for nothing but earlier scripts."""

import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from ftl_lightning import trust
from ftl_lightning.ablation.plan import Cell, Stage
from ftl_lightning.ablation.resources import CPUS, GPUS, MEMORY
from ftl_lightning.errors import UserError, shown
from ftl_lightning.tensor_file import write_text

MOST_JOBS = 1000
"""Of an array, in Slurm's own default."""
OWN = ("array", "ntasks", "wrap")
"""Options of sbatch that the scripts set themselves."""
_CPUS = "cpus-per-task"
_OPTION = re.compile(r"[a-z][a-z-]{0,39}")
_VALUE = re.compile(r"[\w.,:/@%+=\[\]*-]{0,200}")
"""What stands in a line that sbatch reads: nothing that would end it or begin another word."""


@dataclass(frozen=True)
class Wave:
    """Stages that can run at the same time, by number, and their cells."""

    numbers: tuple[int, ...]
    cells: tuple[Cell, ...]

    def __str__(self) -> str:
        return f"{'stage' if len(self.numbers) == 1 else 'stages'} {', '.join(map(str, self.numbers))}"


def waves(plan: Mapping[int, Sequence[Cell]]) -> list[Wave]:
    """Stages in groups: a group begins where a cell reads what one of the group before writes, such as a pretrained model.

    Args:
        plan: the cells of each stage by its number, in order.
    """
    groups: list[list[int]] = []
    made: set[str] = set()
    for number, cells in plan.items():
        if not groups or any(_reads(cell, made) for cell in cells):
            groups.append([])
            made = set()
        groups[-1].append(number)
        made |= {cell.options["model.output"] for cell in cells if "model.output" in cell.options}
    found = [Wave(tuple(group), tuple(cell for number in group for cell in plan[number])) for group in groups]
    return [wave for wave in found if wave.cells]


def _reads(cell: Cell, made: set[str]) -> bool:
    values = [value for key, value in cell.options.items() if key != "model.output"]
    return any(value == one or value.startswith(f"{one}/") for value in values for one in made)


def script(wave: Wave, plan: Path, folder: Path, jobs: int = 0, options: Mapping[str, str] = {}) -> str:
    """The script of one array, whose every job runs a shard of the cells.

    Args:
        wave: of the plan.
        plan: the plan's configuration file.
        folder: that all machines share; the jobs run in it.
        jobs: of the array; 0 for one for each cell, at most :data:`MOST_JOBS`.
        options: of sbatch by name; an empty value for one that takes none.

    Raises:
        UserError: for an option that could be misread, or a resource that Slurm does not know.
    """
    jobs = min(jobs or MOST_JOBS, len(wave.cells))
    cpus = math.ceil(max(cell.resources.cpus for cell in wave.cells)) or 1
    name = re.sub(r"[^\w.-]+", "_", Path(plan.stem).stem)
    lines = {"job-name": name, "array": f"1-{jobs}", "ntasks": "1", _CPUS: f"{cpus}", **_asked(wave.cells), **_checked(options)}
    header = [f"#SBATCH --{name}={value}" if value else f"#SBATCH --{name}" for name, value in lines.items()]
    trusted = [word for name in sorted(trust.vouched()) for word in (trust.OPTION, name)]
    only = f"[{', '.join(map(str, wave.numbers))}]"
    command = [sys.executable, "-m", "ftl_lightning", "ablate", "--config", str(plan), "--only", only, *trusted]
    body = [
        "set -euo pipefail",
        ': "${SLURM_ARRAY_TASK_ID:?submit this file by sbatch}"',
        f"cd -- {shlex.quote(str(folder))}",
        f'export OMP_NUM_THREADS="${{OMP_NUM_THREADS:-{lines[_CPUS]}}}"',
        # srun does not take over the number of processors by itself.
        f'exec srun --ntasks=1 --{_CPUS}={lines[_CPUS]} {shlex.join(command)} --shard "$SLURM_ARRAY_TASK_ID/{jobs}"',
    ]
    told = f"# {len(wave.cells)} cells ({wave}) in {jobs} jobs; a job that is submitted again leaves out what is in the results."
    return "\n".join(["#!/bin/bash", *header, told, *body]) + "\n"


def _asked(cells: Sequence[Cell]) -> dict[str, str]:
    """What the cell that books most of it books, in whole numbers."""
    if own := next((cell for cell in cells if cell.resources.custom), None):
        name = next(iter(own.resources.custom))
        raise UserError(f"resources.{name}: expected {CPUS}, {GPUS} or {MEMORY}, which Slurm knows; name others by --sbatch")
    gpus = math.ceil(max(cell.resources.gpus for cell in cells))
    memory = math.ceil(max(cell.resources.memory_gb for cell in cells) * 1000)
    return ({"gres": f"gpu:{gpus}"} if gpus else {}) | ({"mem": f"{memory}M"} if memory else {})


def _checked(options: Mapping[str, str]) -> dict[str, str]:
    for name, value in options.items():
        if not _OPTION.fullmatch(name) or name in OWN:
            raise UserError(f"sbatch: expected options of sbatch without {', '.join(OWN)}, such as partition, found {shown(name)}")
        if not isinstance(value, str) or not _VALUE.fullmatch(value) or (name == _CPUS and not value.isdigit()):
            raise UserError(f"sbatch.{name}: expected a value of letters, digits and .,:/@%+=[]*-, found {shown(value)}")
    return dict(options)


def write_scripts(
    file: str | Path,
    stages: Sequence[Stage],
    plan: Mapping[int, Sequence[Cell]],
    keys: Mapping[str, object],
    jobs: int = 0,
    options: Mapping[str, str] = {},
) -> list[str]:
    """Write a grid's scripts, and beside them its plan as it stands now: changes of its file do not reach jobs that wait.

    Args:
        file: to write, ``grid.sh``; with several waves ``grid.1.sh``, ``grid.2.sh``. The plan is ``grid.sh.yaml``.
        stages: of the plan.
        plan: the cells of each stage by its number.
        keys: of the plan's file beside the stages: results, seeds, root.
        jobs: of each array; 0 for one for each cell.
        options: of sbatch.

    Returns:
        The commands that submit them, in order.

    Raises:
        UserError: as :func:`script`; nothing is written.
    """
    file, folder = Path(file), Path.cwd()
    written = folder / f"{file}.yaml"
    found = waves(plan)
    names = [file] if len(found) == 1 else [file.with_suffix(f".{number}{file.suffix}") for number in range(1, len(found) + 1)]
    texts = [script(wave, written, folder, jobs, options) for wave in found]
    content = {**keys, "stages": [_plain(asdict(stage)) for stage in stages]}
    write_text(written, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    commands = []
    for number, (name, content_of) in enumerate(zip(names, texts, strict=True), 1):
        write_text(name, content_of)
        after = f"--dependency=afterok:${{job{number - 1}%%;*}} " if number > 1 else ""
        submit = f"sbatch --parsable {after}{shlex.quote(str(name))}"
        commands.append(f"job{number}=$({submit})" if len(names) > 1 else f"sbatch {shlex.quote(str(name))}")
    return commands


def _plain(value: object) -> object:
    """Lists and dicts all the way down, as YAML has them."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, list | tuple) else value
