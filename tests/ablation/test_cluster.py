"""Grids on a Ray cluster of two nodes: where cells are placed, and what becomes of them when a node is killed."""

from collections import defaultdict
from pathlib import Path

import pytest

from ftl_lightning.ablation import cluster
from ftl_lightning.ablation.outcome import Outcome
from ftl_lightning.ablation.plan import Cell
from ftl_lightning.ablation.resources import Resources, read_resources
from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import read_rows
from tests.ablation.attempts import attempt
from tests.ablation.raylets import QUICK, begin, entries, node_of, nodes, until, write_plan

pytest.importorskip("ray", reason="needs the extra cluster")


def cell(name: str, **resources: float) -> Cell:
    return Cell("invert", (), {}, "", name, read_resources(resources))


def test_cells_are_placed_by_what_they_book_and_run_again_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "NODE_WAIT", 1.0)
    states: dict[str, list[str]] = defaultdict(list)
    outcomes: dict[str, Outcome] = {}
    near = [cell("fails"), cell("kills its process twice"), cell("kills its process once"), cell("plain", memory_gb=0.01)]
    far = [cell("far", far=1), cell("takes long", far=1)]
    with nodes({"num_cpus": 1, "resources": {"far": 1}}) as made, cluster.cluster(made.address, attempt) as run:
        for wrong in (cell("wide", cpus=2), cell("bright", gpus=1), cell("high", near=1), cell("large", memory_gb=1e6)):
            with pytest.raises(UserError, match=f"resources: {wrong}: expected a machine with cpus .* found none among 2"):
                list(run([wrong], set(), lambda *_: None))

        def tell(one: Cell, state: str, node: str, note: str) -> None:
            states[one.name].append(state)
            if (one.name, state) == ("takes long", "running"):
                lost = next(found for found in made.worker_nodes)
                assert lost.node_id.startswith(node.rpartition("/")[2])
                outcomes["node of far"] = Outcome(node=node)
                made.remove_node(lost, allow_graceful=False)

        outcomes |= {one.name: outcome for one, outcome in run([*far, *near], set(), tell)}
    assert outcomes["far"].node == outcomes["node of far"].node
    assert outcomes["fails"].error == "the third concept has no demonstrations"
    assert states["fails"] == ["running"]
    assert (outcomes["kills its process once"].note, states["kills its process once"]) == (
        "second",
        ["running", "again", "running"],
    )
    assert "WorkerCrashedError" in outcomes["kills its process twice"].error
    assert states["kills its process twice"] == ["running", "again", "running"]
    assert outcomes["plain"].note == "first"
    assert outcomes["takes long"].error == "no machine of the cluster has cpus 1, far 1 any more"
    assert states["takes long"] == ["running", "again"]
    assert not list(Path().glob(".cells.*"))


def test_a_grid_outlives_a_node_and_goes_on_after_its_head(tmp_path: Path) -> None:
    stage = QUICK | {"grid": {"model.omega": [1.0, 1.2]}}
    plan = write_plan(tmp_path / "a.yaml", stage)
    with nodes({"num_cpus": 1}) as made:
        grid = begin(tmp_path, plan, made.address)

        def on_a_worker() -> object:
            return [node for entry in entries(tmp_path, "running").values() if (node := node_of(entry, made)) in made.worker_nodes]

        (lost,) = until(on_a_worker, grid, tmp_path)
        made.remove_node(lost, allow_graceful=False)
        (again,) = until(lambda: entries(tmp_path, "again"), grid, tmp_path)
        (done,) = until(lambda: entries(tmp_path, "done"), grid, tmp_path)
        made.remove_node(made.head_node, allow_graceful=False)
        assert grid.wait(100) == 2
    said = (tmp_path / "said.txt").read_text("utf-8")
    assert f"{again}: runs again, lost on " in said
    assert "no longer answers; start it again, and give the same command" in said
    before = read_rows("r.csv")
    with nodes() as made:
        assert begin(tmp_path, plan, made.address).wait(100) == 0
    said = (tmp_path / "said.txt").read_text("utf-8")
    assert said.count("in the results already") == 2  # in its line and in the table
    rows = read_rows("r.csv")
    assert len(before.merge(rows)) == len(before)
    assert set(entries(tmp_path, "done")) == {done, again}
    assert entries(tmp_path, "done")[done].note == "in the results already"
    assert main(["ablate", "--config", str(write_plan(tmp_path / "b.yaml", stage, results="one.csv"))]) == 0
    order = ["omega", "setting", "task", "method", "metric"]
    one, other = (table.sort_values(order, ignore_index=True) for table in (read_rows("one.csv"), rows))
    assert one.equals(other)


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
