"""A Ray cluster of several nodes on this machine, whose nodes can be killed, and grids that run on it as a user runs them."""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from ftl_lightning.apps.ablation.record import CellRecord, read_record
from tests.conftest import CONF, ROOT, environment

WAIT = 300.0
"""Seconds for anything that is waited for: a machine may be slow."""
QUICK = {
    "verb": "invert",
    "config": str(CONF / "object_rearrangement.yaml"),
    "options": {
        "model.pretrained": str(ROOT / "pretrained" / "object_rearrangement"),
        "data.steps": 2,
        "model.budget.samples": 2,
        "evaluation.samples": 2,
        "evaluation.steps": 2,
        "evaluation.figures": 0,
        "evaluation.suites": ["paper"],
        "evaluation.diversity": False,
        "trainer.enable_progress_bar": False,
        "trainer.accelerator": "cpu",
        "trainer.logger.init_args.version": None,
    },
}
"""A stage whose cells take a second or two."""
SYSTEM = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 200,
    "health_check_failure_threshold": 5,
    "health_check_timeout_ms": 1000 * int(WAIT),
}
"""Of the head: a node that is gone refuses connections and is missed within a second; one that stands still is waited for."""


@contextmanager
def nodes(*resources: dict[str, Any]) -> Iterator[Any]:
    """A cluster with a head of one processor and a node for each of these; its files lie in a folder of their own."""
    from ray.cluster_utils import Cluster

    folder = tempfile.mkdtemp(prefix="ray")  # a short name: those of sockets are limited
    variables = {"RAY_TMPDIR": folder, "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(ROOT), "RAY_worker_niceness": "0"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        made = Cluster()
        try:
            made.add_node(num_cpus=1, include_dashboard=False, _system_config=SYSTEM)
            for asked in resources:
                made.add_node(**asked)
            yield made
        finally:
            made.shutdown()
            shutil.rmtree(folder, ignore_errors=True)


def write_plan(path: Path, *stages: dict[str, Any], results: str = "r.csv") -> Path:
    """An ablation's file."""
    path.write_text(yaml.safe_dump({"results": results, "stages": list(stages)}), encoding="utf-8")
    return path


PROGRAM = """
import sys
from ftl_lightning.apps.ablation import cluster, run
from ftl_lightning.cli.main import main
from tests.apps.ablation import attempts
cluster.HEAD_WAIT = cluster.LOOK = 1.0  # nobody waits for a head that a test has killed
run.attempt, run.check = attempts.rows, lambda cells: None
sys.exit(main())
"""
"""A user's command, whose cells wait for files."""


def begin(folder: Path, plan: Path, address: str) -> "subprocess.Popen[str]":
    """Start a grid in a folder, whose cells wait for files; what it says goes to ``said.txt`` there."""
    command = [sys.executable, "-c", PROGRAM, "ablate", "--config", str(plan), "--executor", "ray"]
    with (folder / "said.txt").open("w", encoding="utf-8") as said:
        return subprocess.Popen(command, cwd=folder, stdout=said, stderr=said, text=True, env=environment(RAY_ADDRESS=address))


def until(there: Callable[[], Any], process: "subprocess.Popen[str]", folder: Path) -> Any:
    """What a function finds as soon as it finds something, while a grid runs."""
    deadline = time.monotonic() + WAIT
    while not (found := there()):
        said = (folder / "said.txt").read_text("utf-8")
        assert process.poll() is None, said
        assert time.monotonic() < deadline, said
        time.sleep(0.05)
    return found


def entries(folder: Path, state: str) -> dict[str, CellRecord]:
    """Of a grid's cells those in a state."""
    return {name: entry for name, entry in read_record(folder / "r.csv").items() if entry.state == state}


def node_of(entry: CellRecord, made: Any) -> Any:
    """The node of a cluster that a cell runs on."""
    begins = entry.node.rpartition("/")[2]
    return next((node for node in (made.head_node, *made.worker_nodes) if node.node_id.startswith(begins)), None)
