"""Cells on a Ray cluster: placed by what they book, run again once where a process or a machine is lost."""

import fcntl
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ftl_lightning import trust
from ftl_lightning.ablation.outcome import Attempt, Outcome, Run, Tell
from ftl_lightning.ablation.plan import Cell
from ftl_lightning.errors import UserError, short
from ftl_lightning.tensor_file import alone, write_text

POLL = 0.5
"""Seconds between two looks at what runs."""
LOOK = 5.0
"""Seconds between two looks at the cluster itself."""
HEAD_WAIT = 20.0
"""Seconds that the head may be silent. Ray ends the whole process after 60, without a word that would help."""
NODE_WAIT = 60.0
"""Seconds that a cell may wait for a machine which the cluster no longer has."""
MOST_RUNS = 2
"""Of one cell: one that costs its machine twice would cost the others, too."""
_FOLDER = ".cells."


@contextmanager
def cluster(address: str, attempt: Attempt, cells: Sequence[Cell] = ()) -> Iterator[Run]:
    """Connect to a Ray cluster for the length of the block; one that the caller is connected to already is used and left as it is.

    Args:
        address: ``'HOST:PORT'`` of its head; ``'auto'`` for the one that this machine is a node of; ``'local'`` for this machine's
            processors alone; empty for Ray's way: ``RAY_ADDRESS``, else a cluster that runs on this machine, else its processors.
        attempt: runs a cell on a machine of the cluster, in the current folder.
        cells: that are to be run.

    Raises:
        UserError: where Ray is missing, no cluster answers, or no machine of it has room for one of the cells.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError("executor: 'ray' needs its extra; run: pip install 'ftl-lightning[cluster]'") from error
    started = not ray.is_initialized()
    if started:
        _connect(address or os.environ.get("RAY_ADDRESS", ""))
    try:
        _expect_room(cells)
        yield partial(_run, attempt)
    finally:
        if started:
            ray.shutdown()


def _connect(address: str) -> None:
    import ray

    if "://" in address:
        expected = "HOST:PORT of a cluster's head, and ablate called on one of its machines, in a folder that all of them share"
        raise UserError(f"address: expected {expected}; found {short(address)!r}")
    here = _here() if address in ("", "auto") else ""
    if address == "auto" and not here:
        raise UserError("address: expected a Ray cluster that this machine is a node of, found none; start it by: ray start")
    if ":" in address and not _answers(address):
        raise UserError(f"address: expected the head of a Ray cluster at {short(address)}, found that nothing answers there")
    os.environ.setdefault("RAY_worker_niceness", "0")  # by default workers stand back for everything else
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        # By "auto" Ray also finds the token of a cluster that asks for one.
        ray.init(address="auto" if here else address or "local", log_to_driver=False, include_dashboard=False)
    except (ConnectionError, RuntimeError, ValueError) as error:  # also for other versions of Ray or Python
        raise UserError(f"address: expected a Ray cluster at {here or address}, found: {short(str(error), 150)}") from error


def _here() -> str:
    """The address of the cluster that this machine is a node of; empty for none.

    Ray itself trusts the file in which it stands, and tries for minutes to reach a cluster that was killed.
    """
    folder = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp"
    file = Path(folder, "ray", "ray_current_cluster")
    try:
        if file.stat().st_uid not in (os.getuid(), 0):  # anyone may write there, and who runs a cluster runs code on its machines
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
    """A cell that was sent to the cluster, for the how many-th time, and the file by which it says where it has begun."""

    cell: Cell
    runs: int
    begun: Path
    node: str = ""
    homeless: float = 0.0
    """Since when no machine of the cluster has what it books, in seconds of a clock; 0 while one has."""


def _run(attempt: Attempt, cells: Sequence[Cell], known: set[str], tell: Tell) -> Iterator[tuple[Cell, Outcome]]:
    import ray

    address = ray.get_runtime_context().gcs_address
    remote = ray.remote(max_retries=0)(_attempt_in)  # Ray would run a lost cell again without a word
    with _begun_folder() as folder:
        waiting: dict[Any, _Sent] = {}

        def send(cell: Cell, runs: int) -> None:
            begun = folder / f"{len(sent)}"
            sent.append(cell)
            task = remote.options(name=cell.folder, **cell.resources.ray())
            sent_task = task.remote(str(Path.cwd()), cell, known, trust.vouched(), attempt, str(begun), runs > 1)
            waiting[sent_task] = _Sent(cell, runs, begun)

        sent: list[Cell] = []
        for cell in cells:
            send(cell, 1)
        looked, silent = time.monotonic(), 0.0
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1, timeout=POLL)
            now = time.monotonic()
            _tell_begun(waiting.values(), tell)
            for task in ready:
                one = waiting.pop(task)
                outcome, lost = _outcome(task)
                if lost and one.runs < MOST_RUNS:
                    tell(one.cell, "again", one.node, outcome.error)
                    send(one.cell, one.runs + 1)
                else:
                    yield one.cell, replace(outcome, node=outcome.node or one.node)
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


def _expect_room(cells: Sequence[Cell]) -> None:
    """Refuse cells that no machine of the cluster has room for, which would wait for ever.

    Raises:
        UserError: naming the first.
    """
    nodes = [node["Resources"] for node in _nodes()]
    for cell in cells:
        if not any(cell.resources.fit(node) for node in nodes):
            raise UserError(
                f"resources: {cell}: expected a machine with {cell.resources} in the cluster, found none among {len(nodes)}; "
                "lower them or add a machine"
            )


def _nodes() -> list[dict[str, Any]]:
    import ray

    return [node for node in ray.nodes() if node["Alive"]]


def _tell_begun(waiting: Iterable[_Sent], tell: Tell) -> None:
    for one in waiting:
        if not one.node and one.begun.is_file():
            one.node = one.begun.read_text("utf-8") or "?"
            tell(one.cell, "running", one.node, "")


def _outcome(task: Any) -> tuple[Outcome, bool]:
    """What became of a cell, and whether it was lost with the process or machine that ran it."""
    import ray

    try:
        return ray.get(task), False
    except ray.exceptions.RayTaskError as error:  # our own code failed, as it would again
        return Outcome(error=short(str(error.cause), 200)), False
    except ray.exceptions.RayError as error:
        return Outcome(error=f"{type(error).__name__}: {short(str(error).partition('. ')[0], 200)}"), True


def _without_home(waiting: dict[Any, _Sent], now: float) -> Iterator[tuple[Cell, Outcome]]:
    """Give up cells whose last machine has gone for good."""
    import ray

    nodes = [node["Resources"] for node in _nodes()]
    for task, one in list(waiting.items()):
        if one.node or any(one.cell.resources.fit(node) for node in nodes):
            one.homeless = 0.0
            continue
        one.homeless = one.homeless or now
        if now - one.homeless > NODE_WAIT:
            ray.cancel(task)
            del waiting[task]
            yield one.cell, Outcome(error=f"no machine of the cluster has {one.cell.resources} any more")


@contextmanager
def _begun_folder() -> Iterator[Path]:
    """A hidden folder in the current one, in which cells say where they run. Those that killed processes left are removed."""
    with ExitStack() as stack:
        with alone(Path.cwd()):  # none is taken for one that was left before it is held
            for left in Path.cwd().glob(f"{_FOLDER}*"):
                with suppress(OSError), _held(left):
                    shutil.rmtree(left)
            folder = Path(tempfile.mkdtemp(prefix=_FOLDER, dir=Path.cwd()))
            stack.enter_context(_held(folder))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold a folder's lock.

    Raises:
        OSError: where another process holds it.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def _attempt_in(
    folder: str, cell: Cell, known: set[str], vouched: frozenset[str], attempt: Attempt, begun: str, again: bool
) -> Outcome:
    """Run a cell in the folder that all machines of a cluster share, with the modules that a person vouches for."""
    node = _node_name()
    if not Path(begun).parent.is_dir():
        told = f"{folder}: expected a folder that all machines share, found that {node} does not have it; call ablate in one"
        return Outcome(error=told, node=node)
    os.chdir(folder)
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"  # as the command line has it; checkpoints may be read
    write_text(begun, node)
    with trust.vouching(vouched):
        return replace(attempt(cell, known, again), node=node)


def _node_name() -> str:
    """The machine's name, and the first letters of the node's number: a machine may be several nodes."""
    import ray

    return f"{socket.gethostname()}/{ray.get_runtime_context().get_node_id()[:6]}"
