"""What five drives teach: agreement of decisions and errors of distance, of policies of which it is known."""

import runpy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from ftl_lightning import FewShot
from ftl_lightning.data.features import Observed
from ftl_lightning.domains.driving import expert
from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.domains.driving.traffic import STATE, TRAFFIC, decision_seconds, training_set
from ftl_lightning.evaluation.closed_loop import PlanFollower
from ftl_lightning.services.randomness import EVALUATION_SEED
from tests.conftest import ROOT

TASK = "roundabout third exit"


@pytest.fixture(scope="module")
def benchmark() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "driving" / "decisions.py"))


@pytest.mark.slow
def test_who_plans_what_the_expert_drives_agrees_and_drives_as_far(
    benchmark: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(expert.SEARCH, TASK, replace(expert.SEARCH[TASK], budget=6))  # whatever the expert decides
    loop = DOMAIN.closed_loop
    assert loop is not None
    starts = DOMAIN.source(None).starts(TASK, 1, EVALUATION_SEED + benchmark["SEED"])
    assert starts is not None
    driven = torch.from_numpy(expert.drive(TASK, int(starts.require_scenes()[0, -1]))[0])[:, 0]
    padded = torch.cat((driven, driven[-1:].expand(8, -1)))

    def known(observed: Observed, rows: list[int]) -> Tensor:
        now = (driven - observed[TRAFFIC][0, :STATE]).norm(dim=1).argmin()
        return padded[None, now : now + 8]

    def standing(observed: Observed, rows: list[int]) -> Tensor:
        return (observed[TRAFFIC][:, :STATE] * torch.tensor([1, 1, 1, 0, 0, 1, 1]))[:, None].expand(-1, 8, -1)

    told = {("known", 0): PlanFollower(known, loop.act, 1), ("standing", 0): PlanFollower(standing, loop.act, 1)}
    found = benchmark["asked"](TASK, starts, "step", told, False)
    knows, stands = (benchmark["summary"]([*found[name], dict(found[name][0], drive=1)]) for name in told)
    assert knows["agreement"] == knows["go"] == 1
    assert knows["metres"] == pytest.approx(0, abs=1e-4)
    assert stands["agreement"] < 1
    three = benchmark["AHEAD"]
    speeds = driven[1:, 3:5].norm(dim=1) * decision_seconds(TASK)
    ways = [float(speeds[step : step + three].sum()) for step in range(len(speeds) - three + 1)]
    assert stands["metres"] == pytest.approx(sum([*ways, ways[0]]) / (len(ways) + 1), rel=1e-4)


def test_go_is_speeding_up_and_wait_is_all_else(benchmark: dict[str, Any]) -> None:
    said = [
        {"drive": drive, "go": go, "agreed": agreed} for drive, go, agreed in ((0.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    ]
    found = benchmark["summary"](said)
    assert found["agreement"] == pytest.approx(2 / 3)
    assert (found["go"], found["wait"]) == (1.0, 0.5)
    assert found["standard error"] == pytest.approx(0.25)


def test_the_held_out_loss_is_least_of_the_concept_that_drives_are_of(benchmark: dict[str, Any]) -> None:
    few = FewShot.from_pretrained("driving")
    drives = training_set("validation", 5).select("merge")
    losses = {name: benchmark["held_out_loss"](few.model, few[name], drives) for name in few.training_concepts}
    assert min(losses, key=lambda name: losses[name]) == "merge"
    assert losses["merge"] == benchmark["held_out_loss"](few.model, few["merge"], drives)  # the same noise every time
