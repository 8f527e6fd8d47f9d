"""Accuracy, diversity, energy score and time of samplers with fewer steps, beside DDPM with all steps, with the models that ship.

    python benchmarks/speed/samplers.py [--domains object_rearrangement agent] [--seeds 0 1 2] [--root FOLDER]

Concepts of each domain's validation suite are learned in the shipped form, for each seed. Every sampler generates plans of the
suite's tasks, compositions with training concepts included, from the same new initial states; where the suite has fewer than
three tasks, those of the training concepts too. A sampler is *equal* if accuracy, diversity and energy score are each at most one
standard error worse than those of DDPM; standard errors are over tasks and seeds, of paired differences. Diversity is the mean
distance between plans from the same state, and the energy score (less is better) that for fresh behaviour from this state. Where
plans are executed, accuracy is that of episodes. Seconds are of processor time for 500 plans, medians of interleaved calls.
``--root`` is the folder of recordings of human motion. What was measured is kept, and a run that is started again goes on from
there. The table has the paper's sampler, the shipped one, and the fastest that is equal.
"""

import argparse
import json
import operator
import time
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

import torch

from ftl_lightning.data.distances import PathFeatures
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.places import first_windows
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.few_shot.tuned import settings_of
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.forms.quality import encoded
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.configuration import load
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.data import InversionData

DOMAINS = ("object_rearrangement", "agent", "driving", "mocap", "tabletop")
STEPS, ANCESTRAL = (5, 10), (5, 7, 10)
"""Steps of DPM-Solver++, and of DDPM beside all."""
TEMPERATURES = {"object_rearrangement": 0.1}
"""Temperature of all steps of DDPM where it is not the shipped one."""
PLANS, FRESH, EACH, TIMED, REPEATS = 50, 20, 8, 500, 3
"""Plans whose accuracy is measured, fresh demonstrations, plans from each of their states, timed plans, and timed calls."""
FEW = 3
"""A suite with fewer tasks is too few for a standard error: the model's training concepts are judged too."""
FRESH_SEED = 4000
"""Seed of fresh demonstrations, which no other part of the program uses."""


def samplers(temperature: float) -> dict[str, Sampling]:
    """By name: DDPM with all steps, and fewer steps, of a low temperature at several."""
    low = 0 < temperature < 0.2
    fewer = [Sampling("dpm_solver", steps, factor * temperature) for steps in STEPS for factor in ((0.5, 1.0) if low else (1.0,))]
    ancestral = [Sampling("ddpm", steps, factor * temperature) for steps in ANCESTRAL for factor in ((1.5, 2.0) if low else (1.0,))]
    every = Sampling("ddpm", 100, temperature), *ancestral, *fewer
    return {f"{each.sampler} {each.steps}, {each.temperature:g}": each for each in every}


def composition(model: FewShot, task: EvaluationTask, learned: Mapping[str, Composition]) -> Composition:
    """Composition of a task, with the shipped weight of training concepts."""
    settings = model.tuned.inversion
    usual = 1.0 if settings.omega == "learned" else settings.omega
    weight = usual if settings.weights.training is None else settings.weights.training
    first, *others = [*(learned[name] for name in task.learned), *(weight * model[text] for text in task.texts)]
    return reduce(operator.add, others, first)


def repeated(states: InitialStates, times: int) -> InitialStates:
    """Each initial state ``times`` times."""
    return states.take(torch.arange(len(states)).repeat_interleave(times))


class Judged:
    """A learned concept that is judged with one sampler after another.

    Args:
        model: model.
        concept: concept.
        goal: task.
        seed: seed of initial states and noise.
        root: folder of recordings; ``None`` where none are needed.
    """

    def __init__(self, model: FewShot, concept: Composition, goal: str, seed: int, root: Path | None) -> None:
        self.model, self.concept, self.goal, self.seed = model, concept, goal, seed
        source, domain = model.domain.source(root), model.domain
        self.starts = source.starts(goal, PLANS, FRESH_SEED + seed) if domain.observed else None
        fresh = source.draw(goal, FRESH, FRESH_SEED + seed)
        self.fresh = fresh.initial_states
        self.truth = encoded(model.model, first_windows(fresh, model.model.horizon), self.fresh)
        self.features = PathFeatures(self.truth)

    def measured(self, sampling: Sampling) -> dict[str, float]:
        """Accuracy, diversity and energy score."""
        options: dict[str, Any] = {"sampler": sampling.sampler, "steps": sampling.steps, "temperature": sampling.temperature}
        domain, many = self.model.domain, repeated(self.fresh, EACH)
        plans = self.model.sample(self.concept, FRESH * EACH, many if domain.observed else None, seed=self.seed + 1, **options)
        paths = encoded(self.model.model, plans.states, many).unflatten(0, (FRESH, EACH))
        flat = paths.flatten(2)
        if domain.comparison.headline.startswith("closed loop") and self.starts is not None:
            outcomes = self.model.execute(self.concept, self.starts, self.goal, seed=self.seed, **options).outcomes
            accuracy = outcomes[domain.comparison.headline.removeprefix("closed loop ")]
        else:
            judged = self.model.sample(self.concept, PLANS, self.starts, seed=self.seed, **options)
            accuracy = self.model.evaluate(judged, self.goal)[domain.main_metric]
        return {
            "accuracy": accuracy,
            "diversity": float(torch.cdist(flat, flat).sum(dim=(1, 2)).mean() / (EACH * (EACH - 1))),
            "energy": float(self.features.scores(paths, self.truth).mean()),
        }

    def seconds(self, sampling: Sampling) -> float:
        """Processor seconds of :data:`TIMED` plans."""
        options: dict[str, Any] = {"sampler": sampling.sampler, "steps": sampling.steps, "temperature": sampling.temperature}
        starts = None if self.starts is None else repeated(self.starts, TIMED // PLANS)
        begun = time.process_time()
        self.model.sample(self.concept, TIMED, starts, **options)
        return time.process_time() - begun


def compared(rows: Sequence[Mapping[str, Any]], name: str, base: str) -> dict[str, Any]:
    """Means of a sampler, and whether it is equal to ``base``."""
    of = {(row["task"], row["seed"]): row for row in rows if row["sampler"] == name}
    pairs = [(of[row["task"], row["seed"]], row) for row in rows if row["sampler"] == base]
    means = {key: round(mean(row[key] for row, _ in pairs), 4) for key in ("accuracy", "diversity", "energy")}
    worse = []
    for key, sign in (("accuracy", 1), ("diversity", 1), ("energy", -1)):
        lost = [sign * (other[key] - row[key]) for row, other in pairs]
        error = stdev(lost) / len(lost) ** 0.5 if len(lost) > 1 else 0.0
        if mean(lost) > error + 1e-9:
            worse.append(key)
    return {**means, "worse": worse}


def measure(domain: str, root: Path | None, seeds: Sequence[int], content: dict[str, Any], out: Path) -> dict[str, float]:
    """Add rows that are missing to ``content``, and write it; return seconds by sampler."""
    rows = content["rows"]
    model = FewShot.from_pretrained(domain)
    kinds = samplers(TEMPERATURES.get(domain, model.tuned.sampling.temperature))
    few = load(settings_of(domain), "invert")["data"]["init_args"].get("demonstrations_per_concept", 5)
    suite = model.domain.concepts.suites["validation"]
    tasks = {
        task.goal: task for task in suite.tasks if task.initial == "new" and task.learned and not task.on and not task.component
    }
    if len(tasks) < FEW:
        tasks |= {text: EvaluationTask("training concept", text, texts=(text,)) for text in model.model.config.training_concepts}
    timed: Judged | None = None
    for seed in seeds:
        known = {(row["task"], row["sampler"]) for row in rows if row["domain"] == domain and row["seed"] == seed}
        missing = [goal for goal in tasks if not {(goal, name) for name in kinds} <= known]
        if not missing and timed:
            continue
        data = InversionData(
            domain, "validation", demonstrations_per_concept=few, seed=seed, root=None if root is None else str(root)
        )
        learned = model.learn_all(data.demonstrations, seed=seed)
        with bar(f"{domain}, seed {seed}", len(missing) * len(kinds)) as advance:
            for goal in missing or list(tasks)[:1]:
                judged = Judged(model, composition(model, tasks[goal], learned), goal, seed, root)
                timed = timed or judged
                for name, sampling in kinds.items() if missing else ():
                    if (goal, name) not in known:
                        rows.append({"domain": domain, "task": goal, "seed": seed, "sampler": name, **judged.measured(sampling)})
                        write_text(out, json.dumps(content, indent=1) + "\n")
                    advance()
    assert timed is not None
    calls: dict[str, list[float]] = {name: [] for name in kinds}
    for turn in range(REPEATS):
        for name in list(kinds) if turn % 2 else reversed(list(kinds)):
            calls[name].append(timed.seconds(kinds[name]))
    return {name: median(each) for name, each in calls.items()}


def markdown(table: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Table of the samplers to choose from."""
    lines = ["| domain | sampler, steps, temperature | accuracy | diversity | energy score | seconds | times as fast |"]
    lines.append("|---" * 7 + "|")
    for domain, kinds in table.items():
        base = next(iter(kinds))
        equal = max((name for name in kinds if not kinds[name]["worse"]), key=lambda name: kinds[name]["faster"])
        shipped = [name for name in kinds if kinds[name]["ships"]]
        for name in dict.fromkeys((base, *shipped, equal)):
            known = kinds[name]
            role = "ships" if name in shipped else "the paper's steps" if name == base else "fastest that is equal"
            worse = known["worse"]
            numbers = [f"{known[key]:.2f}{' (worse)' if key in worse else ''}" for key in ("accuracy", "diversity", "energy")]
            lines.append(f"| {domain} | {name}: {role} | {' | '.join(numbers)} | {known['seconds']:.2f} | {known['faster']:.1f} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", nargs="+", default=list(DOMAINS), choices=DOMAINS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--root", type=Path, help="folder of the recordings of human motion")
    parser.add_argument("--out", type=Path, default=Path("results/samplers.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    content: dict[str, Any] = {"table": {}, "rows": []} | (json.loads(options.out.read_text()) if options.out.is_file() else {})
    rows, table = content["rows"], content["table"]
    for domain in options.domains:
        seconds = measure(domain, options.root if domain == "mocap" else None, options.seeds, content, options.out)
        own = [row for row in rows if row["domain"] == domain]
        base = next(iter(seconds))
        shipped = FewShot.from_pretrained(domain).tuned.sampling
        table[domain] = {
            name: {
                **compared(own, name, base),
                "seconds": round(seconds[name], 3),
                "faster": round(seconds[base] / seconds[name], 1),
                "ships": name == f"{shipped.sampler} {shipped.steps}, {shipped.temperature:g}",
            }
            for name in seconds
        }
        write_text(options.out, json.dumps(content, indent=1) + "\n")
    print(shown := markdown(table))
    write_text(options.out.with_suffix(".md"), shown)


if __name__ == "__main__":
    main()
