"""Run cells on a Ray cluster, placed by their resources; a cell that loses its process or machine runs once more."""

import itertools
import os
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.apps.ablation.record import Attempt, Outcome, Run, Tell
from ftl_lightning.services import trust
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.tensor_file import write_text

POLL = 0.5  #: Seconds between two checks of the cells.
LOOK = 5.0  #: Seconds between two checks of the cluster.
HEAD_WAIT = 20.0  #: Maximum seconds without an answer of the head; Ray ends the process after 60 without a useful message.
NODE_WAIT = 60.0  #: Maximum seconds that a cell waits for a machine that has left the cluster.
MOST_RUNS = 2  #: Maximum runs of a cell, so that a cell that crashes machines does not crash them all.


@contextmanager
def cluster(address: str, attempt: Attempt, cells: Sequence[Cell] = ()) -> Iterator[Run]:
    """Connect to a Ray cluster within the block; an existing connection is used and stays open. Raise UserError if Ray
    is missing, no cluster answers, or a cell fits on no machine.

    Args:
        address: ``'HOST:PORT'`` of the head; ``'auto'`` for this machine's cluster; ``'local'`` for its processors; empty for Ray's
            order: ``RAY_ADDRESS``, else a cluster on this machine, else its processors.
        attempt, cells: runs a cell on a machine of the cluster, in the current folder; and the cells to run.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError("executor: 'ray' needs its extra; run: pip install 'ftl-lightning[cluster]'") from error
    started = not ray.is_initialized()
    if started:
        _connect(address or os.environ.get("RAY_ADDRESS", ""))
    try:
        nodes = _nodes()
        for cell in cells:
            fits, expected = any(map(cell.resources.fit, nodes)), f"a machine with {cell.resources} in the cluster"
            require(fits, f"resources: {cell}", expected, f"none among {len(nodes)}; lower them or add a machine")
        yield partial(_run, attempt)
    finally:
        if started:
            ray.shutdown()


def _connect(address: str) -> None:
    import ray

    expected = "HOST:PORT of a cluster's head, and ablate called on a machine of the cluster, in a folder that all machines share"
    require("://" not in address, "address", expected, short(address))
    here = _here() if address in ("", "auto") else ""
    expected = "a Ray cluster that this machine is a node of"
    require(address != "auto" or here, "address", expected, "none; start it by: ray start")
    expected = f"the head of a Ray cluster at {short(address)}"
    require(":" not in address or _answers(address), "address", expected, "that nothing answers there")
    os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's default gives workers low priority
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        # With "auto" Ray also finds the token of the cluster.
        ray.init(address="auto" if here else address or "local", log_to_driver=False, include_dashboard=False)
    except (ConnectionError, RuntimeError, ValueError) as error:  # also for other versions of Ray or Python
        raise UserError(f"address: expected a Ray cluster at {here or address}, found: {short(str(error), 150)}") from error


def _here() -> str:
    """The address of this machine's cluster, or empty; Ray trusts the file, and tries for minutes to reach a killed cluster."""
    folder = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp"
    file = Path(folder, "ray", "ray_current_cluster")
    try:
        if file.stat().st_uid not in (os.getuid(), 0):  # the folder is writable for anyone, and a cluster runs code
            return ""
        address = file.read_text("utf-8").strip()
    except OSError:
        return ""
    return address if _answers(address) else ""


def _answers(address: str) -> bool:
    """Whether something listens at ``'HOST:PORT'``."""
    host, _, port = address.rpartition(":")
    if not port.isdigit() or not 0 < int(port) < 2**16:
        return False
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
    except OSError:
        return False
    return True


@dataclass
class _Sent:
    """A cell on the cluster, with attempt number, and the file to which it writes its node when it begins."""

    cell: Cell
    runs: int
    begun: Path
    node: str = ""
    homeless: float = 0.0
    """Clock time in seconds since which the cell fits on no machine; 0 if it fits."""


def _run(attempt: Attempt, cells: Sequence[Cell], known: set[str], tell: Tell) -> Iterator[tuple[Cell, Outcome]]:
    import ray

    address = ray.get_runtime_context().gcs_address
    remote = ray.remote(max_retries=0)(_attempt_in)  # otherwise Ray silently repeats lost cells
    with tempfile.TemporaryDirectory(prefix=".cells.", dir=Path.cwd(), ignore_cleanup_errors=True) as folder:
        waiting: dict[Any, _Sent] = {}

        def send(cell: Cell, runs: int) -> None:
            begun = Path(folder, str(next(numbers)))
            remote_cell = remote.options(name=cell.folder, **cell.resources.ray())
            task = remote_cell.remote(str(Path.cwd()), cell, known, trust.trusted_names(), attempt, str(begun), runs > 1)
            waiting[task] = _Sent(cell, runs, begun)

        numbers = itertools.count()
        for cell in cells:
            send(cell, 1)
        looked, silent = time.monotonic(), 0.0
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1, timeout=POLL)
            now = time.monotonic()
            for sent in waiting.values():
                if not sent.node and sent.begun.is_file():
                    sent.node = sent.begun.read_text("utf-8") or "?"
                    tell(sent.cell, "running", sent.node, "")
            for task in ready:
                ended = waiting.pop(task)
                outcome, lost = _outcome(task)
                if lost and ended.runs < MOST_RUNS:
                    tell(ended.cell, "again", ended.node, outcome.error)
                    send(ended.cell, ended.runs + 1)
                else:
                    yield ended.cell, replace(outcome, node=outcome.node or ended.node)
            if ready or now - looked < LOOK:
                continue
            looked = now
            if _answers(address):
                silent = 0.0
                yield from _without_home(waiting, now)
                continue
            silent = silent or now
            if now - silent > HEAD_WAIT:
                raise UserError(
                    f"address: the head of the cluster at {address} no longer answers; start it again, and give the same command: "
                    "cells that are done stay done"
                )


def _nodes() -> list[dict[str, Any]]:
    """Resources of the cluster's nodes."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _outcome(task: Any) -> tuple[Outcome, bool]:
    """Outcome of a cell, and whether its process or machine was lost."""
    import ray

    try:
        return ray.get(task), False
    except ray.exceptions.RayTaskError as error:  # an error in our code; a second run would fail, too
        return Outcome(error=short(str(error.cause), 200)), False
    except ray.exceptions.RayError as error:
        return Outcome(error=f"{type(error).__name__}: {short(str(error).partition('. ')[0], 200)}"), True


def _without_home(waiting: dict[Any, _Sent], now: float) -> Iterator[tuple[Cell, Outcome]]:
    """Give up cells that have fitted on no machine for :data:`NODE_WAIT`."""
    import ray

    nodes = _nodes()
    for task, sent in list(waiting.items()):
        if sent.node or any(sent.cell.resources.fit(node) for node in nodes):
            sent.homeless = 0.0
            continue
        sent.homeless = sent.homeless or now
        if now - sent.homeless > NODE_WAIT:
            ray.cancel(task)
            del waiting[task]
            yield sent.cell, Outcome(error=f"no machine of the cluster has {sent.cell.resources} any more")


def _attempt_in(
    folder: str, cell: Cell, known: set[str], trusted: frozenset[str], attempt: Attempt, begun: str, again: bool
) -> Outcome:
    """Run a cell in the shared folder of a cluster, with the modules that the user vouches for."""
    import ray

    node = f"{socket.gethostname()}/{ray.get_runtime_context().get_node_id()[:6]}"  # a machine may run several nodes
    if not Path(begun).parent.is_dir():
        message = f"{folder}: expected a folder that all machines share, found that {node} does not have it; call ablate in one"
        return Outcome(error=message, node=node)
    os.chdir(folder)
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"  # as on the command line; checkpoints may be read
    write_text(begun, node)
    with trust.vouching(trusted):
        return replace(attempt(cell, known, again), node=node)
