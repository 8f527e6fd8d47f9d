"""A method in a package of its own: installed, it pretrains, adapts, appears in tables and is used from Python."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.training.method import load_method, method_names
from ftl_lightning.training.model_folder import model_class
from tests.conftest import ROOT, Once, python, succeed
from tests.domains.test_plug_in import VERBS, installed

FLOW, STROKES = (ROOT / "examples" / name for name in ("ftl-flow", "ftl-strokes"))
SMALL = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--evaluation.samples=1", "--evaluation.steps=2"]
SMALL += ["--evaluation.figures=0"]
FIT = ["fit", f"--config={FLOW / 'flow.yaml'}", *SMALL, "--model.network={hidden_dim: 16, condition_dim: 8}"]
FIT += ["--trainer.max_steps=2", "--data.steps_per_epoch=2", "--data.samples_per_concept=2", "--data.batch_size=8"]
SETTINGS = FLOW / "flow_invert.yaml"
INVERT = ["invert", f"--config={SETTINGS}", *SMALL, "--data.steps=2", "--model.budget.samples=2"]
INVERT += ["--evaluation.results=strokes.csv"]
PYTHON = f"""
from ftl_lightning import FewShot
from ftl_lightning.domains.registry import load_domain

five = load_domain("strokes").source(None).draw("wave upwards", 5, 1)
model = FewShot.from_pretrained("logs/flow/fit/pretrained", settings={str(SETTINGS)!r})
concept = model.learn(five, steps=3, samples=8)
plans = model.sample(concept + 0.5 * model["arc upwards"], 3, steps=4)
print(repr(model), tuple(plans.states.shape), sorted(model.evaluate(plans, "wave upwards")))
"""
OFFERED = """[ftl_lightning.methods]
flow = ftl_flow:METHOD
[ftl_lightning.domains]
strokes = ftl_strokes:DOMAIN
"""


@pytest.fixture
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Both examples as if they were installed: on Python's path, with a card that holds their entry points."""
    card = tmp_path / "packages" / "examples-0.1.0.dist-info"
    card.mkdir(parents=True)
    (card / "METADATA").write_text("Metadata-Version: 2.1\nName: examples\nVersion: 0.1.0\n")
    (card / "entry_points.txt").write_text(OFFERED)
    for folder in (FLOW, STROKES, card.parent):
        monkeypatch.syspath_prepend(folder)
    load_domain.cache_clear()
    yield
    load_domain.cache_clear()


def expect_pretrained_and_adapted() -> None:
    """What the current folder holds after a fit and an inversion."""
    assert json.loads(Path("logs/flow/fit/pretrained/config.json").read_text())["kind"] == "flow"
    rows = pd.read_csv("strokes.csv")
    assert set(rows.loc[rows["role"] == "method", "method"]) == {"flow matching"}


@pytest.mark.release
def test_an_installed_method_pretrains_adapts_appears_in_tables_and_is_used_from_python(once: Once) -> None:
    packages = once("plug_ins", installed) / "packages"
    verbs = (FIT, INVERT, ["report", "--results=strokes.csv", "--out=report"])
    path = os.pathsep.join(map(str, (packages, ROOT)))
    done = python("-c", VERBS + PYTHON, *map(json.dumps, verbs), PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    expect_pretrained_and_adapted()
    assert "flow matching" in "".join(file.read_text() for file in Path("report").rglob("*.md"))
    told = done.stdout.splitlines()[-1]
    assert "flow matching" in told
    assert "(3, 32, 2) ['accuracy']" in told


def test_a_method_that_an_entry_point_offers_pretrains_adapts_and_is_used_from_python(offered: None) -> None:
    assert method_names()[-1] == "flow"
    assert model_class("flow") is load_method("flow").model()
    succeed(*FIT)
    succeed(*INVERT)
    expect_pretrained_and_adapted()
    model = FewShot.from_pretrained("logs/flow/fit/pretrained", settings=str(SETTINGS))
    concept = model.learn(model.domain.source(None).draw("wave upwards", 5, 1), steps=3, samples=8)
    plans = model.sample(concept + 0.5 * model["arc upwards"], 3, steps=4)
    assert "flow matching" in repr(model)
    assert (tuple(plans.states.shape), list(model.evaluate(plans, "wave upwards"))) == ((3, 32, 2), ["accuracy"])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_model(offered: None) -> None:
    for name in ("first", "second"):
        succeed(*FIT, f"--model.output={name}")
    first, second = (json.loads(Path(name, "config.json").read_text())["hash"] for name in ("first", "second"))
    assert first == second


def test_the_example_is_small() -> None:
    assert len((FLOW / "ftl_flow.py").read_text().splitlines()) <= 100
