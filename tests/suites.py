"""Hooks of pytest: the markers that divide the tests into suites, and the limit of work for a test without one.

``make test`` runs the tests that have none of the markers, ``make test-all`` all tests.
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any, SupportsIndex

import pytest

__all__ = [
    "pytest_collection_modifyitems",
    "pytest_configure",
    "pytest_deselected",
    "pytest_runtest_call",
    "pytest_runtest_logreport",
    "pytest_runtest_makereport",
    "pytest_runtest_setup",
    "pytest_sessionfinish",
    "pytest_terminal_summary",
    "pytest_testnodedown",
]

MARKERS = {
    "slow": "takes more than about a second, where the fast suite can do without it; above five it must have a marker",
    "browser": "opens a page in Chromium",
    "release": "builds or installs the package, or checks types of its users",
    "notebook": "executes a notebook",
    "cluster": "starts processes that exchange gradients, or a Ray cluster",
    "fuzz": "reads damaged and hostile input by the hundred",
}
"""Kinds of tests that are not in ``make test``."""


def pytest_configure(config: pytest.Config) -> None:
    for name, what in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {what}; not in `make test`")


def marked(item: pytest.Item) -> list[str]:
    """The markers of a test that keep it out of ``make test``."""
    return [name for name in MARKERS if item.get_closest_marker(name)]


LEFT_OUT, SECONDS = pytest.StashKey[Counter[str]](), pytest.StashKey[float]()
NONE = Counter[str]()
LIMIT = 5.0
"""Seconds of work of a test without a marker: of processors, child processes included, and of ``time.sleep``. What the fixture
``once`` makes for a whole run is no work of the test that needs it first. There is no limit where lines are traced, for coverage or
by a debugger.

Nothing here looks at the clock on the wall, which goes on while a machine does something else.
"""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with the most marked tests first, since a file is the work of one process: so all end at about the same time."""
    files = {item: item.nodeid.partition("::")[0] for item in items}
    heavy = Counter(file for item, file in files.items() if marked(item))
    items.sort(key=lambda item: (-heavy[files[item]], files[item]))


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Count what a marker leaves out, by its marker."""
    for item in items:
        item.config.stash.setdefault(LEFT_OUT, Counter()).update(marked(item)[:1])


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the counts to the process that prints."""
    if output := getattr(session.config, "workeroutput", None):
        counts = session.config.stash.get(LEFT_OUT, NONE)
        output["left out"] = dict(counts)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the counts of a process; those of all processes are the same."""
    node.config.stash[LEFT_OUT] = Counter(getattr(node, "workeroutput", {}).get("left out", {}))


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print how many tests were left out, and how to run them."""
    if config.option.markexpr and (left := config.stash.get(LEFT_OUT, NONE)):
        kinds = ", ".join(f"{count} {name}" for name, count in left.most_common())
        terminalreporter.write_line(f"{left.total()} tests left out ({kinds}): `make test-all` runs all, `pytest -m NAME` one kind")


more, sleep = [0.0], time.sleep
"""Seconds that count as work beside those of processors."""


def work() -> float:
    """Seconds of work that this process and the child processes that ended have done."""
    return sum(os.times()[:4]) + more[0]


def counted(seconds: float | SupportsIndex) -> None:
    """Sleep, and count it unless it is part of a loop that waits for something, which a busy machine makes longer."""
    more[0] += float(seconds) if float(seconds) >= 0.5 else 0
    sleep(seconds)


@contextmanager
def of_no_test() -> Iterator[None]:
    """Work that no single test is charged with."""
    begin = work()
    yield
    more[0] -= work() - begin


time.sleep = counted


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Measure the work of a test's fixtures, which are made for the first test that needs them."""
    item.stash[SECONDS] = work()
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Measure the work of a test."""
    item.stash[SECONDS] = work()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Fail a test that takes long and has no marker."""
    report = yield
    seconds = work() - item.stash[SECONDS]
    if call.when != "teardown" and report.passed and seconds > LIMIT and not marked(item) and sys.gettrace() is None:
        expected = f"at most {LIMIT:.0f} s of work, or one of the markers {', '.join(MARKERS)}"
        report.outcome, report.longrepr = "failed", f"{item.nodeid}: {call.when}: expected {expected}, found {seconds:.1f} s"
    return report


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Print a failure at once: a run that is stopped from outside never comes to its summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nFAILED {report.nodeid[:200]} ({report.when}, {report.duration:.0f} s)\n{report.longreprtext[-3000:]}", flush=True)
