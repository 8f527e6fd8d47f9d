"""Counted operations, the model of a step's time, prices, the curve of batching, and equality beside diffusers."""

import importlib
import json
import runpy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import read_model
from tests.conftest import ROOT

Script = Mapping[str, Any]


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> Script:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "speed"))
    return runpy.run_path(str(ROOT / "benchmarks" / "speed" / f"{name}.py"))


def test_operations_of_layers_and_convolutions_bytes_and_calls_are_those_counted_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = script("counting", monkeypatch)["counted"]
    layer, x = nn.Linear(3, 5), torch.ones(7, 3)
    found = counted(lambda: layer(x).sum().backward(), layer.parameters())
    assert found.products == 2 * (2 * 7 * 3 * 5)  # forward, and the gradient of the weight; none of the input is asked for
    assert found.saved == 7 * 3 * 4
    one = counted(lambda: x + x)
    assert (one.calls, one.near, one.far, one.operations) == (1, 3 * 7 * 3 * 4, 0, 0)
    assert counted(lambda: x.T.flatten().view(21)).calls == 1  # flattening what is transposed copies, views do not
    large = torch.ones(2**18, device="meta")
    assert counted(lambda: large.exp()).far == 2 * 2**20
    product, weight = torch.ones(2, 3), torch.ones(3, 4, requires_grad=True)
    work = counted(lambda: (product @ weight).exp().sum().backward())
    heavy = sorted((call.name, times) for call, times in work.heavy.items())
    assert heavy == [("aten.exp.default", 1), *[("aten.mm.default", 1)] * 2]  # forward, and the weight's gradient: other shapes
    assert work.recorded == 4  # product, exponential, sum, and the one that the backward pass starts from
    assert work.backward == work.calls - work.recorded > 0
    layer, x = nn.Conv1d(4, 6, 5, padding=2), torch.ones(2, 4, 8)
    found = counted(lambda: layer(x).sum().backward(), layer.parameters())
    forward = 2 * (2 * 6 * 8) * (4 * 5)
    assert (found.products, found.convolutions, found.gradients) == (0, forward, forward)


def test_a_call_by_itself_takes_the_time_of_its_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    counting = script("counting", monkeypatch)
    operator_time = importlib.import_module("operator_time")  # the same that counting imports
    rows, many, weight = torch.ones(8, 256), torch.ones(2048, 256).T.contiguous().T, torch.ones(256, 256)
    few, much = (next(iter(counting["counted"](lambda x=x: x @ weight).heavy)) for x in (rows, many))
    assert few.arguments[0].shape == (8, 256)
    assert much.arguments[0].strides == (1, 2048)
    assert 0 < operator_time.seconds(few, 0) < operator_time.seconds(much, 2**22)


def test_a_step_of_inversion_multiplies_as_often_as_its_layers_say(monkeypatch: pytest.MonkeyPatch) -> None:
    steps, counting = script("steps", monkeypatch), script("counting", monkeypatch)
    step = steps["ours"]("object_rearrangement").inversion
    made = steps["made"](step)
    layers = 21 * 512 + 3 * 512 * 512 + 512 * 21
    of_time, of_concept = 64 * 64 * 2 + 64 * 4096, 384 * 384 + 384 * 4096
    rows, concepts = 2 * 32, 2
    conditional = rows * layers + 32 * of_time + concepts * of_concept  # both concepts are met at the same timesteps
    backward = rows * (layers - 21 * 512) + concepts * of_concept
    empty = 32 * (layers + of_time) + of_concept
    weighted = 32 * 2 * 21 * 2  # the sum over K, forward and backward
    expected = 2 * (conditional + backward + empty + weighted)
    assert counting["counted"](made.compute, made.parameters).products == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_network_that_no_memory_here_holds_is_counted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    steps, counting = script("steps", monkeypatch), script("counting", monkeypatch)
    step = steps["ours"]("agent").inversion
    small = replace(step, batch=2, config=replace(step.config, horizon=32))
    on_paper, here = (
        counting["counted"](made.compute, made.parameters) for made in (steps["on_paper"](small), steps["made"](small))
    )
    assert on_paper.convolutions == here.convolutions > 0
    assert on_paper.products == here.products > 0  # calls are more: some operators are several there


@pytest.mark.slow
def test_the_model_of_time_finds_what_made_the_times_and_is_checked_on_other_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = script("cost", monkeypatch)
    draw = torch.Generator().manual_seed(0)
    measured, counts = (torch.rand(30, width, generator=draw, dtype=torch.float64) for width in (3, 5))
    rows = torch.cat((measured, 10 ** (9 * counts)), dim=1).tolist()
    true = dict(zip(cost["FITTED"], (1e-11, 1e-10, 0.0, 4e-10, 3e-9), strict=True))
    durations = [sum(row[:3]) + sum(true[name] * value for name, value in zip(true, row[3:], strict=True)) for row in rows]
    found = cost["fitted"](rows, durations)
    assert found == pytest.approx(true, rel=1e-5, abs=1e-15)
    told = cost["with_errors"]([{"step": "a", "seconds": durations[0] / 1.5, "features": rows[0]}], found)
    assert told[0]["error"] == pytest.approx(0.5, abs=1e-4)
    assert cost["errors"](told) == {"mean": 0.5, "median": 0.5, "largest": 0.5, "within ten per cent": 0.0, "steps": 1}
    fit, check = cost["to_fit"](), cost["to_check"]()
    assert len(check) >= 20
    grid = [cost["of_grid"](kind, cost["BASE"]) for kind in ("inversion", "sampling")]
    assert not any(step in (*fit.values(), *grid) for step in check.values())


def test_hours_are_operations_over_rate_or_calls_times_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    price = script("price", monkeypatch)
    machine = price["Machine"](count=1, rate=1e12, bandwidth=1e11, memory=1e9, dollars=2.0, link=1e9)
    reached = price["Reached"](share=0.1, call=1e-5)
    need = price["Needed"](operations=(1e9, 1e9), moved=(0.0, 1e6), calls=1000, saved=(0.0, 1e7), parameters=4e6)
    assert price["step_seconds"](need, 0, machine, reached) == pytest.approx(0.01)  # either: 1,000 calls, or 1e9 operations
    assert price["step_seconds"](need, 9, machine, reached) == pytest.approx(0.1)
    slow = replace(machine, bandwidth=1e7)
    assert price["step_seconds"](need, 9, slow, reached) == pytest.approx(0.9)
    two = replace(machine, count=2)
    assert price["step_seconds"](need, 18, two, reached) == pytest.approx(0.1 + 2 * 1e6 / 1e9)
    assert price["batch_that_fits"](need, machine) == 64  # 4 MB and 64 times 10 MB, of 800 MB
    whole, rest = (price["step_seconds"](need, size, machine, reached) for size in (64, 22))
    hours = price["together"](need, 100, 150, machine, reached)
    assert hours == pytest.approx(100 * (2 * whole + rest) / 3600)


def test_the_table_of_prices_is_what_its_file_says(monkeypatch: pytest.MonkeyPatch) -> None:
    price = script("price", monkeypatch)
    content = json.loads((ROOT / "results" / "price.json").read_text(encoding="utf-8"))
    kept = (ROOT / "results" / "price.md").read_text(encoding="utf-8")
    assert price["table"](content, list(content["machines"])) == kept, "run benchmarks/speed/price.py"


@pytest.mark.parametrize("name", ["peers", "batching", "product_rate", "cost", "fit_options"])
def test_the_tables_of_speed_are_what_their_files_say(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    table = script("speed_table", monkeypatch)["TABLES"][name]
    content = json.loads((ROOT / "results" / f"{name}.json").read_text(encoding="utf-8"))
    assert table(content) == (ROOT / "results" / f"{name}.md").read_text(encoding="utf-8"), "run benchmarks/speed/speed_table.py"


def test_the_curve_of_batching_finds_limit_and_half(monkeypatch: pytest.MonkeyPatch) -> None:
    batching = script("batching", monkeypatch)
    numbers = [1, 2, 4, 8, 16]
    rates = [10 * number / (number + 3) for number in numbers]
    assert batching["curve"](numbers, rates) == pytest.approx((10, 3))
    rows = [{"concepts": number, "concepts a second": rate} for number, rate in zip(numbers, rates, strict=True)]
    found = batching["summary"](rows)
    assert found["last over one"] == pytest.approx(rates[-1] / rates[0], abs=0.01)
    assert found["curve"]["limit"] == pytest.approx(10)
    assert found["curve"]["largest error of one left out"] == pytest.approx(0, abs=1e-6)
    rows[2]["concepts a second"] *= 1.2
    assert batching["summary"](rows)["curve"]["largest error of one left out"] > 0.1


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstrations]:
    data = InversionData("object_rearrangement", suite="validation").demonstrations
    return [data.select(name) for name in list(dict.fromkeys(data.concepts))[:2]]


@pytest.mark.slow  # to import diffusers alone takes seconds
def test_diffusers_makes_the_same_plans_of_the_same_noise_and_learns_as_well(
    tiny: Path, demonstrations: list[Demonstrations], monkeypatch: pytest.MonkeyPatch
) -> None:
    peers = script("peers", monkeypatch)
    model = read_model(GenerativeModel, tiny)
    settings = InversionSettings().changed(omega=1.2, components=2, learning_rate=0.1, samples=16)
    work = peers["Work"](model, demonstrations, settings, 40, 1)
    assert max(peers["equality"](work).values()) < 0.01
    shared, plain = (
        peers["their_plans"](
            peers[kind](model), peers["ddpm_scheduler"](model), work.branches(work.compositions), generator("cpu"), 3, (1, 21)
        )
        for kind in ("Shared", "Conditional")
    )
    torch.testing.assert_close(shared, plain, rtol=0, atol=0.02)
    own = demonstrations[0]
    (ours,) = invert(model, own, settings, 40).values()
    theirs = peers["their_concept"](model, model.encode(own.states, {}), 16, 40, "batched", generator("cpu", 1))
    start = peers["their_concept"](model, model.encode(own.states, {}), 16, 0, "batched", generator("cpu", 1))
    losses = [peers["loss_of"](model, own, one) for one in (ours.composition, theirs, start)]
    assert losses[0] < losses[2]
    assert losses[1] < losses[2]
    assert losses[0] < 1.1 * losses[1]


@pytest.mark.slow
def test_textual_inversion_one_by_one_learns_what_a_batch_learns(
    tiny: Path, demonstrations: list[Demonstrations], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same gradient where there is one noised demonstration a step."""
    peers = script("peers", monkeypatch)
    model = read_model(GenerativeModel, tiny)
    states = model.encode(demonstrations[0].states, {})
    found = [peers["their_concept"](model, states, 1, 3, batching, generator("cpu", 1)) for batching in ("one by one", "batched")]
    assert torch.equal(found[0].embeddings, found[1].embeddings)
