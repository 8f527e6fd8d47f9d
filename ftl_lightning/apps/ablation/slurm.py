"""Array jobs of Slurm for a grid: scripts for sbatch, whose stages depend on earlier scripts only."""

import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from ftl_lightning.apps.ablation.plan import CPUS, GPUS, MEMORY, Cell, Stage
from ftl_lightning.services import trust
from ftl_lightning.services.errors import UserError, require, shown
from ftl_lightning.services.tensor_file import write_text

MOST_JOBS = 1000  #: Maximum jobs of an array by Slurm's default.
RESERVED = ("array", "ntasks", "wrap")  #: Options of sbatch that the scripts set.
_CPUS = "cpus-per-task"
_OPTION = re.compile(r"[a-z][a-z-]{0,39}")
_VALUE = re.compile(r"[\w.,:/@%+=\[\]*-]{0,200}")  #: Values of options: no characters that end a line or begin another word.


@dataclass(frozen=True)
class Wave:
    """Numbers of stages that can run in parallel, and their cells."""

    numbers: tuple[int, ...]
    cells: tuple[Cell, ...]

    def __str__(self) -> str:
        return f"{'stage' if len(self.numbers) == 1 else 'stages'} {', '.join(map(str, self.numbers))}"


def waves(plan: Mapping[int, Sequence[Cell]]) -> list[Wave]:
    """Group stages by number: a group begins when a cell reads an output of the previous group, such as a pretrained model."""
    groups: list[list[int]] = []
    outputs: set[str] = set()
    for number, cells in plan.items():
        if not groups or any(_reads(cell, outputs) for cell in cells):
            groups.append([])
            outputs = set()
        groups[-1].append(number)
        outputs |= {cell.options["model.output"] for cell in cells if "model.output" in cell.options}
    grouped = [Wave(tuple(group), tuple(cell for number in group for cell in plan[number])) for group in groups]
    return [wave for wave in grouped if wave.cells]


def _reads(cell: Cell, made: set[str]) -> bool:
    values = [value for key, value in cell.options.items() if key != "model.output"]
    return any(value == path or value.startswith(f"{path}/") for value in values for path in made)


def script(wave: Wave, plan: Path, folder: Path, jobs: int = 0, options: Mapping[str, str] = {}) -> str:
    """Script of an array, in which each job runs a shard of the cells of a wave.

    Args:
        plan, folder: the plan's configuration file, and the working folder of the jobs; all machines share both.
        jobs: number of jobs; 0 for a job per cell, at most :data:`MOST_JOBS`.
        options: options of sbatch by name; empty values for flags. Options that sbatch could misread are refused.
    """
    jobs = min(jobs or MOST_JOBS, len(wave.cells))
    cpus = math.ceil(max(cell.resources.cpus for cell in wave.cells)) or 1
    name = re.sub(r"[^\w.-]+", "_", Path(plan.stem).stem)
    lines = {"job-name": name, "array": f"1-{jobs}", "ntasks": "1", _CPUS: f"{cpus}", **_booked(wave.cells), **_checked(options)}
    header = [f"#SBATCH --{name}={value}" if value else f"#SBATCH --{name}" for name, value in lines.items()]
    trusted = [word for name in sorted(trust.trusted_names()) for word in (trust.OPTION, name)]
    only = f"[{', '.join(map(str, wave.numbers))}]"
    command = [sys.executable, "-m", "ftl_lightning", "ablate", "--config", str(plan), "--only", only, *trusted]
    body = [
        "set -euo pipefail",
        ': "${SLURM_ARRAY_TASK_ID:?submit this file by sbatch}"',
        f"cd -- {shlex.quote(str(folder))}",
        f'export OMP_NUM_THREADS="${{OMP_NUM_THREADS:-{lines[_CPUS]}}}"',
        # srun does not inherit the number of processors.
        f'exec srun --ntasks=1 --{_CPUS}={lines[_CPUS]} {shlex.join(command)} --shard "$SLURM_ARRAY_TASK_ID/{jobs}"',
    ]
    comment = f"# {len(wave.cells)} cells ({wave}) in {jobs} jobs; a job that is submitted again leaves out what is in the results."
    return "\n".join(["#!/bin/bash", *header, comment, *body]) + "\n"


def _booked(cells: Sequence[Cell]) -> dict[str, str]:
    """Maximum of each resource over the cells, in whole numbers."""
    if custom := [name for cell in cells for name in cell.resources.custom]:
        raise UserError(f"resources.{custom[0]}: expected {CPUS}, {GPUS} or {MEMORY}, which Slurm knows; name others by --sbatch")
    gpus = math.ceil(max(cell.resources.gpus for cell in cells))
    memory = math.ceil(max(cell.resources.memory_gb for cell in cells) * 1000)
    return ({"gres": f"gpu:{gpus}"} if gpus else {}) | ({"mem": f"{memory}M"} if memory else {})


def _checked(options: Mapping[str, str]) -> dict[str, str]:
    for name, value in options.items():
        allowed = _OPTION.fullmatch(name) and name not in RESERVED
        require(allowed, "sbatch", f"options of sbatch without {', '.join(RESERVED)}, such as partition", shown(name))
        readable = isinstance(value, str) and _VALUE.fullmatch(value) and (name != _CPUS or value.isdigit())
        require(readable, f"sbatch.{name}", "a value of letters, digits and .,:/@%+=[]*-", shown(value))
    return dict(options)


def write_scripts(
    file: str | Path,
    stages: Sequence[Stage],
    plan: Mapping[int, Sequence[Cell]],
    keys: Mapping[str, object],
    jobs: int = 0,
    options: Mapping[str, str] = {},
) -> list[str]:
    """Write the scripts of a grid, and a copy of its plan, so that waiting jobs do not see later changes; return the submit
    commands.

    Args:
        file: output file ``grid.sh``; with several waves ``grid.1.sh``, ``grid.2.sh``. The plan is ``grid.sh.yaml``.
        stages, plan: stages of the plan, and the cells of each by its number.
        keys: keys of the plan's file beside the stages: results, seeds, root.
        jobs, options: as in :func:`script`.
    """
    file, folder = Path(file), Path.cwd()
    written = folder / f"{file}.yaml"
    parts = waves(plan)
    names = [file] if len(parts) == 1 else [file.with_suffix(f".{number}{file.suffix}") for number in range(1, len(parts) + 1)]
    texts = [script(wave, written, folder, jobs, options) for wave in parts]
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
    """Convert to nested lists and dictionaries for YAML."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
