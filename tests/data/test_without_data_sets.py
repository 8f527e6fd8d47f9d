"""What is told where the extras are not installed that other programs' data sets need."""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from ftl_lightning.domains.from_file import read_own
from ftl_lightning.services.errors import UserError
from tests.conftest import refused


@pytest.fixture(autouse=True)
def _not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec

    def find(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name in ("minari", "pyarrow") else found(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find)


def test_reading_a_data_set_needs_the_extra() -> None:
    with pytest.raises(UserError, match=r"strokes/test-v0: expected a file, found none; a Minari data set .*-lightning\[minari\]'"):
        read_own("strokes/test-v0")
    with pytest.raises(UserError, match=r"strokes.npz: expected a demonstrations file, found nothing"):
        read_own("strokes.npz")
    Path("robot/meta").mkdir(parents=True)
    Path("robot/meta/info.json").write_text("{}")
    with pytest.raises(UserError, match=r"robot: a LeRobot data set needs the package pyarrow, .*-lightning\[lerobot\]'"):
        read_own("robot")


@pytest.mark.parametrize(("out", "package"), [("minari:a-v0", "minari"), ("lerobot:a", "pyarrow")])
def test_writing_a_data_set_needs_the_extra(out: str, package: str, capsys: pytest.CaptureFixture[str]) -> None:
    for verb in (["generate", "object_rearrangement"], ["sample", "--pretrained=object_rearrangement"]):
        told = refused(capsys, [*verb, "--count=2", f"--out={out}"])
        expected = f"error: out: {out}: this data set needs the package {package}, which is not installed; pip install "
        assert told.startswith(expected)
        assert told.count("\n") == 1
