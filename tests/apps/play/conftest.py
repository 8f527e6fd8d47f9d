"""What the tests of the page share: one browser and one server for a module."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.igm.settings import PAPER
from tests.apps.play.served import Served, here

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[Browser]":
    """A browser, which opens a page after the other. It ends with the module: a page that stays open draws its films for ever."""
    pytest.importorskip("selenium", reason="selenium is not installed")
    from tests.apps.play.browser import browser, installed

    if not installed():
        pytest.skip("needs Chromium and its driver")
    with browser(tmp_path_factory.mktemp("chromium")) as found:
        found.pause = 0.1
        yield found


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The page of object rearrangement, whose model ships."""
    with here(tmp_path_factory.mktemp("played"), "play", "object_rearrangement") as found:
        yield found


@pytest.fixture
def learns_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """A concept is learned in a few steps, where a test looks at the page and not at the concept."""
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({"form": PAPER}, 20))


def files_of(folder: Path) -> set[Path]:
    """Everything in a folder."""
    return set(folder.rglob("*"))
