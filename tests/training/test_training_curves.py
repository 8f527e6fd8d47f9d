"""Benchmarks of pretraining: curves from what runs logged, and where in the loss the concept is."""

import runpy
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

from ftl_lightning import FewShot
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT


def test_a_resumed_run_is_one_curve(tmp_path: Path) -> None:
    curve = runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "training_curves.py"))["curve"]
    for steps in ((99, 199), (199, 299)):
        with SummaryWriter(str(tmp_path)) as log:
            for step in steps:
                log.add_scalar("val/accuracy", step / 1000, step)
    assert curve(str(tmp_path), "val/accuracy") == [(100, 0.099), (200, 0.199), (300, 0.299)]
    with pytest.raises(UserError, match="expected 'val/loss' among what was logged, found val/accuracy"):
        curve(str(tmp_path), "val/loss")
    with pytest.raises(UserError, match="expected the log folder of a fit, found none"):
        curve(str(tmp_path / "none"), "val/loss")


@pytest.mark.slow
def test_a_model_that_uses_the_concept_loses_without_it() -> None:
    losses = runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "concept_in_loss.py"))["losses"]
    few = FewShot.from_pretrained("object_rearrangement")
    found = losses(few.model, few.domain.source(None).split("validation", 20, 0), 90)
    assert found["right"] > 0
    assert found["others"] > 0
    assert found["none"] > 0
