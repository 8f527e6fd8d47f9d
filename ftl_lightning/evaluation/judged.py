"""Generated behaviour with its judgements, and the metrics computed from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates, join
from ftl_lightning.domains.domain import CLOSED, SUCCESS, Domain, closed_loop_of
from ftl_lightning.domains.execution import Policy, Rollout
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.closed_loop import roll_out

WON, LOST = "won against ", "lost against "
"""Prefixes of metrics: share of episodes in which only the method succeeds, or only a policy from the same initial state."""


@dataclass(frozen=True)
class TaskResult:
    """Generated behaviour of a task.

    Attributes:
        task: evaluated task.
        states: plans ``(sample, horizon, state)``.
        measured: values of the domain's metrics by name: ``(sample,)``, or ``()`` for the whole set; NaN for not applicable.
        starts: initial states of the plans, or ``None``.
        rollout: rollout of the plans; ``None`` without execution.
        followed: plan ``(step, horizon, state)`` at each step of the first episode; ``None`` without execution.
        outcomes: the domain's outcomes of the rollout by name ``(sample,)``; names from other environments have a suffix.
        diversity: novelty and coverage, if measured, see :mod:`ftl_lightning.evaluation.diversity`.
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
        """Add a rollout, judged by the task's goal; failed episodes are no success.

        Args:
            rollout: episodes.
            domain: domain of the task.
            environment: name of an alternative environment, whose outcomes are added to the existing outcomes; empty for the main.
        """
        outcomes = domain.judge(self.task.goal, rollout)
        outcomes |= {SUCCESS: outcomes[SUCCESS] & ~rollout.failed}
        if environment:
            named = {f"{name} ({environment})": values for name, values in outcomes.items()}
            return replace(self, outcomes={**self.outcomes, **named})
        return replace(self, rollout=rollout, outcomes=outcomes)

    def compared(self, diversity: Mapping[str, float]) -> Self:
        """Set novelty and coverage."""
        return replace(self, diversity=diversity)

    @property
    def right(self) -> Tensor | None:
        """Whether each plan is right ``(sample,)``, by the first boolean metric per plan; ``None`` without such a metric."""
        return next((values for values in self.measured.values() if values.dtype == torch.bool and values.dim()), None)

    @property
    def values(self) -> dict[str, float]:
        """Value of every metric: metrics of plans, outcomes of execution with prefix ``closed loop``, and diversity.

        Metrics without an applicable plan are omitted.
        """
        plans = {name: share(values) for name, values in self.measured.items() if not values.isnan().all()}
        plans |= {f"{CLOSED} {name}": share(values) for name, values in self.outcomes.items()}
        return {**plans, **{name: value for name, value in self.diversity.items() if name not in plans}}


def share(values: Tensor) -> float:
    """Share of true values, or the mean of numbers; NaN is excluded."""
    from torchmetrics import MeanMetric  # slow import, not needed for tables and films

    metric = MeanMetric(nan_strategy="ignore", sync_on_compute=False)  # only rank 0 evaluates
    metric.update(values.float())
    return float(metric.compute())


def paired(generated: TaskResult, reference: TaskResult, policy: str, domain: Domain) -> dict[str, Tensor]:
    """Compare a method with a policy from the same initial states: episodes ``(sample,)`` in which only one of the two succeeds.

    Args:
        generated: behaviour of the method.
        reference: behaviour of the policy.
        policy: name of the policy.
        domain: domain whose headline metric defines success, if it is an outcome.

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


def standard_error(values: Sequence[float]) -> float:
    """Standard error of the mean over tasks; 0 for a single task."""
    count = len(values)
    return float(torch.tensor(values).std() / count**0.5) if count > 1 else 0.0


def executed(judged: Sequence[TaskResult], policy: Policy, domain: Domain, environment: str = "") -> list[TaskResult]:
    """Execute all tasks in parallel, in the domain's main or an alternative environment.

    Raises:
        UserError: for a domain without an environment.
    """
    loop = closed_loop_of(domain).inside(environment)
    starts = join([behaviour.starts for behaviour in judged if behaviour.starts is not None])
    parts = roll_out(loop, starts, policy).split([len(behaviour.states) for behaviour in judged])
    return [behaviour.executed(part, domain, environment) for behaviour, part in zip(judged, parts, strict=True)]
