"""Grids on a Ray cluster, and on a stand-in for one: where cells are placed, and what becomes of those that are lost."""

import runpy
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from ftl_lightning.apps.ablation import cluster, run
from ftl_lightning.apps.ablation.plan import Cell, Resources, Stage
from ftl_lightning.apps.ablation.record import Attempt, Outcome
from ftl_lightning.cli.main import main
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from tests.apps.ablation import attempts
from tests.apps.ablation.raylets import WAIT, begin, entries, node_of, nodes, until, write_plan
from tests.conftest import ROOT, refused


def cell(name: str, **resources: float) -> Cell:
    return Cell("invert", (), {}, "", name, Resources.read(resources))


@pytest.fixture(scope="module")
def two() -> Iterator[Any]:
    """A Ray cluster of a head and a node with something that the head has not, for all tests of this file."""
    pytest.importorskip("ray", reason="needs the extra cluster")
    with nodes({"num_cpus": 1, "resources": {"far": 1}}) as made:
        yield made


@pytest.mark.cluster
def test_cells_are_placed_by_what_they_book_and_run_again_once(two: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "NODE_WAIT", 0.5)
    monkeypatch.setattr(cluster, "LOOK", 0.5)
    states: dict[str, list[str]] = defaultdict(list)
    outcomes: dict[str, Outcome] = {}
    near = [cell("fails"), cell("kills its process"), cell("plain", memory_gb=0.01)]
    far = [cell("far", far=1), cell("takes long", far=1)]
    with cluster.cluster(two.address, attempts.attempt, near + far) as placed:
        wrong = [cell("high", near=1)]
        told = "resources: .*: expected a machine with cpus 1, near 1 in the cluster, found none among 2"
        with pytest.raises(UserError, match=told), cluster.cluster(two.address, attempts.attempt, wrong):
            pass

        def tell(one: Cell, state: str, node: str, note: str) -> None:
            states[one.name].append(state)
            if (one.name, state) == ("takes long", "running"):
                (lost,) = two.worker_nodes
                assert lost.node_id.startswith(node.rpartition("/")[2])
                outcomes["node of far"] = Outcome(node=node)
                two.remove_node(lost, allow_graceful=False)

        outcomes |= {one.name: outcome for one, outcome in placed([*far, *near], set(), tell)}
    assert outcomes["fails"].node
    assert outcomes["far"].node == outcomes["node of far"].node
    assert outcomes["fails"].error == "the third concept has no demonstrations"
    assert states["fails"] == ["running"]
    assert "WorkerCrashedError" in outcomes["kills its process"].error
    assert states["kills its process"] == ["running", "again", "running"]
    assert outcomes["plain"].note == "done"
    assert outcomes["takes long"].error == "no machine of the cluster has cpus 1, far 1 any more"
    assert states["takes long"] == ["running", "again"]
    assert not list(Path().glob(".cells.*"))


@pytest.mark.cluster
def test_a_grid_outlives_a_node_and_goes_on_after_its_head(
    two: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = write_plan(tmp_path / "a.yaml", {"verb": "invert", "config": "c.yaml", "grid": {"model.omega": ["1", "2", "3", "4"]}})
    for left in list(two.worker_nodes):
        two.remove_node(left)
    two.add_node(num_cpus=1)
    grid = begin(tmp_path, plan, two.address)

    def on_a_worker() -> object:
        return [node for entry in entries(tmp_path, "running").values() if (node := node_of(entry, two)) in two.worker_nodes]

    (lost,) = until(on_a_worker, grid, tmp_path)
    two.remove_node(lost, allow_graceful=False)
    (again,) = until(lambda: entries(tmp_path, "again"), grid, tmp_path)
    (tmp_path / "first").touch()
    until(lambda: entries(tmp_path, "done"), grid, tmp_path)
    two.remove_node(two.head_node, allow_graceful=False)
    assert grid.wait(WAIT) == 2
    said = (tmp_path / "said.txt").read_text("utf-8")
    assert f"{again}: runs again, lost on " in said
    assert "no longer answers; start it again, and give the same command" in said
    before = read_rows("r.csv")
    assert 3 <= len(before) < 12
    (tmp_path / "go").touch()
    with nodes() as made:
        monkeypatch.setattr(run, "attempt", attempts.rows)
        monkeypatch.setattr(run, "check", lambda cells: None)
        monkeypatch.setenv("RAY_ADDRESS", made.address)
        assert main(["ablate", "--config", str(plan), "--executor", "ray"]) == 0
    said = capsys.readouterr().out
    assert 3 * said.count(": in the results already") == len(before)
    rows = read_rows("r.csv")
    assert rows.head(len(before)).equals(before)
    assert sorted(zip(rows["omega"], rows["task"], strict=True)) == [(omega, task) for omega in "1234" for task in "abc"]
    assert len(entries(tmp_path, "done")) == 4


class Lost(Exception):
    """What the stand-in for Ray says of a process that is gone."""


class Raised(Lost):
    """What it says of an error of ours."""

    cause = property(lambda self: self.args[0])


class Pending(Exception):
    """Raised by a task that never begins, or never ends."""


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A stand-in for the module ``ray``: runs each task as it is sent, and says what Ray would say of it."""

    def send(function: Callable[..., Outcome], *arguments: Any) -> Future[Outcome]:
        task = Future[Outcome]()
        try:
            task.set_result(function(*arguments))
        except Lost as error:
            task.set_exception(error)
        except ValueError as error:
            task.set_exception(Raised(error))
        except Pending:
            pass  # the task stays without a result
        return task

    def options(function: Callable[..., Outcome], name: str, **booked: Any) -> SimpleNamespace:
        made.booked[name] = tuple(booked.values())
        return SimpleNamespace(remote=partial(send, function))

    def remote(max_retries: int) -> Callable[..., SimpleNamespace]:
        assert max_retries == 0
        return lambda function: SimpleNamespace(options=partial(options, function))

    made = SimpleNamespace(machines=[{"Alive": True, "Resources": {"CPU": 1.0, "memory": 1e9}}], booked={}, cancelled=[])
    made.exceptions = SimpleNamespace(RayError=Lost, RayTaskError=Raised)
    made.is_initialized, made.remote, made.get = lambda: True, remote, Future.result
    made.get_runtime_context = lambda: SimpleNamespace(gcs_address="127.0.0.1:9", get_node_id=lambda: "0123456789")
    made.nodes, made.cancel = lambda: made.machines, made.cancelled.append
    made.wait = lambda tasks, num_returns, timeout: ([task for task in tasks if task.done()][:num_returns], [])
    monkeypatch.setitem(sys.modules, "ray", made)
    monkeypatch.setenv("TORCH_FORCE_WEIGHTS_ONLY_LOAD", "1")  # which tasks set
    for name in ("LOOK", "NODE_WAIT", "HEAD_WAIT"):
        monkeypatch.setattr(cluster, name, 0.0)
    monkeypatch.setattr(cluster, "_answers", lambda address: True)
    return made


ANSWERS = cluster._answers


def placed(cells: list[Cell], attempt: Attempt) -> tuple[dict[str, Outcome], dict[str, list[str]]]:
    """How cells end on the cluster that the stand-in stands for, and their states."""
    states: dict[str, list[str]] = defaultdict(list)
    with cluster.cluster("", attempt, cells) as run_cells:
        ends = run_cells(cells, {"known"}, lambda one, state, node, note: states[one.name].append(state))
        return {one.name: outcome for one, outcome in ends}, states


def test_what_is_lost_runs_again_once_and_what_fails_does_not(stand_in: SimpleNamespace) -> None:
    runs: dict[str, list[bool]] = defaultdict(list)

    def attempt(one: Cell, known: set[str], again: bool) -> Outcome:
        runs[one.name].append(again)
        assert known == {"known"}
        if one.name == "twice" or (one.name == "once" and not again):
            raise Lost("its process died. More about it.")
        if one.name == "fails":
            raise ValueError("no demonstrations")
        return Outcome(note="done")

    outcomes, states = placed([cell("fails"), cell("once"), cell("twice", memory_gb=0.5), cell("plain", cpus=0.5)], attempt)
    assert runs == {"fails": [False], "once": [False, True], "twice": [False, True], "plain": [False]}
    again = ["running", "again", "running"]
    assert states == {"fails": ["running"], "plain": ["running"], "once": again, "twice": again}
    errors = {"fails": "no demonstrations", "once": "", "twice": "Lost: its process died", "plain": ""}
    assert {name: outcome.error for name, outcome in outcomes.items()} == errors
    assert all(outcome.node.endswith("/012345") for outcome in outcomes.values())
    assert list(stand_in.booked.values()) == [(1, 0), (1, 0), (1, 0, 500_000_000), (0.5, 0)]
    assert not list(Path().glob(".cells.*"))


def test_what_has_no_machine_is_refused_or_given_up_and_a_silent_head_ends_the_grid(
    stand_in: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    for wrong in (cell("wide", cpus=2), cell("bright", gpus=1), cell("high", near=1), cell("large", memory_gb=1e6)):
        told = f"resources: {wrong}: expected a machine with cpus .* found none among 1; lower them or add a machine"
        with pytest.raises(UserError, match=told):
            placed([wrong], attempts.attempt)

    def attempt(*arguments: object) -> Outcome:
        stand_in.machines[0]["Alive"] = False
        raise Pending

    monkeypatch.setattr(cluster, "_attempt_in", attempt)
    outcomes, states = placed([cell("waits", memory_gb=0.5)], attempt)
    assert outcomes["waits"].error == "no machine of the cluster has cpus 1, memory_gb 0.5 any more"
    assert len(stand_in.cancelled) == 1
    assert states == {}
    stand_in.machines[0]["Alive"] = True
    monkeypatch.setattr(cluster, "_answers", lambda address: False)
    with pytest.raises(UserError, match=r"the head of the cluster at 127\.0\.0\.1:9 no longer answers; start it again, and give"):
        placed([cell("waits")], attempt)


def test_resources_are_said_in_the_words_of_ray_and_refused_where_they_cannot_be_booked() -> None:
    found = Resources.read({"cpus": 4, "gpus": 0.5, "memory_gb": 2, "big": 1})
    assert found.ray() == {"num_cpus": 4, "num_gpus": 0.5, "memory": 2_000_000_000, "resources": {"big": 1}}
    assert Resources().ray() == {"num_cpus": 1, "num_gpus": 0}
    assert str(found) == "cpus 4, gpus 0.5, memory_gb 2, big 1"
    for asked, told in (
        ({"cpus": 1.5}, "resources.cpus: expected a whole number of 0 or more, or a fraction of 1, found 1.5"),
        ({"gpus": -1}, "resources.gpus: expected a whole number"),
        ({"memory_gb": float("nan")}, "resources.memory_gb: expected a number of 0 or more, found nan"),
        ({"big one": 1}, "resources: expected cpus, gpus, memory_gb or a custom resource of the cluster, found big one"),
    ):
        with pytest.raises(UserError, match=told.replace("'", "."), check=lambda error: "\n" not in str(error)):
            Resources.read(asked)


def test_a_cluster_that_is_none_is_told_in_one_line(
    stand_in: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stand_in, "is_initialized", lambda: False)
    monkeypatch.setattr(cluster, "_answers", ANSWERS)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    nothing = "address: expected the head of a Ray cluster at 127.0.0.1:9, found that nothing answers there"
    for address, told in (
        ("127.0.0.1:9", nothing),
        ("ray://head:10001", "address: expected HOST:PORT of a cluster's head, and ablate called on a machine of the cluster"),
        ("auto", "address: expected a Ray cluster that this machine is a node of, found none; start it by: ray start"),
    ):
        with pytest.raises(UserError, match=told), cluster.cluster(address, attempts.attempt):
            pass
    with pytest.raises(UserError, match="only: expected numbers of stages from 1 to 1, found 2"):
        run.planned([Stage("invert", "a.yaml")], [0], only=[2])
    monkeypatch.setattr(run, "check", lambda cells: None)
    plan = str(write_plan(tmp_path / "a.yaml", {"verb": "fit", "config": str(ROOT / "conf" / "agent.yaml")}))
    refused(capsys, ["ablate", "--config", plan, "--executor=ray", "--address=127.0.0.1:9"], nothing)
    refused(capsys, ["ablate", "--config", plan, "--address=127.0.0.1:9"], "address: expected none without --executor ray")


def test_rows_that_are_lost_doubled_or_different_are_counted() -> None:
    compared = runpy.run_path(str(ROOT / "benchmarks" / "stress" / "cluster_kills.py"))["compared"]
    expected = pd.DataFrame({"task": ["a", "b", "c"], "n": [1, 1, 1], "value": [0.1, 0.2, 0.3]})
    assert compared(expected, expected) == {"rows": 3, "lost": 0, "doubled": 0, "different": 0}
    lost = pd.concat([expected.head(1), expected.head(2).assign(value=[0.1, 0.5])], ignore_index=True)
    assert compared(lost, expected) == {"rows": 3, "lost": 1, "doubled": 1, "different": 1}
    foreign = pd.concat([expected, expected.head(1).assign(n=2)])
    assert compared(foreign, expected) == {"rows": 3, "lost": 0, "doubled": 1, "different": 0}
