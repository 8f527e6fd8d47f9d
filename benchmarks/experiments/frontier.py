"""Accuracy, novelty and coverage of every method as its temperature varies.

    python benchmarks/experiments/frontier.py --domain object_rearrangement --suite validation --out results/frontier.json

Each method (ours in each form) learns the concepts of a suite from five demonstrations for each seed, with the shipped models, and
generates every task with new initial states at each temperature. Rows that exist in the file are not measured again. `python -m
ftl_lightning report` plots ``results/frontier.json``.
"""

import argparse
import importlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from ftl_lightning.apps.lightning_cli import parse
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.comparison import OURS, PAPERS_METHOD, WITH_MODES, Compared
from ftl_lightning.domains.domain import COVERAGE, NOVELTY, Domain
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.generation import Generation, TaskResult, generate
from ftl_lightning.evaluation.references import Real, lines, real_behaviour
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.settings import GROUPS, InversionSettings
from ftl_lightning.reporting.measurements import NOISY, read_frontier, write_frontier
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.shipped import shipped
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.inversion_module import InversionModule

TEMPERATURES = (0.1, 0.3, 0.6, 1.0, 1.5)
NOISE = (0.1, 0.2, 0.4, 0.6, 0.8)
"""Standard deviations of the line *demonstrations with noise*, as shares of those of each column among the demonstrations."""
SAMPLES = 100
"""Plans of each task, and fresh samples that they are to cover."""


@dataclass(frozen=True)
class Form:
    """A method in one of its forms.

    Attributes:
        method: its name in tables, and its form.
        variant: what tells it apart from others of the same method and form; may be empty.
        configs: configuration files of ``invert``, added to one another, where ``{domain}`` stands for the domain.
        changes: of :class:`~ftl_lightning.igm.settings.InversionSettings`, by flat names.
        tempered: whether the temperature matters.
    """

    method: Compared
    variant: str
    configs: tuple[str, ...]
    changes: Mapping[str, Any] = field(default_factory=dict)
    tempered: bool = True


FORMS = {
    "one": Form(PAPERS_METHOD, "", ("conf/{domain}.yaml",)),
    "modes": Form(Compared(OURS, WITH_MODES), "", ("conf/{domain}.yaml",), {"modes": "auto"}),
    "BC": Form(Compared("BC"), "", ("conf/bc/{domain}.yaml",), tempered=False),
    "CVAE": Form(Compared("CVAE"), "", ("conf/cvae/{domain}.yaml",)),
    "in-context": Form(Compared("in-context"), "", ("conf/in_context/{domain}.yaml",)),
    "language": Form(Compared("language"), "", ("conf/{domain}.yaml", "conf/method/language.yaml")),
}
"""By name on the command line."""


def adapted(form: Form, config: Mapping[str, Any], demonstrations: Demonstrations, seed: int) -> Adaptation:
    """A method, configured by files, that has learned the concepts of some demonstrations, without a trainer."""
    module_name, _, class_name = config["model"]["class_path"].rpartition(".")
    kind: type[Adaptation] = getattr(importlib.import_module(module_name), class_name)
    arguments = {**config["model"]["init_args"], "seed": seed}
    arguments["pretrained"] = str(shipped(arguments["pretrained"]))
    if issubclass(kind, InversionModule):
        options = {name: GROUPS[name](**value) if name in GROUPS else value for name, value in arguments.items()}
        names = [field.name for field in fields(InversionSettings)]
        settings = InversionSettings(**{name: options[name] for name in names}).changed(**form.changes)
        arguments |= {name: getattr(settings, name) for name in names}
    module = kind(**arguments)
    module.demonstrations = demonstrations.fitted(module.domain.observed)
    module.concepts = tuple(dict.fromkeys(demonstrations.concepts))
    if isinstance(module, InversionModule):
        steps = config["data"]["init_args"]["steps"]
        with bar(f"learning {len(module.concepts)} concepts", steps) as advance:
            module._learned = invert(module.model, module.demonstrations, module.settings, steps, lambda loss: advance())
    else:
        module._learned = module.learned()
    return module


def row(one: TaskResult, domain: Domain, subject: Mapping[str, Any]) -> dict[str, Any]:
    """What the file keeps of a task's plans."""
    values = {name: round(value, 6) for name, value in one.values.items()}
    return {
        **subject,
        "setting": one.task.setting,
        "task": one.task.name,
        "n": len(one.states),
        "accuracy": values.get(domain.main_metric),
        "novelty": values.get(NOVELTY),
        "coverage": values.get(COVERAGE),
    }


def noisy(real: Sequence[Real], seed: int) -> list[tuple[float, TaskResult]]:
    """Demonstrations in turn, each moved as a whole by normal noise, at every level of :data:`NOISE`."""
    draw, found = torch.Generator().manual_seed(seed), []
    for one, level in itertools.product(real, NOISE):
        if one.fresh is not None and (judged := one.replayed()) is not None:
            spread = judged.states.flatten(0, 1).std(dim=0)
            noise = level * spread * torch.randn((len(judged.states), 1, len(spread)), generator=draw)
            found.append((level, one.added(TaskResult.of(one.task, judged.states + noise, judged.starts, one.domain))))
    return found


def measure(domain: Domain, suite: str, form: Form, seed: int, samples: int, out: Path, only: Sequence[str]) -> None:
    """Add what the file does not have of one method and seed."""
    tasks = [task for task in domain.concepts.suites[suite].tasks if task.initial == "new"]
    tasks = [task for task in tasks if not only or task.name in only or task.setting in only]
    run = {"domain": domain.name, "suite": suite, "seed": seed}
    method = {"method": form.method.name, "form": form.method.form, "variant": form.variant}
    known = read_frontier(out)
    known = known[(known["n"] == samples) & _alike(known, {**run, **method})]
    missing = []
    for temperature in TEMPERATURES if form.tempered else (None,):
        own = known[known["temperature"].isna() if temperature is None else known["temperature"] == temperature]
        if not {(task.setting, task.name) for task in tasks} <= set(zip(own["setting"], own["task"], strict=True)):
            missing.append(temperature)
    if not missing:
        return
    config = parse("invert", [f"--config={path.format(domain=domain.name)}" for path in form.configs])
    drawn = InversionData(domain.name, suite, seed=seed).demonstrations
    learned = dict.fromkeys(name for task in tasks for name in task.learned)
    module: Any = adapted(form, config, concatenate([drawn.select(concept) for concept in learned]), seed)
    sampling: dict[str, Any] = {"sampler": "ddpm", "steps": 100}  # the paper's
    for temperature in missing:
        generation = Generation(samples, temperature=temperature or 0.0, seed=seed, **sampling)
        judged = generate(module, tasks, generation)
        real = real_behaviour(judged, domain, seed=seed)
        compared = [behaviour.added(one) for behaviour, one in zip(real, judged, strict=True)]
        ours = [row(one, domain, {**run, **method, "temperature": temperature}) for one in compared]
        reference = {"form": "", "variant": "", "temperature": None}
        beside = [row(one, domain, {**run, **reference, "method": line}) for line, each in lines(real).items() for one in each]
        moved = [row(one, domain, {**run, "method": NOISY, **reference, "temperature": level}) for level, one in noisy(real, seed)]
        write_frontier(out, ours + beside + moved)


def _alike(rows: pd.DataFrame, values: Mapping[str, Any]) -> pd.Series:
    """Which rows have all of some values."""
    return (rows[list(values)] == pd.Series(values)).all(axis=1)


def main() -> None:
    """All methods of a domain, seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domain", default="object_rearrangement")
    parser.add_argument("--suite", default="validation")
    parser.add_argument("--forms", nargs="+", default=list(FORMS), choices=list(FORMS))
    parser.add_argument("--tasks", nargs="+", default=[], help="names of tasks or settings; all of the suite without")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--out", type=Path, default=Path("results/frontier.json"))
    options = parser.parse_args()
    domain = load_domain(options.domain)
    every = [(seed, name) for seed in options.seeds for name in options.forms]
    with bar(f"{domain.name}, {options.suite}: methods and seeds", len(every)) as advance:
        for seed, name in every:
            try:
                measure(domain, options.suite, FORMS[name], seed, options.samples, options.out, options.tasks)
            except UserError as error:  # a baseline that the domain has not, or whose language model is not installed
                print(f"{name}, seed {seed}: left out: {error}")
            advance(1, f"{name}, seed {seed}")


if __name__ == "__main__":
    main()
