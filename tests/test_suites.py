"""The suites: what ``make test`` leaves out, and that a test without a marker stays short."""

import re
import sys
import time
from pathlib import Path

import pytest

from tests import suites
from tests.conftest import ROOT

pytest_plugins = ["pytester"]
SHORT = f"not ({' or '.join(suites.MARKERS)})"
LONG = """
import subprocess, sys, time
import pytest

WORK = "import time\\nwhile time.process_time() < .4: pass"

def work():
    begin = time.process_time()
    while time.process_time() < begin + .3:
        pass

@pytest.fixture(scope="module")
def made(): work()

def test_that_computes(): work()
def test_that_sleeps(): time.sleep(.5)
def test_that_starts_a_process(): subprocess.run([sys.executable, "-c", WORK])
def test_that_makes_a_fixture(made): pass
def test_that_is_short(made): pass
@pytest.mark.slow
def test_that_may_be_slow(): work()
@pytest.mark.slow
@pytest.mark.fuzz
def test_that_is_slow_and_hostile(): pass
@pytest.mark.browser
def test_in_a_browser(): pass
"""


def test_a_long_test_without_a_marker_fails_and_what_has_one_is_left_out(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # which takes seconds
    monkeypatch.setattr(time, "sleep", time.sleep)  # the inner hooks count it, too
    monkeypatch.setattr(sys, "gettrace", lambda: None)  # whatever measures coverage here
    pytester.makeconftest(Path(suites.__file__).read_text("utf-8").replace("LIMIT = 5.0", "LIMIT = 0.2"))
    pytester.makepyfile(LONG)
    done = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-v")
    failed = re.findall(r"::(test_\w+): (\w+): expected at most 0 s of work, or one of the markers slow", done.stdout.str())
    expected = [("test_that_computes", "call"), ("test_that_sleeps", "call"), ("test_that_starts_a_process", "call")]
    assert set(failed) == {*expected, ("test_that_makes_a_fixture", "setup")}
    done.assert_outcomes(passed=4, failed=3, errors=1)
    assert "left out" not in done.stdout.str()
    done = pytester.runpytest_inprocess("-p", "no:cacheprovider", "--collect-only", "-m", SHORT)
    done.stdout.fnmatch_lines(["3 tests left out (2 slow, 1 browser): `make test-all` runs all, `pytest -m NAME` one kind"])
    monkeypatch.setattr(sys, "gettrace", lambda: print)
    pytester.runpytest_inprocess("-p", "no:cacheprovider", "-k", "computes").assert_outcomes(passed=1)


def test_make_leaves_out_every_marker() -> None:
    (names,) = re.findall(r"^MARKED := (.+)$", (ROOT / "Makefile").read_text("utf-8"), re.M)
    assert names.split(" or ") == list(suites.MARKERS)


def test_no_test_waits_for_a_clock() -> None:
    """A sleep is a short step of a loop that waits for something, and no time that something took is compared."""
    for path in (ROOT / "tests").rglob("*.py"):
        if path not in (Path(__file__), Path(suites.__file__)):
            text = path.read_text("utf-8")
            assert all(float(seconds) < 0.5 for seconds in re.findall(r"time\.sleep\(([\d.]+)\)", text)), path
            assert "perf_counter" not in text, path
