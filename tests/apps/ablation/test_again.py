"""A cell that runs again after it was lost."""

from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.apps.ablation.run import attempt
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from tests.conftest import CONF


def fit(version: str) -> Cell:
    options = {
        "model.denoiser_args": "{hidden_dim: 16, depth: 1, condition_dim: 8}",
        "model.output": f"models/{version}",
        "data.samples_per_concept": "20",
        "data.validation_per_concept": "2",
        "data.batch_size": "8",
        "trainer.max_steps": "5",
        "trainer.limit_val_batches": "0",
        "trainer.accelerator": "cpu",
        "trainer.enable_progress_bar": "false",
        "trainer.callbacks.init_args.every_n_train_steps": "1",
        "trainer.logger.init_args.version": version,
        "evaluation.samples": "2",
    }
    return Cell("fit", (str(CONF / "object_rearrangement.yaml"),), options, "", version)


@pytest.mark.slow
def test_a_lost_pretraining_goes_on_from_its_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was lost in the fourth of five steps, and one that was not lost, end with the same bytes."""
    step = PretrainingModule.training_step
    steps: list[int] = []

    def until_lost(module: PretrainingModule, batch: Any) -> Any:
        steps.append(module.global_step)
        if steps[-1] == 3 and steps.count(3) == 1:
            raise RuntimeError("lost")
        return step(module, batch)

    monkeypatch.setattr(PretrainingModule, "training_step", until_lost)
    assert attempt(fit("lost"), set()).error == "RuntimeError('lost')"
    assert attempt(fit("lost"), set(), True).error == ""
    assert steps == [0, 1, 2, 3, 3, 4]
    steps += [3]
    assert attempt(fit("whole"), set(), True).error == ""  # one that was lost before its first checkpoint begins anew
    assert steps[7:] == [0, 1, 2, 3, 4]
    whole, lost = (Path("models", name, "model.safetensors").read_bytes() for name in ("whole", "lost"))
    assert whole == lost
    assert not list(Path("logs").rglob("lost_1"))
