"""One server for the tests of a module."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.play.served import Served, served


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The page of object rearrangement, whose model ships."""
    with served(tmp_path_factory.mktemp("played"), ["object_rearrangement"]) as found:
        yield found


def files_of(folder: Path) -> set[Path]:
    """Everything in a folder."""
    return set(folder.rglob("*"))
