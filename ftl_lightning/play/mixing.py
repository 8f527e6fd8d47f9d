"""Samples of mixed concepts as films, judged where somebody can judge them."""

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short
from ftl_lightning.few_shot import FewShot
from ftl_lightning.judging import judging_domain
from ftl_lightning.play.films import Json, episode_films, films
from ftl_lightning.play.requests import Sample
from ftl_lightning.play.same import Sampled

STEPS = 10
"""Of the sampler, at most: a slider that moves wants an answer at once."""
JOINED = " and "
"""Between the names of mixed concepts, for domains that read such a text as a goal."""


@dataclass(frozen=True)
class Mixture:
    """Concepts that are mixed.

    Attributes:
        concepts: as they are mixed, their weights included.
        names: of each.
        examples: demonstrations of those that were learned here.
    """

    concepts: Sequence[Composition]
    names: Sequence[str]
    examples: Sequence[Demonstrations] = ()

    @property
    def mixed(self) -> Composition:
        """Their sum."""
        return functools.reduce(operator.add, self.concepts)


def sampling_of(model: FewShot, temperature: float | None = None) -> dict[str, Any]:
    """How samples are made while a person waits: the tuned sampler with few steps, or a quick one in its place."""
    tuned = model.tuned.sampling
    steps = min(tuned.steps, STEPS) if tuned.sampler == "dpm_solver" else STEPS
    return {"sampler": "dpm_solver", "steps": steps, "temperature": tuned.temperature if temperature is None else temperature}


def starts_of(model: FewShot, tasks: Sequence[str], count: int, seed: int) -> tuple[str, InitialStates | None]:
    """Where samples start, and of which task that is: the first that the domain reads; nothing in domains without initial states.

    Raises:
        UserError: if it reads none of them.
    """
    if not model.domain.observed:
        return "", None
    for task in (*filter(None, tasks), *model.training_concepts):
        if model.domain.concepts.reads(task):
            return task, model.starts(task, count, seed)
    raise UserError(f"task: expected one that {model.domain.name} reads, found {short(', '.join(tasks))!r}")


def goal_of(domain: Domain, names: Sequence[str], task: str) -> str:
    """What a mix is judged by: its names joined where the domain reads that, or the task whose scenes were asked for.

    Empty where nobody can say.
    """
    reads = domain.concepts.reads
    return next((text for text in (JOINED.join(names), task) if text and reads(text)), "")


def judge_of(model: FewShot, examples: Sequence[Demonstrations]) -> Domain:
    """The domain that judges samples: of a user's own data with these demonstrations of new concepts beside those of training."""
    base = model.model.examples
    return judging_domain(model.model, [*([] if base is None else [base]), *examples])


def judged(domain: Domain, plans: Demonstrations, goal: str) -> tuple[list[Json], str]:
    """Films of samples, and what share of them is right, in words; empty where nobody judges.

    Args:
        domain: that judges.
        plans: samples.
        goal: what they are judged by; empty for nothing.
    """
    if goal and domain.metrics:
        measured = domain.measure(goal, plans.states, plans.initial_states)
        for name, right in measured.items():
            if right.dtype == torch.bool and right.dim():
                share = float(right.float().mean())
                return films(domain, plans, right.tolist()), f"{share:.0%} right ({name.replace('_', ' ')}: {goal})"
    return films(domain, plans), ""


def samples(model: FewShot, mixture: Mixture, asked: Sample, tasks: Sequence[str]) -> tuple[list[Json], str, Sampled]:
    """Samples of a mix, or episodes in which it is executed.

    Args:
        model: that generates them.
        mixture: of what.
        asked: how many, and how.
        tasks: whose initial states they may start from, the first that the domain reads.

    Returns:
        Films, what is right in words, and how they were made.

    Raises:
        UserError: for a task that the domain does not read, or what cannot be executed.
    """
    judge = judge_of(model, mixture.examples)
    if asked.task:
        judge.expect_goal(asked.task, "task")
    how = sampling_of(model, asked.temperature)
    task, starts = starts_of(model, (asked.task, *tasks), asked.count, asked.seed)
    goal = goal_of(judge, mixture.names, asked.task)
    if not asked.execute:
        plans = model.sample(mixture.mixed, asked.count, starts, seed=asked.seed, **how)
        shown, told = judged(judge, plans, goal)
    elif starts is None:
        raise UserError(f"execute: expected a model whose behaviour is executed, found one of {model.domain.name}")
    else:
        done = model.execute(mixture.mixed, starts, goal, seed=asked.seed, **how)
        outcomes: Mapping[str, torch.Tensor] = model.domain.judge(goal, done.rollout) if goal else {}
        shown = episode_films(model.domain, done.rollout, outcomes)
        told = ", ".join(f"{name} {value:.2f}" for name, value in done.outcomes.items())
        told = f"mean of {asked.count}: {told} ({goal})" if told else ""
    return shown, told, Sampled(count=asked.count, seed=asked.seed, task=task, execute=asked.execute, **how)
