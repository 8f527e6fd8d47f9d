"""A method in a package of its own: installed, it pretrains, adapts, appears in tables and is used from Python."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from tests.conftest import ROOT

FLOW = ROOT / "examples" / "ftl-flow"
SMALL = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--evaluation.samples=4", "--evaluation.steps=3"]
FIT = ["--trainer.max_steps=60", "--data.steps_per_epoch=60", "--data.samples_per_concept=20", "--data.batch_size=32"]
PYTHON = """
from ftl_lightning import FewShot
from ftl_lightning.domains.registry import load_domain

five = load_domain("strokes").source(None).draw("wave upwards", 5, 1)
model = FewShot.from_pretrained("logs/flow/fit/pretrained", settings="flow_invert.yaml")
concept = model.learn(five, steps=3, samples=8)
plans = model.sample(concept + 0.5 * model["arc upwards"], 3, steps=4)
print(repr(model), tuple(plans.states.shape), sorted(model.evaluate(plans, "wave upwards")))
"""


def run(packages: Path, *command: str) -> str:
    """What a program says, with another folder of packages."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (packages, ROOT))), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder into which the method and the domain that it is shown on were installed as packages."""
    folder = tmp_path_factory.mktemp("installed")
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(folder / "packages")]
    for example in (FLOW, ROOT / "examples" / "ftl-strokes"):
        source = folder / example.name
        shutil.copytree(example, source, ignore=shutil.ignore_patterns("logs", "build", "*.egg-info", "__pycache__"))
        subprocess.run([sys.executable, "-m", "pip", "install", *options, str(source)], check=True)
    return folder / "packages"


def test_an_installed_method_pretrains_adapts_appears_in_tables_and_is_used_from_python(installed: Path) -> None:
    for name in ("flow.yaml", "flow_invert.yaml"):
        shutil.copy(FLOW / name, name)
    program = ("-m", "ftl_lightning")
    run(installed, *program, "fit", "--config=flow.yaml", *SMALL, *FIT)
    assert json.loads(Path("logs/flow/fit/pretrained/config.json").read_text())["kind"] == "flow"
    run(installed, *program, "invert", "--config=flow_invert.yaml", *SMALL, "--data.steps=5")
    rows = pd.read_csv("logs/flow/invert/results.csv")
    assert set(rows.loc[rows["role"] == "method", "method"]) == {"flow matching"}
    Path("results").mkdir()
    shutil.copy("logs/flow/invert/results.csv", "results/strokes.csv")
    run(installed, *program, "report", "--results", "results", "--out", "report")
    tables = "".join(path.read_text() for path in Path("report").rglob("*.md"))
    assert "flow matching" in tables
    told = run(installed, "-c", PYTHON)
    assert "flow matching" in told
    assert "(3, 32, 2) ['accuracy']" in told


def test_the_same_seed_gives_the_same_model(installed: Path) -> None:
    shutil.copy(FLOW / "flow.yaml", "flow.yaml")
    hashes = []
    for name in ("first", "second"):
        run(
            installed,
            "-m",
            "ftl_lightning",
            "fit",
            "--config=flow.yaml",
            *SMALL,
            *FIT,
            "--trainer.max_steps=20",
            f"--model.output={name}",
        )
        hashes.append(json.loads(Path(name, "config.json").read_text())["hash"])
    assert hashes[0] == hashes[1]


def test_the_example_is_small() -> None:
    assert len((FLOW / "ftl_flow.py").read_text().splitlines()) <= 100
