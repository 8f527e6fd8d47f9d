"""Driving through the command line: inversion, closed loop, mistakes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, Mock

import pandas as pd
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.domain import DOMAIN, POLICIES
from ftl_lightning.domains.driving.expert import SEARCH
from ftl_lightning.domains.driving.foresight import VETOES, Foresight
from ftl_lightning.domains.driving.traffic import BELIEF, SCENARIO, STATE, TRAFFIC, origin, training_set
from ftl_lightning.domains.driving.views import VIEWS
from ftl_lightning.evaluation.closed_loop import planner
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_config import Prepared, find_view
from ftl_lightning.training.model_folder import read_model
from tests import tiny
from tests.conftest import CONF, ROOT, refused, succeed


@pytest.fixture
def short_sighted(monkeypatch: pytest.MonkeyPatch) -> None:
    """An expert that searches a tenth as much, which is enough, and a veto that imagines a tenth as much."""
    monkeypatch.setitem(SEARCH, "roundabout", replace(SEARCH["roundabout"], budget=8))
    monkeypatch.setitem(VETOES, BELIEF, Foresight(2, 2))


def test_the_shipped_demonstrations() -> None:
    train, held_out = training_set("train", 100), training_set("validation", 10)
    assert len(train) == 400
    assert len(held_out) == 40
    starts = {origin(row) for part in (train, held_out) for row in part.initial_states.require_scenes().numpy()}
    assert len(starts) == 440
    assert {name for name, _ in starts} == set(DOMAIN.concepts.training)
    source = DOMAIN.source(None)
    assert torch.equal(source.split("train", 3, 7).states, source.split("train", 3, 0).states)
    for part in (train, held_out):
        assert part.per_step == (TRAFFIC, SCENARIO)
        assert torch.equal(part.observed[TRAFFIC][..., :7], part.states)
        scenario = part.initial_states.require_scenes()[:, None, -2]
        assert torch.equal(part.observed[SCENARIO][..., 0], scenario.expand(part.states.shape[:2]))
    # Each is where the seed in its card puts it.
    again = source.starts("exit", 1, 0)
    assert again is not None
    first = train.select("exit").initial_states.require_scenes()[:1]
    torch.testing.assert_close(first, again.require_scenes(), atol=1e-3, rtol=0)


@pytest.mark.slow
@pytest.mark.usefixtures("short_sighted")
def test_invert_learns_the_roundabout_and_drives_it(tiny_of: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Inverting again, with another K, drives none of the references again."""
    monkeypatch.setattr("ftl_lightning.domains.driving.rendering.BETWEEN", 1)
    made: list[str] = []

    def recorded(name: str, make: Any) -> Any:
        return lambda goal, *rest: (made.append(name), make(goal, *rest))[1]

    for name, make in list(POLICIES.items()):
        monkeypatch.setitem(POLICIES, name, recorded(name, make))
    options = ["--data.steps=2", "--model.budget.samples=2", "--data.demonstrations_per_concept=2", "--evaluation.suites=[paper]"]
    options += ["--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=1", "--evaluation.results=r.csv"]
    options += ["--evaluation.environments=[step veto]", *tiny.QUIET]
    run = ["invert", f"--config={CONF / 'driving.yaml'}", f"--model.pretrained={tiny_of('driving')}", *options]
    succeed(*run)
    rows = pd.read_csv("r.csv", keep_default_na=False)
    ours = rows[rows["K"] == 2]
    names = ("success", "strict success", "crash", "return", "length")
    outcomes = {f"closed loop {name}{veto}" for name in names for veto in ("", " (step veto)")}
    assert outcomes <= set(ours["metric"])
    rest = {metric for metric in set(ours["metric"]) - outcomes if not metric.startswith(("won against", "lost against"))}
    assert rest == {"novelty"}
    regressions = ("nearest demonstration", "ridge regression", "MLP regression")
    policies = ("IDLE", "random", "FASTER", *regressions, "expert (oracle)")
    assert sorted(set(made)) == sorted(policies) == sorted(POLICIES)
    for outcome in ("won", "lost"):
        shown = {metric for metric in set(ours["metric"]) if metric.startswith(outcome)}
        assert shown == {f"{outcome} against {name}{veto}" for name in policies for veto in ("", " (step veto)")}
    value = rows.set_index(["method", "metric"])["value"]
    for veto in ("", " (step veto)"):
        for name in policies:  # what only the one wins, less what only the other does, is the difference of their rates
            won, lost = (value["FTL-IGM", f"{outcome} against {name}{veto}"] for outcome in ("won", "lost"))
            rates = [value[method, f"closed loop strict success{veto}"] for method in ("FTL-IGM", name)]
            assert won - lost == pytest.approx(rates[0] - rates[1])
        oracle = rows[(rows["method"] == "expert (oracle)") & (rows["metric"] == f"closed loop strict success{veto}")]
        assert oracle["value"].tolist() == [1.0]
    before = list(made)
    succeed(*run, "--model.components=1", "--evaluation.figures=0")
    assert made == before
    rows = pd.read_csv("r.csv", keep_default_na=False)
    assert set(rows[rows["K"] > 0]["K"]) == {1, 2}
    assert set(rows[rows["K"] == 0]["method"]) == set(POLICIES)


def test_the_shipped_model_knows_the_training_scenarios() -> None:
    """On held-out episodes its next states are nearer than those of a vehicle that keeps its speed."""
    shipped = read_model(GenerativeModel, ROOT / "pretrained" / "driving")
    assert DOMAIN.closed_loop is not None
    assert planner(shipped, DOMAIN.closed_loop) is VIEWS["steps"].act
    for name in ("highway", "merge"):
        held = training_set("validation", 10).select(name)
        rows = [(row, time) for row, length in enumerate(held.lengths.tolist()) for time in range(length - 1)]
        at, when = torch.tensor(rows).T
        now = {name: values[at, when] for name, values in held.observed.items()}
        following = torch.stack([held.states[row, time + 1] for row, time in rows])
        concept, draw = [Composition(shipped.concept(name)[None, None], torch.tensor([1.2]))], [generator("cpu", 0)]
        plans = shipped.sample(concept, len(rows), Sampling("dpm_solver", 5, 0.0), draw, now)[0]
        kept = now[TRAFFIC][:, :STATE].clone()
        kept[:, 1:3] += kept[:, 3:5]  # decisions are a second apart
        assert (plans[:, 1] - following).norm(dim=1).mean() < 0.9 * (kept - following).norm(dim=1).mean()


@pytest.mark.usefixtures("short_sighted")
def test_generate_writes_what_invert_reads() -> None:
    succeed("generate", "driving", "--task=roundabout", "--count=1", "--out=demos.safetensors")
    found = InversionData("driving", demonstrations="demos.safetensors").demonstrations
    assert found.states.shape[2] == 7
    assert {name: values.shape[2:] for name, values in found.observed.items()} == {TRAFFIC: (35,), SCENARIO: (1,)}
    assert found.scenes is not None
    assert found.scenes.shape == (1, 37)


def test_mistakes_and_a_file_whose_states_do_not_fit(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"data.samples_per_concept: expected at most 100 episodes"):
        training_set("train", 101)
    with pytest.raises(UserError, match=r"model.view: expected one of '', 'map', 'steps', 'standing'"):
        find_view(DOMAIN, "mirror")
    config = read_model(GenerativeModel, ROOT / "pretrained" / "driving").config
    with pytest.raises(UserError, match=r"model.perturb: expected a view that can"):
        GenerativeModel(Prepared(replace(config, view="map", perturb=True), DOMAIN, Mock(), MagicMock()))
    environments = "evaluation.environments: expected one of simulation veto, step veto, found 'crystal ball'"
    with pytest.raises(UserError, match=environments):
        Evaluator(environments=["crystal ball"]).on_fit_start(Mock(), Mock(domain=DOMAIN, model=Mock(max_steps=100)))
    refused(capsys, ["generate", "driving", "--task=motorway"], "driving task: expected one of highway")
    refused(capsys, ["generate", "driving", "--task=merge", "--workers=0"], "workers: expected 1 or more")
    seen = {TRAFFIC: torch.zeros(1, 9, 35), SCENARIO: torch.zeros(1, 9, 1)}
    more = {"observed": seen, "per_step": (TRAFFIC, SCENARIO), "scenes": torch.zeros(1, 37), "concepts": ("roundabout",)}
    wide = Demonstrations(torch.zeros(1, 9, 8), torch.tensor([9]), "driving", tuple("abcdefgh"), ("",) * 8, **more)  # type: ignore[arg-type]
    wide.save("wide.safetensors")
    with pytest.raises(UserError, match=r"expected states of 7 columns \(driving\), found 8"):
        InversionData("driving", demonstrations="wide.safetensors")
