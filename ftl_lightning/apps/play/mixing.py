"""Films of samples of mixed concepts, judged where the domain can judge."""

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ftl_lightning.apps.play.films import Json, episode_films, films
from ftl_lightning.apps.play.requests import Sample
from ftl_lightning.apps.play.same import Sampled
from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.training.quality import judging_domain, right_plans

STEPS = 10
"""Maximum number of sampling steps, so that a moving slider is answered at once."""
JOINED = " and "
"""Separator of the names of mixed concepts, for domains that read the result as a goal."""


@dataclass(frozen=True)
class Mixture:
    """Concepts of a mixture.

    Attributes:
        concepts: compositions multiplied by their weights.
        names: name of each concept.
        examples: demonstrations of concepts learned here.
    """

    concepts: Sequence[Composition]
    names: Sequence[str]
    examples: Sequence[Demonstrations] = ()

    @property
    def mixed(self) -> Composition:
        """Sum of the concepts."""
        return functools.reduce(operator.add, self.concepts)


def sampling_of(model: FewShot, temperature: float | None = None) -> dict[str, Any]:
    """Settings of interactive sampling: the tuned sampler with few steps, or a fast sampler in its place."""
    tuned = model.tuned.sampling
    steps = min(tuned.steps, STEPS) if tuned.sampler == "dpm_solver" else STEPS
    return {"sampler": "dpm_solver", "steps": steps, "temperature": tuned.temperature if temperature is None else temperature}


def starts_of(model: FewShot, tasks: Sequence[str], count: int, seed: int) -> tuple[str, InitialStates | None]:
    """Initial states of samples, and their task: the first that the domain reads; empty in domains without initial states.

    Raises:
        UserError: if the domain reads none of the tasks.
    """
    if not model.domain.observed:
        return "", None
    for task in (*filter(None, tasks), *model.training_concepts):
        if model.domain.concepts.reads(task):
            return task, model.starts(task, count, seed)
    raise UserError(f"task: expected one that {model.domain.name} reads, found {short(', '.join(tasks))!r}")


def goal_of(domain: Domain, names: Sequence[str], task: str) -> str:
    """Goal by which a mixture is judged: the joined names if the domain reads them, else the requested task.

    Empty if samples cannot be judged.
    """
    reads = domain.concepts.reads
    return next((text for text in (JOINED.join(names), task) if text and reads(text)), "")


def judge_of(model: FewShot, examples: Sequence[Demonstrations]) -> Domain:
    """Domain that judges samples: of a user's data, with demonstrations of new concepts beside those of training."""
    base = model.model.examples
    return judging_domain(model.model, [*([] if base is None else [base]), *examples])


def judged(domain: Domain, plans: Demonstrations, goal: str) -> tuple[list[Json], str]:
    """Films of samples, and the fraction of correct samples in words; empty if not judged.

    Args:
        domain: domain that judges.
        plans: samples.
        goal: goal of the samples; empty for none.
    """
    success = right_plans(domain.measure(goal, plans.states, plans.initial_states)) if goal else None
    if success is None:
        return films(domain, plans), ""
    name, right = success
    return films(domain, plans, right.tolist()), f"{float(right.float().mean()):.0%} right ({name.replace('_', ' ')}: {goal})"


def samples(model: FewShot, mixture: Mixture, asked: Sample, tasks: Sequence[str]) -> tuple[list[Json], str, Sampled]:
    """Generate samples of a mixture, or episodes that execute it.

    Args:
        model: generates the samples.
        mixture: concepts of the mixture.
        asked: number of samples, and settings.
        tasks: tasks for initial states; the first that the domain reads is used.

    Returns:
        Films, the judgement in words, and the settings of sampling.

    Raises:
        UserError: for a task that the domain does not read, or if behaviour cannot be executed.
    """
    judge = judge_of(model, mixture.examples)
    if asked.task:
        judge.check_goal(asked.task, "task")
    how = sampling_of(model, asked.temperature)
    task, starts = starts_of(model, (asked.task, *tasks), asked.count, asked.seed)
    goal = goal_of(judge, mixture.names, asked.task)
    if not asked.execute:
        plans = model.sample(mixture.mixed, asked.count, starts, seed=asked.seed, **how)
        shown, verdict = judged(judge, plans, goal)
    elif starts is None:
        raise UserError(f"execute: expected a model whose behaviour is executed, found one of {model.domain.name}")
    else:
        done = model.execute(mixture.mixed, starts, goal, seed=asked.seed, **how)
        outcomes: Mapping[str, torch.Tensor] = model.domain.judge(goal, done.rollout) if goal else {}
        shown = episode_films(model.domain, done.rollout, outcomes)
        verdict = ", ".join(f"{name} {value:.2f}" for name, value in done.outcomes.items())
        verdict = f"mean of {asked.count}: {verdict} ({goal})" if verdict else ""
    return shown, verdict, Sampled(count=asked.count, seed=asked.seed, task=task, execute=asked.execute, **how)
