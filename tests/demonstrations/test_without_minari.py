"""What is told where the extra 'minari' is not installed."""

import importlib.util
from importlib.machinery import ModuleSpec

import pytest

from ftl_lightning.cli import main
from ftl_lightning.domains.from_file import read_own
from ftl_lightning.errors import UserError


@pytest.fixture(autouse=True)
def _not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec

    def find(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name == "minari" else found(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find)


def test_the_name_of_a_data_set_needs_the_extra() -> None:
    with pytest.raises(UserError, match=r"strokes/test-v0: expected a file, found the name of a Minari data set.*extra 'minari'"):
        read_own("strokes/test-v0")
    with pytest.raises(UserError, match=r"strokes.npz: expected a demonstrations file, found nothing"):
        read_own("strokes.npz")


def test_writing_a_data_set_needs_the_extra(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "object_rearrangement", "--task=circle above square", "--count=2", "--out=minari:a-v0"]) == 2
    assert (
        "error: out: expected a file, found the Minari data set 'a-v0', which needs the extra 'minari'" in capsys.readouterr().err
    )
