"""What is released: the wheel and the source distribution, built once, what they hold, and the program and types of the wheel."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from packaging.metadata import Metadata
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from ftl_lightning.version import __version__
from tests.checkout import copied
from tests.conftest import ROOT, python

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
LARGEST = 60e6
"""Bytes of either file."""
RECORD = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE", "top_level.txt"}
"""What a wheel holds besides the package."""
AROUND = {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in", "PKG-INFO", "README.md", "pyproject.toml"}
"""What a source distribution holds besides the package and what setuptools keeps for itself."""


class Released(NamedTuple):
    """The two files, and every file of the package in the checkout that they come from, relative to it."""

    wheel: Path
    source: Path
    package: set[str]


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Released:
    """Built as for an index: the wheel from the source distribution, so that this holds all that is needed."""
    for name in ("build", "setuptools", "twine"):
        pytest.importorskip(name, reason="the extra dev builds releases")
    folder = tmp_path_factory.mktemp("release")
    source = copied(folder / "checkout")
    for run in ("logs", "build/lib/ftl_lightning"):  # of earlier work
        (source / run).mkdir(parents=True)
        (source / run / "left_over.py").touch()
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,), (archive,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    return Released(wheel, archive, package_files(source))


ALONE = "ftl_lightning/pretrained/mocap_root/"
"""Folder of the package that ships with the repository alone."""


def package_files(checkout: Path) -> set[str]:
    package = checkout / "ftl_lightning"
    folders = (package, package / "conf", package / "pretrained")  # links are not followed
    every = {path.relative_to(checkout).as_posix() for folder in folders for path in folder.rglob("*") if path.is_file()}
    return {name for name in every if not name.startswith(ALONE)}


@pytest.mark.release
def test_the_wheel_holds_every_file_of_the_package_and_nothing_else(released: Released) -> None:
    with zipfile.ZipFile(released.wheel) as archive:
        inside = set(archive.namelist())
    assert {name for name in inside if name.startswith("ftl_lightning/")} == released.package
    record = f"ftl_lightning-{__version__}.dist-info/"
    assert inside - released.package == {record + name for name in RECORD}
    kinds = {".js", ".html", ".css", ".yaml", ".json", ".md", ".csv", ".safetensors", ".py", ".typed"}
    assert {Path(name).suffix for name in released.package} == kinds
    some = (
        "py.typed",
        "conf/agent.yaml",
        "pretrained/strokes/model.safetensors",
        "domains/mocap/segments.csv",
        "apps/play/page.js",
    )
    assert {f"ftl_lightning/{name}" for name in some} <= inside


@pytest.mark.release
def test_the_source_distribution_holds_what_the_wheel_is_built_from_and_nothing_else(released: Released) -> None:
    with tarfile.open(released.source) as archive:
        assert not [member.name for member in archive if not (member.isfile() or member.isdir())]
        inside = {member.name.partition("/")[2] for member in archive if member.isfile()}
    own = {name for name in inside if name.startswith("ftl_lightning.egg-info/")} | {"setup.cfg"}
    assert inside - own == released.package | AROUND


@pytest.mark.release
def test_an_index_would_take_them_and_they_are_small(released: Released) -> None:
    assert all(1e6 < file.stat().st_size < LARGEST for file in (released.wheel, released.source))
    done = python("-m", "twine", "check", "--strict", released.wheel, released.source)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("PASSED") == 2


@pytest.mark.release
def test_the_wheel_says_what_it_is(released: Released) -> None:
    with zipfile.ZipFile(released.wheel) as archive:
        record = f"ftl_lightning-{__version__}.dist-info"
        said = Metadata.from_email(archive.read(f"{record}/METADATA"))
        entries = archive.read(f"{record}/entry_points.txt").decode()
    assert (said.name, str(said.version), said.license_expression) == (PROJECT["name"], __version__, PROJECT["license"])
    assert said.requires_python == SpecifierSet(PROJECT["requires-python"])
    assert said.description == (ROOT / "README.md").read_text("utf-8")
    assert said.description_content_type == "text/markdown"
    assert set(said.provides_extra or ()) == set(PROJECT["optional-dependencies"])
    needed = {one for one in said.requires_dist or () if one.marker is None}
    assert needed == set(map(Requirement, PROJECT["dependencies"]))
    offered = {group: dict(re.findall(r"^(\S+) = (\S+)$", text, re.M)) for group, text in sections(entries).items()}
    assert offered == {**PROJECT["entry-points"], "console_scripts": PROJECT["scripts"]}


def sections(text: str) -> dict[str, str]:
    """The parts of a file with headings in square brackets."""
    _, *parts = re.split(r"^\[(.+)\]$", text, flags=re.M)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_the_version_stands_in_one_place() -> None:
    assert "version" not in PROJECT
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"] == __version__


def test_the_log_of_changes_tells_of_this_version() -> None:
    """Keep a Changelog: the newest first, the present version below what is not released yet."""
    log = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.findall(r"^## \[?([^\]\s]+)\]?", log, re.M)[:2] == ["Unreleased", __version__]
    assert set(re.findall(r"^### (.+)$", log, re.M)) <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


@pytest.fixture(scope="module")
def interpreter(released: Released, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter that has the wheel, and what the wheel needs, but not this checkout."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    with zipfile.ZipFile(released.wheel) as archive:
        archive.extractall(packages)
    # A folder that is named here is searched, but what it names in turn, such as a checkout, is not.
    (packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n", "utf-8")
    return folder / "bin" / "python"


def from_wheel(interpreter: Path, program: str, *arguments: str | Path, given: str = "", **variables: str) -> str:
    """What a program prints that runs with the wheel in the current folder, to its end; ``given`` is its standard input."""
    command = [interpreter, "-c", program, *arguments]
    known = os.environ | {"OMP_NUM_THREADS": "1"} | variables
    done = subprocess.run(command, input=given, env=known, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


README = (ROOT / "README.md").read_text("utf-8")
BLOCK = re.compile(r"^```python\n(?P<program>.*?)^```$|^ {4}(?P<command>python -m ftl_lightning (?:[^\n\\]|\\\n)+)$", re.M | re.S)
QUICK = ["--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.references=false", "--evaluation.diversity=false"]
QUICK += ["--evaluation.figures=0", "--trainer.enable_progress_bar=false"]
SHORT = {
    "fit": ["--trainer.max_steps=2", "--data.steps_per_epoch=2", *QUICK],
    "invert": ["--data.steps=2", "--model.form=paper", "--model.budget.samples=8", "--evaluation.closed_loop=false", *QUICK],
    "sample": ["--count=1", "--sampler=ddim", "--steps=2"],
    "report": [f"--results={ROOT / 'results'}"],  # a wheel has no results
}
"""Options that make the README's commands a matter of seconds. ``play`` serves until it is stopped."""
FEWER = {
    "count=10": "count=1",
    'form="paper", progress=True)': 'steps=2, form="paper")',
    "observed=starts)": 'observed=starts, sampler="ddim", steps=2)',
    'starts, goal="go to red bowl")': 'starts, goal="go to red bowl", replan=32, sampler="ddim", steps=2)',
}
"""The same in its programs."""
RUN = """
import json, sys, time
import ftl_lightning
from ftl_lightning.cli.main import main
for kind, content in json.load(sys.stdin):
    print(round(time.monotonic()), kind, content, file=sys.stderr)
    if kind == "program":
        exec(compile(content, "README.md", "exec"), {})
    else:
        assert main(content) == 0, content
print(ftl_lightning.__file__)
"""


@pytest.mark.release
def test_the_blocks_of_the_readme_run_from_the_wheel(interpreter: Path, tmp_path: Path) -> None:
    """In the order in which they stand, each with what the ones before have left, in one process."""
    pytest.importorskip("pybullet", reason="the README's drive runs in the simulator of the extra navigation")
    blocks: list[tuple[str, str | list[str]]] = []
    for found in BLOCK.finditer(README):
        if program := found["program"]:
            for text, shorter in FEWER.items():
                assert text in README, text
                program = program.replace(text, shorter)
            blocks.append(("program", program))
        else:
            verb, *options = shlex.split(found["command"].replace("\\\n", " "))[3:]
            blocks.append(("command", [verb, *options, *SHORT.get(verb, [])]))
    commands = [block for block in blocks if block[1][0] != "play"]
    assert [kind for kind, _ in commands].count("program") == README.count("```python") == 2
    assert len(commands) == 6
    place = from_wheel(interpreter, RUN, given=json.dumps(commands)).splitlines()[-1]
    assert Path(place).is_relative_to(interpreter.parent.parent)
    written = {"red_bowl.gif", "strokes.npz", "five.npz", "samples.png"}
    assert written <= {path.name for path in tmp_path.iterdir()}


NOTEBOOK = """
import sys
import nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
notebook.cells.append(nbformat.v4.new_code_cell("import ftl_lightning\\nprint(ftl_lightning.__file__)"))
NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
print([cell.execution_count for cell in notebook.cells if cell.cell_type == "code"])
print(notebook.cells[-1].outputs[0].text)
"""


TWO_STEPS = {'model.learn(five, name=\\"heart\\")': 'model.learn(five, name=\\"heart\\", steps=2)', "record.right > 0.8": "record"}
"""Texts of the notebook's file, and what makes it a matter of seconds."""


@pytest.mark.release
def test_the_notebook_of_five_cells_runs_from_the_wheel(interpreter: Path, tmp_path: Path) -> None:
    """All but its installation, and learning in two steps; that the learned heart is one is what the notebook's test looks at."""
    pytest.importorskip("nbclient", reason="the extra dev runs notebooks")
    folders = {"JUPYTER_PREFER_ENV_PATH": "1", "JUPYTER_DATA_DIR": str(tmp_path), "IPYTHONDIR": str(tmp_path)}
    text = (ROOT / "notebooks" / "five_cells.ipynb").read_text("utf-8")
    for kept, shorter in TWO_STEPS.items():
        assert kept in text, kept
        text = text.replace(kept, shorter)
    (tmp_path / "five_cells.ipynb").write_text(text, "utf-8")
    ran, place = from_wheel(interpreter, NOTEBOOK, "five_cells.ipynb", **folders).split("\n", 1)
    assert ran == "[None, 1, 2, 3, 4, 5]"
    assert Path(place.strip()).is_relative_to(interpreter.parent.parent)


USER = """
from typing import assert_type

import ftl_flow
import ftl_strokes
import numpy as np
import torch

from ftl_lightning import Composition, Concept, Demonstrations, FewShot, list_models
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Concepts, Domain, Metric, Plans
from ftl_lightning.domains.domain import Generated
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.services.errors import UserError
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.training.method import Method

PLANS = Plans(horizon=8, columns=("x", "y"), units=("cm", "cm"))


def draw(task: str, count: int, seed: int) -> torch.Tensor:
    return torch.zeros(count, PLANS.horizon, len(PLANS.columns))


def ends(goal: str, states: torch.Tensor, starts: InitialStates | None) -> torch.Tensor:
    return states[:, -1].norm(dim=1) < 0.1


SOURCE = Generated("points", PLANS, ("rest",), draw)
CONCEPTS = Concepts(("rest",), few_shot_suites(("rest",), ("go",)))
DOMAIN = Domain("points", PLANS, CONCEPTS, lambda root: SOURCE, metrics={"ends": Metric(ends)})
assert_type(ftl_strokes.DOMAIN, Domain)
assert_type(ftl_flow.METHOD, Method)
assert_type(list_models(), list[str])

model = FewShot.from_pretrained("agent")
five = Demonstrations.load("five.npz")
try:
    concept = model.learn(five.states.numpy(), {"world": np.zeros((5, 8, 52))}, name="go", steps=10)
except UserError as error:
    raise SystemExit(str(error)) from error
assert_type(concept, LearnedConcept)
assert_type(concept.concept, Concept)
mixed = concept + 0.8 * model["go to bowl"]
assert_type(mixed, Composition)
plans = model.sample(mixed, 10, observed=model.starts("go", count=10), sampler="ddim", steps=5)
assert_type(plans, Demonstrations)
assert_type(model.evaluate(plans, goal="go"), dict[str, float])
model.render(plans, goal="go").savefig("plans.png")
"""
"""What a user writes, with a domain and a method in packages of their own; a type that were ``Any`` would be an error."""
MYPY = """
[mypy]
strict = true
# As in this project: arithmetic on tensors is Any to torch's own types, some of which are missing.
warn_return_any = false
disable_error_code = no-untyped-call

# Packages whose types a user of this one does not meet take most of the time.
[mypy-fsspec.*,jsonargparse.*,lightning.*,matplotlib.*,omegaconf.*,pandas.*,PIL.*,rich.*,safetensors.*,scipy.*,sympy.*]
follow_imports = skip
[mypy-tensorboard.*,torchmetrics.*,transformers.*,torch._dynamo.*,torch._inductor.*,torch.ao.*,torch.distributed.*]
follow_imports = skip
[mypy-torch._export.*,torch._functorch.*,torch.export.*,torch.fx.*,torch.onnx.*]
follow_imports = skip
"""
WRONG = """
from ftl_lightning import FewShot

model = FewShot.from_pretrained("agent")
model.sample(model["go to bowl"], count="ten")
model.lern()
"""


@pytest.fixture
def programs(tmp_path: Path) -> list[str]:
    """Files in the current folder: what users write, and something wrong."""
    (tmp_path / "user.py").write_text(USER, "utf-8")
    (tmp_path / "wrong.py").write_text(WRONG, "utf-8")
    for example in ("ftl-flow/ftl_flow.py", "ftl-strokes/ftl_strokes.py"):
        shutil.copy(ROOT / "examples" / example, tmp_path)
    return sorted(path.name for path in tmp_path.glob("*.py"))


@pytest.mark.release
def test_programs_of_users_are_checked_by_pyright_against_the_types_of_the_wheel(interpreter: Path, programs: list[str]) -> None:
    """By basedpyright, the same with a node of its own, in pyright's standard mode."""
    pytest.importorskip("basedpyright", reason="the extra dev checks types")
    Path("pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "standard"}), "utf-8")
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", str(interpreter), "--project", "."]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = json.loads(done.stdout)
    assert told["summary"]["filesAnalyzed"] == len(programs)
    errors = [one for one in told["generalDiagnostics"] if one["severity"] == "error"]
    found = [(Path(one["file"]).name, one["range"]["start"]["line"] + 1, one["rule"]) for one in errors]
    assert sorted(found) == [("wrong.py", 5, "reportArgumentType"), ("wrong.py", 6, "reportAttributeAccessIssue")], errors


@pytest.mark.release
def test_programs_of_users_are_checked_against_the_types_of_the_wheel(
    interpreter: Path, programs: list[str], tmp_path: Path
) -> None:
    """By mypy in its strict mode, which takes the package's types only where it says that it has some."""
    pytest.importorskip("mypy", reason="the extra dev checks types")
    (tmp_path / "mypy.ini").write_text(MYPY, "utf-8")
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--python-executable", str(interpreter), *programs]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    found = re.findall(r"^(\w+\.py):(\d+): error: .*\[([\w-]+)\]$", done.stdout, re.M)
    assert found == [("wrong.py", "5", "arg-type"), ("wrong.py", "6", "attr-defined")], done.stdout
