"""Generating what is evaluated: every task's behaviour in one batch of the network, judged, and executed if it is asked for."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.features import InitialStates, join, moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.domain import Domain, closed_loop_of
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, sampled_plans
from ftl_lightning.evaluation.evaluable import Evaluable
from ftl_lightning.evaluation.judged import TaskResult, executed
from ftl_lightning.evaluation.summary import OWN
from ftl_lightning.ranges import MOST_TOGETHER, expect_count, expect_range
from ftl_lightning.seeding import EVALUATION_SEED, generator, task_key


@dataclass(frozen=True)
class Generation:
    """How behaviour is generated.

    Attributes:
        samples: generated for each task; the paper's number is 50.
        sampler: ``'ddpm'`` (the paper's), ``'ddim'`` or ``'dpm_solver'``.
        steps: of the sampler, at most the model's T.
        temperature: the paper's alpha.
        environments: of the domain's others, in which plans are executed besides its own; outcomes there are metrics of their own,
            such as ``closed loop success (step veto)``.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.
        seed: of the samples.

    Raises:
        UserError: at construction, naming the key below ``evaluation``, for a value that is out of its range.
    """

    samples: int = 50
    sampler: str = "ddpm"
    steps: int = 100
    temperature: float = 0.1
    environments: Sequence[str] = ()
    replan: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        try:
            _ = self.sampling
        except UserError as error:
            raise UserError(f"evaluation.{error}") from None
        for key, value in (("samples", self.samples), ("replan", self.replan)):
            if value < 1:
                raise UserError(f"evaluation.{key}: expected 1 or more, found {value}")
        expect_count("evaluation.samples", self.samples, 1, MOST_TOGETHER)
        expect_count("evaluation.replan", self.replan, 1)
        expect_range("evaluation.seed", self.seed, 0)

    @property
    def sampling(self) -> Sampling:
        """Sampler, steps and temperature."""
        return Sampling(self.sampler, self.steps, self.temperature)

    def noise(self, task: EvaluationTask, *episode: int) -> torch.Generator:
        """What draws a task's samples, or the plans of one of its episodes: it depends on no other task."""
        demonstrated = {"new": (), "demonstrated": (1,), "last": (2,)}[task.initial]
        return generator("cpu", self.seed, task_key(task.name), *demonstrated, *episode)


def tasks_of(domain: Domain, suites: Sequence[str], learned: Sequence[str]) -> list[EvaluationTask]:
    """What is to be evaluated.

    Args:
        domain: whose tasks they are.
        suites: names of suites of the domain, all of whose tasks are evaluated.
        learned: names of learned concepts. Those that no suite asks for are tasks by themselves, if the domain can read them or
            judges nothing.

    Raises:
        UserError: for a suite that the domain has not.
    """
    for name in suites:
        if name not in domain.concepts.suites:
            raise UserError(f"evaluation.suites: expected some of {', '.join(domain.concepts.suites)}, found {name!r}")
    tasks = [task for name in suites for task in domain.concepts.suites[name].tasks]
    asked = {name for task in tasks for name in task.learned}
    others = [name for name in learned if name not in asked and (domain.concepts.reads(name) or not domain.metrics)]
    return tasks + [EvaluationTask(OWN, name, learned=(name,)) for name in others]


def _composed(module: Evaluable, tasks: Iterable[EvaluationTask]) -> dict[EvaluationTask, Composition]:
    """What each task is generated from, in their order; tasks whose concepts were not learned are left out."""
    return {task: composition for task in tasks if (composition := module.composition(task))}


@torch.no_grad()
def generate(
    module: Evaluable, tasks: Sequence[EvaluationTask], generation: Generation, root: Path | None = None
) -> list[TaskResult]:
    """Generate and judge tasks, those with equally many samples in one batch of the network.

    Args:
        module: what generates.
        tasks: what is asked; those whose concepts were not learned are left out.
        generation: how.
        root: folder of the user's copy of the data.

    Returns:
        The tasks that are not left out, each once, in their order.

    Raises:
        UserError: for a task that starts in demonstrations where there are none.
    """
    model, domain = module.model, module.domain
    compositions = _composed(module, tasks)
    starts = {task: _starts(task, module, generation, root) for task in compositions}
    counts = {task: generation.samples if where is None else len(where) for task, where in starts.items()}
    judged: dict[EvaluationTask, TaskResult] = {}
    for count in dict.fromkeys(counts.values()):
        batch = [task for task in compositions if counts[task] == count]
        noise = [generation.noise(task) for task in batch]
        observed = join([where for task in batch if (where := starts[task]) is not None]).observed
        together = [compositions[task] for task in batch]
        plans = model.sample(together, count, generation.sampling, noise, moved(observed, model.device)).cpu()
        for task, states in zip(batch, plans, strict=True):
            judged[task] = TaskResult.of(task, states, starts[task], domain)
    return [judged[task] for task in compositions]


def _starts(task: EvaluationTask, module: Evaluable, generation: Generation, root: Path | None) -> InitialStates | None:
    """Where a task's behaviour starts, or ``None`` where the domain has no initial states."""
    domain = module.domain
    if not domain.observed:
        return None
    if task.initial == "new":
        return domain.source(root).starts(task.goal, generation.samples, EVALUATION_SEED + generation.seed)
    (concept,) = task.learned
    if (demonstrations := module.demonstrated(concept)) is None:
        raise UserError(f"evaluation task {task.goal!r}: initial: expected demonstrations of {concept!r}, found none")
    if task.initial == "last":
        return demonstrations.final_states.take([sample % len(demonstrations) for sample in range(generation.samples)])
    return demonstrations.initial_states


@torch.no_grad()
def execute(module: Evaluable, judged: Sequence[TaskResult], generation: Generation) -> list[TaskResult]:
    """The same tasks with their episodes, in which the model makes new plans on the way.

    Args:
        module: what generated.
        judged: what it generated, with the initial states that episodes start in.
        generation: how.

    Raises:
        UserError: for a domain without an environment.
    """
    model, domain = module.model, module.domain
    act = planner(model, closed_loop_of(domain))
    compositions = _composed(module, (behaviour.task for behaviour in judged))
    episodes = [(behaviour.task, episode) for behaviour in judged for episode in range(len(behaviour.states))]

    def follower() -> PlanFollower:
        noise = [generation.noise(task, episode) for task, episode in episodes]
        concepts = [compositions[task] for task, _ in episodes]
        return PlanFollower(sampled_plans(model, concepts, generation.sampling, noise), act, generation.replan)

    policy = follower()
    done = executed(judged, policy, domain)
    for environment in generation.environments:
        done = executed(done, follower(), domain, environment)
    firsts = itertools.accumulate((len(behaviour.states) for behaviour in judged[:-1]), initial=0)
    followed = (policy.followed.get(first) for first in firsts)  # none where the first episode could not begin
    return [
        replace(behaviour, followed=None if plans is None else torch.stack(plans))
        for behaviour, plans in zip(done, followed, strict=True)
    ]
