"""What a domain's author can get wrong is told in one line, not in wrong numbers."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import ClosedLoop, Domain, Metric
from ftl_lightning.domains.object_rearrangement import DOMAIN
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.evaluation.references import references
from ftl_lightning.services.errors import UserError

STATES = torch.zeros(5, 1, 21)
GOAL = "circle right of square"


def with_metric(values: Any) -> Domain:
    return replace(DOMAIN, metrics={"mine": Metric(lambda goal, states, starts: values)})


def test_metrics_judges_and_reference_lines_of_another_shape_are_refused() -> None:
    for wrong in (torch.zeros(5, 5), torch.zeros(3), [True] * 5, STATES.numpy()[:, 0, 0]):
        with pytest.raises(UserError, match=r"metric 'mine': expected a tensor of shape \(5,\) or \(\), found"):
            TaskResult.of(EvaluationTask("s", GOAL), STATES, None, with_metric(wrong))
    for values in (torch.ones(5), torch.tensor(0.5)):  # for each plan, or for all
        assert with_metric(values).measure(GOAL, STATES, None) == {"mine": values}
    rollout = Rollout(InitialStates({}, torch.zeros(2, 1)), {}, torch.zeros(2, dtype=torch.bool), [{}, {}])
    for outcomes, expected in (
        ({"success": torch.ones(2, 2, dtype=torch.bool)}, r"outcome 'success': expected a tensor of shape \(2,\)"),
        ({"crash": torch.ones(2)}, "expected outcomes by name, 'success' among them, found crash"),
        (torch.ones(2), "expected outcomes by name, 'success' among them, found Tensor"),
    ):
        loop = ClosedLoop(lambda: None, lambda plans, step, observed: plans, 1, lambda *_, said=outcomes: said)  # type: ignore[arg-type,misc,return-value]
        with pytest.raises(UserError, match=expected):
            replace(DOMAIN, closed_loop=loop).judge(GOAL, rollout)
    domain = replace(DOMAIN, name="other", references={"mine": lambda goal, count, starts, seed: torch.zeros(count, 2, 21)})
    one = TaskResult.of(EvaluationTask("s", GOAL), STATES, None, domain)
    with pytest.raises(UserError, match=r"reference 'mine': expected plans \(5, 1, 21\), found \(5, 2, 21\)"):
        references([one], domain, 0)


def test_a_misspelt_goal_is_told_with_goals_that_are_near() -> None:
    with pytest.raises(UserError, match="goal: expected a task of agent, such as 'go to red bowl'"):
        load_domain("agent").check_goal("go to red bowll")
