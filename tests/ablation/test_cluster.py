"""Grids on a Ray cluster of two nodes that are killed while it runs."""

from pathlib import Path

import pytest

from ftl_lightning.evaluation.results import read_rows
from tests.ablation.raylets import QUICK, begin, entries, node_of, nodes, until, write_plan

pytest.importorskip("ray", reason="needs the extra cluster")


def test_a_grid_outlives_a_node_and_goes_on_after_its_head(tmp_path: Path) -> None:
    plan = write_plan(tmp_path / "a.yaml", QUICK | {"grid": {"model.omega": [1.0, 1.1, 1.2, 1.3]}})
    with nodes({"num_cpus": 1}) as made:
        grid = begin(tmp_path, plan, made.address)

        def on_a_worker() -> object:
            return [node for entry in entries(tmp_path, "running").values() if (node := node_of(entry, made)) in made.worker_nodes]

        (lost,) = until(on_a_worker, grid, tmp_path)
        made.remove_node(lost, allow_graceful=False)
        until(lambda: len(entries(tmp_path, "done")) >= 1, grid, tmp_path)
        made.remove_node(made.head_node, allow_graceful=False)
        code = grid.wait(100)
        said = (tmp_path / "said.txt").read_text("utf-8")
        print(code, said)
