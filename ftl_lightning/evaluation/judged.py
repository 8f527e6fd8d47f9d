"""Generated behaviour and what it was judged to be: the one place where metrics are computed from judgements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates, join
from ftl_lightning.domains.domain import CLOSED, SUCCESS, Domain, Policy, closed_loop_of
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.closed_loop import roll_out

WON, LOST = "won against ", "lost against "
"""Metrics of the share of episodes in which only the method succeeds, or only a reference policy from the same initial state."""


@dataclass(frozen=True)
class TaskResult:
    """Generated behaviour of one task.

    Attributes:
        task: what was asked.
        states: plans ``(sample, horizon, state)``.
        measured: what the domain's metrics say of them, by name: ``(sample,)``, or ``()`` for the whole set; NaN where a metric
            says nothing of a plan.
        starts: initial states that they start from, or ``None``.
        rollout: what happened when they were executed, if they were.
        followed: the plan ``(step, horizon, state)`` of each step of the first episode, if they were.
        outcomes: the domain's judgement of that, by name ``(sample,)``; in other environments, with theirs behind it.
        diversity: novelty and coverage, so far as they are known, see :mod:`ftl_lightning.evaluation.diversity`.
    """

    task: EvaluationTask
    states: Tensor
    measured: Mapping[str, Tensor]
    starts: InitialStates | None = None
    rollout: Rollout | None = None
    followed: Tensor | None = None
    outcomes: Mapping[str, Tensor] = field(default_factory=dict)
    diversity: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, task: EvaluationTask, states: Tensor, starts: InitialStates | None, domain: Domain) -> Self:
        """Judge states by the task's goal."""
        return cls(task, states, domain.measure(task.goal, states, starts), starts)

    def executed(self, rollout: Rollout, domain: Domain, environment: str = "") -> Self:
        """Behaviour with its episodes, judged by the task's goal; one whose plan was not finite is no success.

        Args:
            rollout: the episodes.
            domain: whose they are.
            environment: of the domain's others, in which they took place; its outcomes are beside those that there are.
        """
        outcomes = domain.judge(self.task.goal, rollout)
        outcomes |= {SUCCESS: outcomes[SUCCESS] & ~rollout.failed}
        if environment:
            named = {f"{name} ({environment})": values for name, values in outcomes.items()}
            return replace(self, outcomes={**self.outcomes, **named})
        return replace(self, rollout=rollout, outcomes=outcomes)

    def compared(self, diversity: Mapping[str, float]) -> Self:
        """Behaviour with its novelty and coverage."""
        return replace(self, diversity=diversity)

    @property
    def right(self) -> Tensor | None:
        """Whether each plan is right ``(sample,)``, by the first metric that says so; ``None`` if none does."""
        return next((values for values in self.measured.values() if values.dtype == torch.bool and values.dim()), None)

    @property
    def values(self) -> dict[str, float]:
        """Every metric's value: those of plans, what happened when they were executed after ``closed loop``, and diversity.

        Metrics that say nothing of any plan are left out.
        """
        plans = {name: share(values) for name, values in self.measured.items() if not values.isnan().all()}
        plans |= {f"{CLOSED} {name}": share(values) for name, values in self.outcomes.items()}
        return {**plans, **{name: value for name, value in self.diversity.items() if name not in plans}}


def share(values: Tensor) -> float:
    """Share of true values, or the mean of numbers; those that are NaN do not count."""
    from torchmetrics import MeanMetric  # two seconds of import, which tables and films of what was judged do not need

    metric = MeanMetric(nan_strategy="ignore", sync_on_compute=False)  # of several processes one evaluates
    metric.update(values.float())
    return float(metric.compute())


def paired(generated: TaskResult, reference: TaskResult, policy: str, domain: Domain) -> dict[str, Tensor]:
    """In which episodes ``(sample,)`` a method succeeds and a policy, from the same initial state, does not, and the reverse.

    Args:
        generated: what the method did.
        reference: what the policy did.
        policy: its name.
        domain: whose headline decides, if it is an outcome, else success.

    Returns:
        both by their metric's name, in the domain's own environment and in each other in which both acted.
    """
    name = domain.headline.removeprefix(f"{CLOSED} ")
    decisive = name if name != domain.headline else SUCCESS
    episodes: dict[str, Tensor] = {}
    for outcome, by_method in generated.outcomes.items():
        if outcome in reference.outcomes and (outcome == decisive or outcome.startswith(f"{decisive} (")):
            by_policy, named = reference.outcomes[outcome], f"{policy}{outcome.removeprefix(decisive)}"
            episodes |= {f"{WON}{named}": by_method & ~by_policy, f"{LOST}{named}": by_policy & ~by_method}
    return episodes


def standard_error(values: Sequence[float]) -> float:
    """Standard error of the mean over tasks; 0 for a single one."""
    count = len(values)
    return float(torch.tensor(values).std() / count**0.5) if count > 1 else 0.0


def executed(judged: Sequence[TaskResult], policy: Policy, domain: Domain, environment: str = "") -> list[TaskResult]:
    """The same tasks with their episodes, which run all side by side; in the domain's own environment or one of its others.

    Raises:
        UserError: for a domain without an environment.
    """
    loop = closed_loop_of(domain).inside(environment)
    starts = join([behaviour.starts for behaviour in judged if behaviour.starts is not None])
    parts = roll_out(loop, starts, policy).split([len(behaviour.states) for behaviour in judged])
    return [behaviour.executed(part, domain, environment) for behaviour, part in zip(judged, parts, strict=True)]
