"""Grids on a Ray cluster of two nodes: where cells are placed, and what becomes of them when a node is killed."""

import runpy
from collections import defaultdict
from pathlib import Path

import pandas as pd
import pytest

from ftl_lightning.ablation import cluster, run
from ftl_lightning.ablation.outcome import Outcome
from ftl_lightning.ablation.plan import Cell
from ftl_lightning.ablation.resources import Resources, read_resources
from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import read_rows
from tests.ablation import attempts
from tests.ablation.raylets import QUICK, begin, entries, node_of, nodes, until, write_plan
from tests.conftest import ROOT

pytest.importorskip("ray", reason="needs the extra cluster")


def cell(name: str, **resources: float) -> Cell:
    return Cell("invert", (), {}, "", name, read_resources(resources))


def test_cells_are_placed_by_what_they_book_and_run_again_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "NODE_WAIT", 0.5)
    monkeypatch.setattr(cluster, "LOOK", 0.5)
    states: dict[str, list[str]] = defaultdict(list)
    outcomes: dict[str, Outcome] = {}
    near = [cell("fails"), cell("kills its process"), cell("plain", memory_gb=0.01)]
    far = [cell("far", far=1), cell("takes long", far=1)]
    with (
        nodes({"num_cpus": 1, "resources": {"far": 1}}) as made,
        cluster.cluster(made.address, attempts.attempt, near + far) as placed,
    ):
        for wrong in (cell("wide", cpus=2), cell("bright", gpus=1), cell("high", near=1), cell("large", memory_gb=1e6)):
            told = f"resources: {wrong}: expected a machine with cpus .* found none among 2"
            with pytest.raises(UserError, match=told), cluster.cluster(made.address, attempts.attempt, [wrong]):
                pass

        def tell(one: Cell, state: str, node: str, note: str) -> None:
            states[one.name].append(state)
            if (one.name, state) == ("takes long", "running"):
                lost = next(found for found in made.worker_nodes)
                assert lost.node_id.startswith(node.rpartition("/")[2])
                outcomes["node of far"] = Outcome(node=node)
                made.remove_node(lost, allow_graceful=False)

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


def test_a_grid_outlives_a_node_and_goes_on_after_its_head(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = write_plan(tmp_path / "a.yaml", {"verb": "invert", "config": "c.yaml", "grid": {"model.omega": ["1", "2", "3", "4"]}})
    with nodes({"num_cpus": 1}) as made:
        grid = begin(tmp_path, plan, made.address)

        def on_a_worker() -> object:
            return [node for entry in entries(tmp_path, "running").values() if (node := node_of(entry, made)) in made.worker_nodes]

        (lost,) = until(on_a_worker, grid, tmp_path)
        made.remove_node(lost, allow_graceful=False)
        (again,) = until(lambda: entries(tmp_path, "again"), grid, tmp_path)
        until(lambda: entries(tmp_path, "done"), grid, tmp_path)
        made.remove_node(made.head_node, allow_graceful=False)
        assert grid.wait(100) == 2
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


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"cpus": 1.5}, "resources.cpus: expected a whole number of 0 or more, or a fraction of 1, found 1.5"),
        ({"gpus": -1}, "resources.gpus: expected a whole number"),
        ({"memory_gb": float("nan")}, "resources.memory_gb: expected a number of 0 or more, found nan"),
        ({"big one": 1}, "resources: expected cpus, gpus, memory_gb or a resource of the cluster's own, found 'big one'"),
    ],
)
def test_resources_that_cannot_be_booked_are_refused(asked: dict[str, float], told: str) -> None:
    with pytest.raises(UserError, match=told.replace("'", "."), check=lambda error: "\n" not in str(error)):
        read_resources(asked)


def test_resources_in_the_words_of_ray() -> None:
    found = read_resources({"cpus": 4, "gpus": 0.5, "memory_gb": 2, "big": 1})
    assert found.ray() == {"num_cpus": 4, "num_gpus": 0.5, "memory": 2_000_000_000, "resources": {"big": 1}}
    assert Resources().ray() == {"num_cpus": 1, "num_gpus": 0}
    assert str(found) == "cpus 4, gpus 0.5, memory_gb 2, big 1"


def test_a_cluster_that_is_none_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = str(write_plan(tmp_path / "a.yaml", QUICK))
    for options, told in (
        (
            ["--executor=ray", "--address=127.0.0.1:9"],
            "expected the head of a Ray cluster at 127.0.0.1:9, found that nothing",
        ),
        (["--executor=ray", "--address=ray://head:10001"], "expected HOST:PORT of a cluster's head"),
        (["--address=127.0.0.1:9"], "address: expected none without --executor ray"),
        (["--only=[2]"], "only: expected numbers of stages from 1 to 1, found 2"),
    ):
        assert main(["ablate", "--config", plan, *options]) == 2
        assert told in capsys.readouterr().err
    assert not Path("r.cells.json").exists()


def test_rows_that_are_lost_doubled_or_different_are_counted() -> None:
    compared = runpy.run_path(str(ROOT / "benchmarks" / "cluster_kills.py"))["compared"]
    expected = pd.DataFrame({"task": ["a", "b", "c"], "n": [1, 1, 1], "value": [0.1, 0.2, 0.3]})
    assert compared(expected, expected) == {"rows": 3, "lost": 0, "doubled": 0, "different": 0}
    lost = pd.concat([expected.head(1), expected.head(2).assign(value=[0.1, 0.5])], ignore_index=True)
    assert compared(lost, expected) == {"rows": 3, "lost": 1, "doubled": 1, "different": 1}
    foreign = pd.concat([expected, expected.head(1).assign(n=2)])
    assert compared(foreign, expected) == {"rows": 3, "lost": 0, "doubled": 1, "different": 0}
