"""Generation, execution and judgement of the evaluated behaviour, batched over tasks."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self, cast

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import InitialStates, joined_starts, moved
from ftl_lightning.domains.domain import CLOSED, SUCCESS, Domain, closed_loop_of
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, roll_out, sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Point
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError, require, shown
from ftl_lightning.services.randomness import EVALUATION_SEED, generator, task_key
from ftl_lightning.services.validation import MOST_TOGETHER, check_count, check_range
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.method import class_path
from ftl_lightning.training.quality import right_plans

OWN = "own demonstrations"
"""Setting of learned concepts outside all suites."""
WON, LOST = "won against ", "lost against "
"""Prefixes of metrics: share of episodes in which only the method succeeds, or only a policy from the same initial state."""


class Evaluable(Protocol):
    """Module whose behaviour is evaluated."""

    model: ConceptModel
    hparams: Any

    @property
    def domain(self) -> Domain:
        """Domain that judges."""

    @property
    def method(self) -> str:
        """Name of the method."""

    @property
    def form(self) -> str:
        """Form of the method."""

    @property
    def variant(self) -> str:
        """Label of the settings."""

    @property
    def concepts(self) -> tuple[str, ...]:
        """Names of the learned concepts."""

    def composition(self, task: EvaluationTask) -> Composition | None:
        """Composition of a task; ``None`` if a concept was not learned."""

    def demonstrated(self, concept: str) -> Demonstrations | None:
        """Demonstrations of a learned concept."""

    def concept_points(self) -> list[Point]:
        """Points of concept space."""


def evaluable(module: object) -> Evaluable:
    """Check that a module implements :class:`Evaluable`.

    ``isinstance`` does not work: from Python 3.12 on it ignores ``__getattr__``, which provides submodules such as the model.

    Raises:
        UserError: for a module that generates no behaviour.
    """
    members = (*Evaluable.__annotations__, *(name for name in vars(Evaluable) if not name.startswith("_")))
    generates = all(hasattr(module, name) for name in members)
    require(generates, "model.class_path", "a module that generates behaviour", type(module).__name__)
    return cast(Evaluable, module)


def demonstrations_of(task: EvaluationTask, demonstrated: Callable[[str], Demonstrations | None]) -> Demonstrations | None:
    """Concatenate the demonstrations of a task's learned concepts, given by name; ``None`` without any."""
    learned = [demonstrations for name in task.learned if (demonstrations := demonstrated(name)) is not None]
    return concatenate(learned) if len(learned) > 1 else next(iter(learned), None)


@dataclass(frozen=True)
class TaskResult:
    """Behaviour of a task with its judgements.

    Attributes:
        task: evaluated task.
        states: plans ``(sample, horizon, state)``.
        measured: values of the domain's metrics by name: ``(sample,)``, or ``()`` for the whole set; NaN for not applicable.
        starts: initial states of the plans, or ``None``.
        demonstrations: demonstrations of the task's learned concepts, or ``None``.
        rollout: rollout of the plans; ``None`` without execution.
        followed: plan ``(step, horizon, state)`` at each step of the first episode; ``None`` without execution.
        outcomes: the domain's outcomes of the rollout by name ``(sample,)``; names from other environments have a suffix.
        diversity: novelty and coverage, if measured, see :mod:`ftl_lightning.evaluation.references`.
    """

    task: EvaluationTask
    states: Tensor
    measured: Mapping[str, Tensor]
    starts: InitialStates | None = None
    demonstrations: Demonstrations | None = None
    rollout: Rollout | None = None
    followed: Tensor | None = None
    outcomes: Mapping[str, Tensor] = field(default_factory=dict)
    diversity: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        task: EvaluationTask,
        states: Tensor,
        starts: InitialStates | None,
        domain: Domain,
        demonstrations: Demonstrations | None = None,
    ) -> Self:
        """Judge plans by the task's goal."""
        return cls(task, states, domain.measure(task.goal, states, starts), starts, demonstrations)

    def first(self, count: int) -> Self:
        """The first ``count`` samples, to be executed."""
        rows = range(min(count, len(self.states)))
        return replace(self, states=self.states[: len(rows)], starts=None if self.starts is None else self.starts.take([*rows]))

    def executed(self, rollout: Rollout, domain: Domain, environment: str = "", followed: Sequence[Tensor] | None = None) -> Self:
        """Add a rollout, judged by the task's goal; failed episodes are no success.

        Args:
            rollout, domain: episodes, and domain of the task.
            environment: name of an alternative environment, whose outcomes are added to the existing outcomes; empty for the main.
            followed: plan ``(horizon, state)`` at each step of the first episode; ``None`` if it did not begin.
        """
        outcomes = domain.judge(self.task.goal, rollout)
        outcomes |= {SUCCESS: outcomes[SUCCESS] & ~rollout.failed}
        if environment:
            named = {f"{name} ({environment})": values for name, values in outcomes.items()}
            return replace(self, outcomes={**self.outcomes, **named})
        return replace(self, rollout=rollout, outcomes=outcomes, followed=None if followed is None else torch.stack([*followed]))

    @property
    def right(self) -> Tensor | None:
        """Whether each plan is right ``(sample,)``; ``None`` without a success metric."""
        judged = right_plans(self.measured)
        return None if judged is None else judged[1]

    @property
    def values(self) -> dict[str, float]:
        """Value of every metric: metrics of plans, outcomes of execution with prefix ``closed loop``, and diversity.

        Metrics without an applicable plan are omitted.
        """
        plans = {name: share(values) for name, values in self.measured.items() if not values.isnan().all()}
        plans |= {f"{CLOSED} {name}": share(values) for name, values in self.outcomes.items()}
        return plans | {name: value for name, value in self.diversity.items() if name not in plans}


def share(values: Tensor) -> float:
    """Share of true values, or the mean of numbers; NaN is excluded."""
    numbers = values.float()
    return float(numbers[~numbers.isnan()].mean())


def standard_error(values: Sequence[float]) -> float:
    """Standard error of the mean over tasks; 0 for a single task."""
    count = len(values)
    return float(torch.tensor(values).std() / count**0.5) if count > 1 else 0.0


def paired(generated: TaskResult, reference: TaskResult, policy: str, domain: Domain) -> dict[str, Tensor]:
    """Compare a method with a policy from the same initial states: episodes ``(sample,)`` in which only the method, or only the
    policy, succeeds.

    The domain's headline metric defines success if it is an outcome.

    Returns:
        Episodes won and lost by metric name, in each environment in which both acted.
    """
    name = domain.comparison.headline.removeprefix(f"{CLOSED} ")
    decisive = name if name != domain.comparison.headline else SUCCESS
    episodes: dict[str, Tensor] = {}
    for outcome, by_method in generated.outcomes.items():
        if outcome in reference.outcomes and (outcome == decisive or outcome.startswith(f"{decisive} (")):
            by_policy, named = reference.outcomes[outcome], f"{policy}{outcome.removeprefix(decisive)}"
            episodes |= {f"{WON}{named}": by_method & ~by_policy, f"{LOST}{named}": by_policy & ~by_method}
    return episodes


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
    """List the evaluated tasks of suites, by name.

    Learned concepts outside all suites become tasks if the domain can read their names or has no metrics.

    Raises:
        UserError: for an unknown suite.
    """
    known = domain.concepts.suites
    for name in suites:
        require(name in known, "evaluation.suites", f"some of {', '.join(known)}", shown(name))
    tasks = [task for name in suites for task in known[name].tasks]
    covered = {name for task in tasks for name in task.learned}
    extra = [name for name in learned if name not in covered and (domain.concepts.reads(name) or not domain.metrics)]
    return tasks + [EvaluationTask(OWN, name, learned=(name,)) for name in extra]


def _compositions(module: Evaluable, tasks: Iterable[EvaluationTask]) -> dict[EvaluationTask, Composition]:
    """Composition of each task, in order, without tasks whose concepts were not learned."""
    return {task: composition for task in tasks if (composition := module.composition(task))}


@torch.no_grad()
def generate(
    module: Evaluable, tasks: Sequence[EvaluationTask], generation: Generation, root: Path | None = None
) -> list[TaskResult]:
    """Generate and judge behaviour; tasks with equal numbers of samples share a batch.

    Args:
        module, tasks, generation: evaluated module, tasks, and settings; tasks whose concepts were not learned are skipped.
        root: folder of the user's copy of the data.

    Returns:
        Results of the tasks that are not skipped, without duplicates, in order.

    Raises:
        UserError: for a task that starts in missing demonstrations.
    """
    model, domain = module.model, module.domain
    compositions = _compositions(module, tasks)
    demonstrations = {task: demonstrations_of(task, module.demonstrated) for task in compositions}
    starts = {task: _starts(task, domain, demonstrations[task], generation, root) for task in compositions}
    counts = {task: generation.samples if where is None else len(where) for task, where in starts.items()}
    judged: dict[EvaluationTask, TaskResult] = {}
    for count in dict.fromkeys(counts.values()):
        batch = [task for task in compositions if counts[task] == count]
        noise = [generation.noise(task) for task in batch]
        observed = joined_starts([where for task in batch if (where := starts[task]) is not None]).observed
        together = [compositions[task] for task in batch]
        plans = model.sample(together, count, generation.sampling, noise, moved(observed, model.device)).cpu()
        expected = (len(together), count, model.horizon, len(domain.plans.columns))
        require(plans.shape == expected, f"{class_path(type(model))}.sample", f"plans {expected}", tuple(plans.shape))
        for task, states in zip(batch, plans, strict=True):
            judged[task] = TaskResult.of(task, states, starts[task], domain, demonstrations[task])
    return [judged[task] for task in compositions]


def _starts(
    task: EvaluationTask, domain: Domain, demonstrations: Demonstrations | None, generation: Generation, root: Path | None
) -> InitialStates | None:
    """Initial states of a task; ``None`` if the domain has none."""
    if not domain.observed:
        return None
    if task.initial == "new":
        return domain.source(root).starts(task.goal, generation.samples, EVALUATION_SEED + generation.seed)
    if demonstrations is None:
        raise UserError(f"evaluation task {task.goal!r}: initial: expected demonstrations of {task.learned[0]!r}, found none")
    if task.initial == "last":
        return demonstrations.final_states.take([sample % len(demonstrations) for sample in range(generation.samples)])
    return demonstrations.initial_states


@torch.no_grad()
def execute(module: Evaluable, judged: Sequence[TaskResult], generation: Generation) -> list[TaskResult]:
    """Execute all judged tasks in parallel with replanning, in the domain's main and the alternative environments.

    Raises:
        UserError: for a domain without an environment.
    """
    model, domain, loop = module.model, module.domain, closed_loop_of(module.domain)
    starts = joined_starts([behaviour.starts for behaviour in judged if behaviour.starts is not None])
    compositions = _compositions(module, (behaviour.task for behaviour in judged))
    counts = [len(behaviour.states) for behaviour in judged]
    episodes = [(behaviour.task, episode) for behaviour in judged for episode in range(len(behaviour.states))]
    executed = list(judged)
    for environment in ("", *generation.environments):
        noise = [generation.noise(task, episode) for task, episode in episodes]
        plans = sampled_plans(model, [compositions[task] for task, _ in episodes], generation.sampling, noise)
        policy = PlanFollower(plans, planner(model, loop), generation.replan)
        rollouts = roll_out(loop.inside(environment), starts, policy).split(counts)
        firsts = itertools.accumulate(counts[:-1], initial=0)  # number of each task's first episode
        executed = [
            behaviour.executed(rollout, domain, environment, policy.followed.get(first))
            for behaviour, rollout, first in zip(executed, rollouts, firsts, strict=True)
        ]
    return executed
