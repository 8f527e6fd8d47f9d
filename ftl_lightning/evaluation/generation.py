"""Generation, judgement and optional execution of the evaluated behaviour, batched over tasks."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ftl_lightning.data.features import InitialStates, join, moved
from ftl_lightning.domains.domain import Domain, closed_loop_of
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, sampled_plans
from ftl_lightning.evaluation.evaluable import Evaluable
from ftl_lightning.evaluation.judged import TaskResult, executed
from ftl_lightning.evaluation.summary import OWN
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import EVALUATION_SEED, generator, task_key
from ftl_lightning.services.validation import MOST_TOGETHER, check_count, check_range


@dataclass(frozen=True)
class Generation:
    """Settings of generation.

    Attributes:
        samples: number of samples per task; 50 in the paper.
        sampler: ``'ddpm'`` (the paper's), ``'ddim'`` or ``'dpm_solver'``.
        steps: number of sampler steps, at most the model's T.
        temperature: the paper's alpha.
        environments: alternative environments of the domain in which plans are also executed; outcomes there are separate metrics,
            such as ``closed loop success (step veto)``.
        replan: number of steps before replanning; 1 in the paper.
        seed: seed of the samples.

    Raises:
        UserError: at construction, naming the key below ``evaluation``, for a value out of range.
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
        check_count("evaluation.samples", self.samples, 1, MOST_TOGETHER)
        check_count("evaluation.replan", self.replan, 1)
        check_range("evaluation.seed", self.seed, 0)

    @property
    def sampling(self) -> Sampling:
        """Sampler, steps and temperature."""
        return Sampling(self.sampler, self.steps, self.temperature)

    def noise(self, task: EvaluationTask, *episode: int) -> torch.Generator:
        """Generator of a task's samples, or of the plans of an episode, independent of other tasks."""
        demonstrated = {"new": (), "demonstrated": (1,), "last": (2,)}[task.initial]
        return generator("cpu", self.seed, task_key(task.name), *demonstrated, *episode)


def tasks_of(domain: Domain, suites: Sequence[str], learned: Sequence[str]) -> list[EvaluationTask]:
    """List the evaluated tasks.

    Args:
        domain: domain of the tasks.
        suites: names of suites of the domain.
        learned: names of learned concepts. Concepts outside all suites become tasks if the domain can read them or has no metrics.

    Raises:
        UserError: for an unknown suite.
    """
    for name in suites:
        if name not in domain.concepts.suites:
            raise UserError(f"evaluation.suites: expected some of {', '.join(domain.concepts.suites)}, found {name!r}")
    tasks = [task for name in suites for task in domain.concepts.suites[name].tasks]
    covered = {name for task in tasks for name in task.learned}
    extra = [name for name in learned if name not in covered and (domain.concepts.reads(name) or not domain.metrics)]
    return tasks + [EvaluationTask(OWN, name, learned=(name,)) for name in extra]


def _composed(module: Evaluable, tasks: Iterable[EvaluationTask]) -> dict[EvaluationTask, Composition]:
    """Composition of each task, in order, without tasks whose concepts were not learned."""
    return {task: composition for task in tasks if (composition := module.composition(task))}


@torch.no_grad()
def generate(
    module: Evaluable, tasks: Sequence[EvaluationTask], generation: Generation, root: Path | None = None
) -> list[TaskResult]:
    """Generate and judge behaviour; tasks with equal numbers of samples share a batch.

    Args:
        module: evaluated module.
        tasks: evaluated tasks; tasks whose concepts were not learned are skipped.
        generation: settings.
        root: folder of the user's copy of the data.

    Returns:
        Results of the tasks that are not skipped, without duplicates, in order.

    Raises:
        UserError: for a task that starts in missing demonstrations.
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
    """Initial states of a task; ``None`` if the domain has none."""
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
    """Execute tasks with replanning.

    Args:
        module: evaluated module.
        judged: generated behaviour with the initial states of the episodes.
        generation: settings.

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
    followed = (policy.followed.get(first) for first in firsts)  # None if the first episode failed at reset
    return [
        replace(behaviour, followed=None if plans is None else torch.stack(plans))
        for behaviour, plans in zip(done, followed, strict=True)
    ]
