"""No verb imports large packages that it does not need. Times are in ``benchmarks/speed/imports.py``."""

import importlib.util
import json
from pathlib import Path

import pytest

from ftl_lightning.cli.main import COMMANDS
from tests.conftest import python

FORBIDDEN = {
    "lightning": "trains",
    "torchmetrics": "comes with Lightning",
    "transformers": "reads texts and pictures with large models",
    "torch._dynamo": "is torch's compiler",
    "sympy": "comes with torch's compiler",
    "torch.distributed.fsdp": "shards models",
    "torch.utils.tensorboard": "writes curves",
    "tensorboard": "shows curves",
    "scipy": "tests and explains",
    "pandas": "reads results",
    "matplotlib": "draws",
    "rich": "draws tables and bars",
    "huggingface_hub": "downloads",
    "sklearn": "measures",
}
"""Packages with what they are for, that nothing below does."""
FEW = ["--count", "1", "--steps", "2", "--sampler", "ddim"]
VERBS = [
    ["generate", "object_rearrangement", "--task", "square diagonal to triangle", "--count", "5", "--out", "five.npz"],
    ["check", "five.npz"],
    ["check", "five.npz", "--pretrained", "object_rearrangement"],
    ["concepts", "object_rearrangement"],
    ["invert", "object_rearrangement", "five.npz", "--steps", "2", "--form", "paper"],
    ["sample", "--pretrained", "object_rearrangement", "--concept", "concepts/square_diagonal_to_triangle.safetensors", *FEW],
    ["sample", "--pretrained", "agent", "--compose", "go to bowl", *FEW],
]
"""In one process one after another: what a verb imports stays imported."""
PYTHON = """
from ftl_lightning import FewShot
model = FewShot.from_pretrained("strokes")
found("load")
one, other = model.training_concepts[:2]
five = model.sample(model[one], 3, sampler="ddim", steps=2)
found("sample")
learned = model.learn(five.states, name="own", steps=2, form="paper")
model.check(five.states, name="own")
learned.save("own.safetensors")
found("learn")
model.sample(learned + 0.5 * model[other], 2, sampler="ddim", steps=2)
found("mix")
for name in ("tabletop", "mocap"):
    FewShot.from_pretrained(name)
    found(name)
"""
"""The learner in Python."""
PAGE = """
from ftl_lightning.apps.play.application import Desk, playing
from ftl_lightning.apps.play.server import serve
from ftl_lightning.apps.play.workspace import Workspace
Workspace("strokes", None).work()
found("play")
"""
REPORTS = """
import ftl_lightning.reporting.report, ftl_lightning.reporting.page, ftl_lightning.apps.study.report
found("report")
"""
PROGRAM = f"""
import json, sys
FORBIDDEN = {list(FORBIDDEN)}
def found(name):
    print(json.dumps([name, [one for one in FORBIDDEN if one in sys.modules]]), file=sys.stderr)
"""


def imported(program: str, folder: Path) -> dict[str, list[str]]:
    """Which of the packages were there at each point that a program marks by ``found(NAME)``."""
    done = python("-c", PROGRAM + program, folder=folder)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(line) for line in done.stderr.splitlines() if line.startswith("["))


def run(verbs: list[list[str]]) -> str:
    """A program that runs verbs one after another, and marks what was imported after each by its words."""
    begin = "from ftl_lightning.cli.main import main"
    return f"{begin}\nfor verb in {verbs}:\n    assert main(verb) == 0, verb\n    found(' '.join(verb))\n"


@pytest.mark.slow
def test_what_learns_without_a_trainer_imports_none_of_its_packages(tmp_path: Path) -> None:
    """Verbs, the learner in Python and the page in one process, and then what reports and studies import besides."""
    page = PAGE if importlib.util.find_spec("starlette") else ""
    points = imported(run(VERBS) + PYTHON + page + REPORTS, tmp_path)
    assert set(points.pop("report")) <= {"scipy", "pandas", "matplotlib", "rich"}
    expected = [*map(" ".join, VERBS), "load", "sample", "learn", "mix", "tabletop", "mocap", *["play"][: bool(page)]]
    assert points == {name: [] for name in expected}


def test_help_of_these_verbs_does_not_even_import_torch(tmp_path: Path) -> None:
    verbs = [[verb, "--help"] for verb in COMMANDS] + [["invert", "agent", "five.npz", "--help"], ["--help"]]
    more = "FORBIDDEN += ['torch', 'numpy', 'PIL', 'safetensors']\n"
    assert imported(more + run(verbs), tmp_path) == {" ".join(verb): [] for verb in verbs}


def test_forbidden_packages_are_found(tmp_path: Path) -> None:
    for name in ("scipy", "sympy"):
        (tmp_path / f"{name}.py").touch()
    program = "found('neither')\nimport scipy, sympy\nfound('both')\n"
    assert imported(program, tmp_path) == {"neither": [], "both": ["sympy", "scipy"]}
