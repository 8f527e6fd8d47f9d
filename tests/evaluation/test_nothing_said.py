"""Metrics that say nothing of a plan, or of a goal."""

import pytest
import torch

from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.judged import Judged, share

NAN = torch.nan


def test_plans_of_which_a_metric_says_nothing_do_not_count() -> None:
    assert share(torch.tensor([1.0, NAN, 0.0, NAN])) == pytest.approx(0.5)
    assert share(torch.tensor([True, True, False, False])) == pytest.approx(0.5)


def test_a_metric_that_says_nothing_of_a_goal_is_not_reported() -> None:
    measured = {"right": torch.tensor([True, False]), "level": torch.tensor([NAN, 1.0]), "turned": torch.tensor([NAN, NAN])}
    judged = Judged(EvaluationTask("s", "walk"), torch.zeros(2, 3, 1), measured)
    assert judged.values == {"right": 0.5, "level": 1.0}
