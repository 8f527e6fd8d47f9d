"""The Dockerfile's steps, without Docker: what is copied is there and enough, and what is built from it runs."""

import fnmatch
import re
import shlex
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.checkout import copied
from tests.conftest import ROOT, python

TEXT = (ROOT / "Dockerfile").read_text("utf-8")
IGNORED = (ROOT / ".dockerignore").read_text("utf-8").split()


class Step(NamedTuple):
    """An instruction with its words, lines that go on joined."""

    kind: str
    text: str


STEPS = [
    Step(*line.split(maxsplit=1)) for line in re.sub(r"\\\n", " ", TEXT).splitlines() if line.strip() and not line.startswith("#")
]


def commands(step: Step) -> list[list[str]]:
    """The commands of ``RUN``, joined by ``&&``."""
    return [shlex.split(part) for part in step.text.split("&&")]


def sources(step: Step) -> list[str]:
    """What ``COPY`` copies."""
    return [word for word in step.text.split()[:-1] if not word.startswith("--")]


def context(folder: Path) -> Path:
    """What Docker would be sent: the checkout without what is ignored."""
    place = copied(folder)
    for path in list(place.iterdir()):
        if any(fnmatch.fnmatch(path.name, name.strip("/")) for name in IGNORED):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    return place


def test_what_is_copied_is_in_the_context() -> None:
    copies = [name for step in STEPS if step.kind == "COPY" for name in sources(step)]
    assert copies[-1] == "."
    assert [name for name in copies if not (ROOT / name).exists()] == []
    assert [name for name in copies if name in IGNORED] == []


def test_one_argument_each_chooses_the_image_and_the_index_of_torch() -> None:
    """So that an image with CUDA is built from the same file."""
    assert [step.text.partition("=")[0] for step in STEPS if step.kind == "ARG"] == ["BASE", "TORCH_INDEX"]
    (base,) = [step.text for step in STEPS if step.kind == "FROM"]
    assert base == "${BASE}"
    (torch,) = [command for step in STEPS if step.kind == "RUN" for command in commands(step) if command[-1] == "torch"]
    assert "${TORCH_INDEX:+--index-url" in " ".join(torch)
    told = (ROOT / "docs" / "development.md").read_text("utf-8")
    assert "--build-arg BASE=" in told
    assert "--build-arg TORCH_INDEX=" in told


def test_packages_come_with_hashes_and_the_program_runs_as_no_administrator() -> None:
    pip = [command for step in STEPS if step.kind == "RUN" for command in commands(step) if command[:2] == ["pip", "install"]]
    assert [command for command in pip if not {"--require-hashes", "--constraint", "--no-deps"} & set(command)] == []
    kinds = [step.kind for step in STEPS]
    assert kinds.index("USER") < kinds.index("COPY")


@pytest.mark.release
def test_the_last_step_installs_the_program_from_the_context_alone(tmp_path: Path) -> None:
    """As the file says it, into a folder of its own, with the packages of this environment."""
    pytest.importorskip("setuptools", reason="the build needs it, as in the lock file")
    (last,) = [commands(step) for step in STEPS if step.kind == "RUN" and "--no-build-isolation" in step.text]
    (install,) = last
    assert install[:2] == ["pip", "install"]
    place, target = context(tmp_path / "app"), tmp_path / "installed"
    done = python("-m", *install, "--quiet", "--target", target, folder=place, PYTHONPATH="")
    assert done.returncode == 0, done.stderr
    (entry,) = [step.text for step in STEPS if step.kind == "ENTRYPOINT"]
    (default,) = [step.text for step in STEPS if step.kind == "CMD"]
    program, *arguments = [*re.findall(r'"([^"]+)"', entry), *re.findall(r'"([^"]+)"', default)]
    assert program == "python"
    where = ["-c", "import ftl_lightning; print(ftl_lightning.__file__)"]
    for words, expected in ((arguments, "usage: "), (where, str(target))):
        found = python(*words, folder=tmp_path, PYTHONPATH=str(target))
        assert found.returncode == 0, found.stderr
        assert found.stdout.startswith(expected)
