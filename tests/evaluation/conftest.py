"""One evaluation for all tests that look at what it leaves."""

from pathlib import Path

import pytest

from tests.conftest import CONF, Once, succeed

EVALUATED = ["--seed_everything=3", "--model.omega=1.5", "--data.steps=5", "--model.budget.samples=4", "--trainer.accelerator=cpu"]
EVALUATED += ["--evaluation.samples=3", "--evaluation.steps=3", "--evaluation.variant=without a hat"]
EVALUATED += ["--trainer.enable_progress_bar=false", "--trainer.log_every_n_steps=1"]


def invert(tiny: Path, *options: str) -> None:
    succeed("invert", f"--config={CONF / 'object_rearrangement.yaml'}", f"--model.pretrained={tiny}", *EVALUATED, *options)


@pytest.fixture(scope="session")
def evaluated(once: Once, tiny: Path) -> Path:
    """A folder with films.json and logs/object_rearrangement/invert of a short inversion through the tiny model."""
    return once("evaluated", lambda folder: invert(tiny, "--evaluation.films=films.json"))


@pytest.fixture
def log(evaluated: Path) -> Path:
    return evaluated / "logs" / "object_rearrangement" / "invert"
