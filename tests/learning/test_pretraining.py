import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from ftl_lightning.cli import main
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.learning import PretrainingModule
from ftl_lightning.learning.generative_model import GenerativeModel
from tests.conftest import CONF, ROOT, TINY

FIT = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *TINY, "--evaluation.samples=2", "--evaluation.figures=0"]
LOG = Path("logs/object_rearrangement/fit")


def fit(*options: str) -> int:
    return main([*FIT, "--data.steps_per_epoch=20", *options])


def weights(folder: Path = LOG) -> dict[str, torch.Tensor]:
    return load_file(folder / "pretrained" / "model.safetensors")


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    hashes = []
    for index, seed in enumerate((1, 1, 2)):
        assert fit("--trainer.max_steps=12", f"--seed_everything={seed}", f"--model.output=out{index}") == 0
        hashes.append(GenerativeModel.load(f"out{index}").hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_several_threads_give_the_same_bytes_too() -> None:
    torch.set_num_threads(2)
    wide = ["--data.batch_size=512", "--model.denoiser_args={hidden_dim: 256, depth: 2, condition_dim: 32}"]
    hashes = []
    for index in range(3):
        assert fit("--trainer.max_steps=12", *wide, f"--model.output=out{index}") == 0
        hashes.append(GenerativeModel.load(f"out{index}").hash)
    assert len(set(hashes)) == 1


def test_training_lowers_the_loss(tiny: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tiny.parent)).Reload()
    losses = [event.value for event in events.Scalars("val/loss")]
    assert len(losses) == 2
    assert losses[-1] < losses[0] < 1.0


def test_killed_in_the_middle_it_goes_on_to_the_same_result(tmp_path: Path) -> None:
    options = ["--data.steps_per_epoch=40", "--trainer.max_steps=90"]
    assert main([*FIT, *options, "--trainer.logger.init_args.version=unbroken"]) == 0
    # Every ten steps a checkpoint, in the middle of epochs; the run is slowed down so that the kill hits it in the middle.
    script = (
        "import sys, time\n"
        "from ftl_lightning.learning import PretrainingModule\n"
        "step = PretrainingModule.training_step\n"
        "PretrainingModule.training_step = lambda self, batch: (time.sleep(0.05), step(self, batch))[1]\n"
        "from ftl_lightning.cli import main\n"
        "main(sys.argv[1:])\n"
    )
    checkpoints = [
        "--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint",
        "--trainer.callbacks.save_last=true",
        "--trainer.callbacks.every_n_train_steps=10",
        "--trainer.callbacks.enable_version_counter=false",
        "--trainer.callbacks.filename=often",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, "-c", script, *FIT, *options, *checkpoints], env=environment)
    last = LOG / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 120
    while not last.is_file() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = torch.load(last, weights_only=True)["global_step"]
    assert 0 < step < 90
    assert not (LOG / "pretrained").exists()
    assert main([*FIT, *options, "--ckpt_path=last"]) == 0
    assert same(weights(), weights(LOG.parent / "unbroken"))


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_checkpoint(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--trainer.max_steps=60", "--model.learning_rate=1e30", "--model.warmup_steps=1", "--data.steps_per_epoch=1"]
    assert main([*FIT, *options]) == 2
    assert "training: the loss became" in capsys.readouterr().err
    assert not (LOG / "pretrained").exists()


def test_condition_dropout_is_drawn_per_sample() -> None:
    from ftl_lightning.domains.object_rearrangement.datamodule import ObjectRearrangementData
    from ftl_lightning.trainer import Trainer

    seen = []
    module = PretrainingModule(denoiser_args={"hidden_dim": 16, "depth": 1, "condition_dim": 8}, condition_dropout=0.5)
    data = ObjectRearrangementData(samples_per_concept=5, validation_per_concept=1, batch_size=400, steps_per_epoch=1)

    def spy(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
        seen.append(inputs[3].detach().clone())  # rows of the concepts, the empty one first

    trainer = Trainer(
        max_steps=1, logger=False, enable_checkpointing=False, enable_progress_bar=False, limit_val_batches=0, accelerator="cpu"
    )
    data.setup("fit")
    module.trainer = trainer
    trainer._data_connector.attach_datamodule(module, datamodule=data)
    module.configure_model()
    module.raw.denoiser.register_forward_pre_hook(spy)
    trainer.fit(module, datamodule=data)
    assert 140 < (seen[0] == 0).sum() < 260  # neither none nor all, as once a batch would give


def test_a_task_of_texts_is_composed_with_the_guidance_weight_and_against_others(tiny: Path) -> None:
    module = PretrainingModule(guidance=1.5)
    module.model = GenerativeModel.load(tiny)
    one, other = module.model.config.training_concepts[:2]
    found = module.composition(EvaluationTask("s", "g", texts=(one,), without=(other,)))
    assert found is not None
    assert found.weights.tolist() == [1.5, WITHOUT_WEIGHT]
    assert torch.equal(found.embeddings, torch.stack([module.model.concept(one), module.model.concept(other)]))
    assert module.composition(EvaluationTask("s", "g", learned=("new",), texts=(one,))) is None


def test_the_model_folder_round_trips_and_refuses_mixtures(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = GenerativeModel.load(tiny)
    assert not any(parameter.requires_grad for parameter in model.parameters())
    model.save(tmp_path / "copy")
    assert GenerativeModel.load(tmp_path / "copy").hash == model.hash
    config = tmp_path / "copy" / "config.json"
    config.write_text(config.read_text().replace(model.hash, "0" * 16))
    assert main(["sample", f"--pretrained={tmp_path / 'copy'}"]) == 2
    assert "copy/model.safetensors: expected the hash 0000000000000000" in capsys.readouterr().err
    config.write_text("{}")
    assert main(["sample", f"--pretrained={tmp_path / 'copy'}"]) == 2
    assert "config.json: expected the configuration of a pretrained model" in capsys.readouterr().err
