"""What starting costs: large packages that a verb does not need are not imported by it. Times are in ``benchmarks/imports.py``."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ftl_lightning.cli import COMMANDS
from tests.conftest import ROOT

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
PROGRAM = f"""
import json, sys
FORBIDDEN = {list(FORBIDDEN)}
def found(name):
    print(json.dumps([name, [one for one in FORBIDDEN if one in sys.modules]]), file=sys.stderr)
"""


def imported(program: str, folder: Path) -> dict[str, list[str]]:
    """Which of the packages were there at each point that a program marks by ``found(NAME)``."""
    command = [sys.executable, "-c", PROGRAM + program]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(line) for line in done.stderr.splitlines() if line.startswith("["))


def run(verbs: list[list[str]]) -> str:
    """A program that runs verbs one after another, and marks what was imported after each by its words."""
    return f"from ftl_lightning.cli import main\nfor verb in {verbs}:\n    assert main(verb) == 0, verb\n    found(' '.join(verb))"


def test_verbs_that_learn_without_a_trainer_import_none_of_its_packages(tmp_path: Path) -> None:
    assert imported(run(VERBS), tmp_path) == {" ".join(verb): [] for verb in VERBS}


def test_the_learner_in_python_and_the_page_import_none_of_its_packages(tmp_path: Path) -> None:
    pytest.importorskip("starlette", reason="the extra play serves the page")
    program = """
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
from ftl_lightning.play.application import Desk, playing
from ftl_lightning.play.server import serve
from ftl_lightning.play.workspace import Workspace
Workspace("strokes", None).work()
found("play")
"""
    points = imported(program, tmp_path)
    assert set(points) == {"load", "sample", "learn", "mix", "tabletop", "mocap", "play"}
    assert not any(points.values()), points


def test_help_of_these_verbs_does_not_even_import_torch(tmp_path: Path) -> None:
    verbs = [[verb, "--help"] for verb in COMMANDS] + [["invert", "agent", "five.npz", "--help"], ["--help"]]
    more = "FORBIDDEN += ['torch', 'numpy', 'PIL', 'safetensors']\n"
    assert imported(more + run(verbs), tmp_path) == {" ".join(verb): [] for verb in verbs}


def test_reports_and_studies_import_no_trainer(tmp_path: Path) -> None:
    modules = ("reporting.report", "reporting.html.page", "study.report")
    program = "".join(f"import ftl_lightning.{module}\n" for module in modules) + "found('report')"
    assert set(imported(program, tmp_path)["report"]) <= {"scipy", "pandas", "matplotlib", "rich"}


def test_what_is_imported_is_not_searched_for_garbage(tmp_path: Path) -> None:
    program = """
import gc
from ftl_lightning.starting import imported
before = gc.get_freeze_count()
assert imported("decimal") is imported("decimal") and gc.isenabled() and gc.get_freeze_count() > before
gc.disable()
imported("fractions")
assert not gc.isenabled(), "it was off before"
found("end")
"""
    assert "end" in imported(program, tmp_path)


def test_what_is_forbidden_is_found_where_it_is_imported(tmp_path: Path) -> None:
    assert imported("import scipy, sympy\nfound('both')", tmp_path) == {"both": ["sympy", "scipy"]}
