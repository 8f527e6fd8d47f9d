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
from ftl_lightning.errors import UserError
from ftl_lightning.learning import PretrainingModule
from ftl_lightning.learning.model_folder import read_model, save_model
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.methods.ftl_igm.pretraining import LossOptions
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
        hashes.append(read_model(GenerativeModel, f"out{index}").hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_several_threads_give_the_same_bytes_too() -> None:
    torch.set_num_threads(2)
    wide = ["--data.batch_size=512", "--model.denoiser_args={hidden_dim: 256, depth: 2, condition_dim: 32}"]
    hashes = []
    for index in range(3):
        assert fit("--trainer.max_steps=12", *wide, f"--model.output=out{index}") == 0
        hashes.append(read_model(GenerativeModel, f"out{index}").hash)
    assert len(set(hashes)) == 1


def test_training_lowers_the_loss(tiny: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tiny.parent)).Reload()
    losses = [event.value for event in events.Scalars("loss/val")]
    assert len(losses) == 2
    assert losses[-1] < losses[0] < 1.0


def test_killed_in_the_middle_it_goes_on_to_the_same_result(tmp_path: Path) -> None:
    options = ["--data.steps_per_epoch=40", "--trainer.max_steps=90", DENOISER]
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


def given(batch_size: int, loss: LossOptions) -> tuple[torch.Tensor, torch.Tensor]:
    """Timesteps and rows of the concepts that the network is given in the first step of a fit."""
    from ftl_lightning.domains.object_rearrangement.datamodule import ObjectRearrangementData
    from ftl_lightning.trainer import Trainer

    seen = []
    module = PretrainingModule(denoiser_args={"hidden_dim": 16, "depth": 1, "condition_dim": 8}, loss=loss)
    data = ObjectRearrangementData(samples_per_concept=5, validation_per_concept=1, batch_size=batch_size, steps_per_epoch=1)

    def spy(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
        seen.append((inputs[1].clone(), inputs[3].clone()))

    trainer = Trainer(
        max_steps=1, logger=False, enable_checkpointing=False, enable_progress_bar=False, limit_val_batches=0, accelerator="cpu"
    )
    data.setup("fit")
    module.trainer = trainer
    trainer._data_connector.attach_datamodule(module, datamodule=data)
    module.configure_model()
    module.raw.denoiser.register_forward_pre_hook(spy)
    trainer.fit(module, datamodule=data)
    return seen[0]


def test_condition_dropout_is_drawn_per_sample() -> None:
    _, rows = given(400, LossOptions(condition_dropout=0.5))
    assert 140 < (rows == 0).sum() < 260  # neither none nor all, as once a batch would give


@pytest.mark.parametrize(("power", "noisiest"), [(1.0, 0.10), (3.0, 0.46), (10.0, 0.79)])
def test_a_power_draws_noisy_timesteps(power: float, noisiest: float) -> None:
    timesteps, _ = given(2000, LossOptions(timestep_power=power))
    assert timesteps.min() >= 0
    assert timesteps.max() == 99
    assert (timesteps >= 90).float().mean().item() == pytest.approx(noisiest, abs=0.05)


def test_a_task_of_texts_is_composed_with_the_guidance_weight_and_against_others(tiny: Path) -> None:
    module = PretrainingModule(guidance=1.5)
    module.model = read_model(GenerativeModel, tiny)
    one, other = module.model.config.training_concepts[:2]
    found = module.composition(EvaluationTask("s", "g", texts=(one,), without=(other,)))
    assert found is not None
    assert found.weights.tolist() == [1.5, WITHOUT_WEIGHT]
    assert torch.equal(found.embeddings, torch.stack([module.model.concept(one), module.model.concept(other)])[:, None])
    assert module.composition(EvaluationTask("s", "g", learned=("new",), texts=(one,))) is None


def test_the_model_folder_round_trips_and_refuses_mixtures(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = read_model(GenerativeModel, tiny)
    assert not any(parameter.requires_grad for parameter in model.parameters())
    save_model(model, tmp_path / "copy")
    assert read_model(GenerativeModel, tmp_path / "copy").hash == model.hash
    config = tmp_path / "copy" / "config.json"
    config.write_text(config.read_text().replace(model.hash, "0" * 16))
    assert main(["sample", f"--pretrained={tmp_path / 'copy'}"]) == 2
    assert "copy/model.safetensors: expected the hash 0000000000000000" in capsys.readouterr().err
    config.write_text("{}")
    assert main(["sample", f"--pretrained={tmp_path / 'copy'}"]) == 2
    assert "config.json: expected the configuration of a pretrained model" in capsys.readouterr().err


# Checkpoints

DENOISER = "--model.denoiser_args={hidden_dim: 32, depth: 2, condition_dim: 16, dropout: 0.1}"
SMALL = ["--data.samples_per_concept=10", "--data.validation_per_concept=2", "--data.batch_size=16", "--data.steps_per_epoch=4"]
SMALL += ["--trainer.max_steps=10", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
SMALL += ["--evaluation.samples=2", "--evaluation.figures=0"]
OFTEN = ["--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint", "--trainer.callbacks.every_n_train_steps=1"]
OFTEN += ["--trainer.callbacks.save_top_k=-1", "--trainer.callbacks.filename=often-{step}", "--trainer.callbacks.save_last=true"]
OFTEN += ["--trainer.callbacks.enable_version_counter=false"]


def small(configuration: str, *options: str) -> int:
    return main(["fit", "--config", str(CONF / configuration), *SMALL, *options])


@pytest.mark.parametrize(
    ("configuration", "options"),
    [
        ("object_rearrangement.yaml", [DENOISER]),
        ("object_rearrangement.yaml", [DENOISER, "--trainer.check_val_every_n_epoch=2"]),
        ("object_rearrangement.yaml", [DENOISER, "--trainer.val_check_interval=2"]),
        ("object_rearrangement.yaml", [DENOISER, "--trainer.limit_val_batches=0"]),
        ("cvae/object_rearrangement.yaml", ["--model.hidden_dim=32"]),
        ("bc/object_rearrangement.yaml", ["--model.hidden_dim=32"]),
    ],
)
def test_from_any_checkpoint_it_goes_on_to_the_same_bytes(configuration: str, options: list[str]) -> None:
    assert small(configuration, *options, *OFTEN, "--model.output=unbroken") == 0
    (folder,) = Path("logs").glob("*/fit/checkpoints")
    for step in (3, 6, 8):  # the last ends an epoch
        again = [f"--model.output=again{step}", f"--ckpt_path={folder / f'often-step={step}.ckpt'}"]
        assert small(configuration, *options, *again) == 0
        found = (Path(f"again{step}") / "model.safetensors").read_bytes()
        assert found == Path("unbroken/model.safetensors").read_bytes(), step


CHECKPOINTS = Path("logs/object_rearrangement/fit/checkpoints")


def mistake(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run, expect exit code 2 and one line, and return it."""
    capsys.readouterr()
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    return told


def test_a_damaged_last_checkpoint_is_told_with_the_newest_whole_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert small("object_rearrangement.yaml", DENOISER, *OFTEN) == 0
    fit = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *SMALL, DENOISER]
    last = CHECKPOINTS / "last.ckpt"
    whole = last.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    (CHECKPOINTS / ".often-step=11.ckpt.rest.ckpt").write_bytes(whole)  # what a kill leaves is none
    os.utime(CHECKPOINTS / "often-step=9.ckpt", (2**31, 2**31))
    os.utime(CHECKPOINTS / "often-step=10.ckpt", (2**31 + 1, 2**31 + 1))
    (CHECKPOINTS / "often-step=10.ckpt").write_bytes(whole[:100])
    os.utime(CHECKPOINTS / "often-step=10.ckpt", (2**31 + 1, 2**31 + 1))
    for content in (b"", whole[: len(whole) // 2], bytes(flipped)):
        last.write_bytes(content)
        for name in ("last", str(last)):
            told = mistake(capsys, *fit, f"--ckpt_path={name}")
            assert f"{last}: expected a checkpoint, found a damaged or foreign file; go on from" in told
            assert told.endswith(f"{CHECKPOINTS / 'often-step=9.ckpt'}\n")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"state_dict": None}, "key 'state_dict': expected a checkpoint's dict"),
        ({"state_dict": [1]}, "key 'state_dict': expected a checkpoint's dict"),
        ({"state_dict": {"a": 1}}, "key 'state_dict': expected tensors by name"),
        ({"state_dict": {}}, "key 'state_dict', "),
        ({"global_step": "many"}, "key 'global_step': expected a checkpoint's int"),
        ({"loops": {}}, "cannot be restored"),
        ({"loops": {"fit_loop": {}}}, "key 'loops': expected step 4, found 0"),
        ({"loops": []}, "key 'loops'"),
        ({"optimizer_states": []}, "key 'optimizer_states': expected the state of an optimiser, found none"),
        ({"optimizer_states": [{}]}, "cannot be restored"),
        ({"lr_schedulers": [3]}, "cannot be restored"),
        ({"callbacks": [3]}, "key 'callbacks'"),
        ({"belongs_to": "me"}, "key 'belongs_to'"),
        ({"belongs_to": {}}, "key 'module_class'"),
        ({"random": {"cpu": torch.zeros(3)}}, "key 'random'"),
        ({"random": {"cpu": torch.zeros(3, dtype=torch.uint8), "cuda": None, "iterations": 0}}, "key 'random'"),
        ("shape", "expected shape"),
        ("moment", "key 'optimizer_states', 'exp_avg': expected shape"),
        ("nan", "expected finite numbers"),
        ("list", "expected a checkpoint, found a list"),
    ],
    ids=str,
)
def test_a_checkpoint_of_another_form_is_one_line(
    one_checkpoint: Path, change: str | dict[str, object], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(one_checkpoint, weights_only=True)
    weight = next(name for name, value in content["state_dict"].items() if value.dim() == 2)
    if isinstance(change, dict):
        content = {key: value for key, value in (content | change).items() if value is not None}
    elif change == "shape":
        content["state_dict"][weight] = torch.zeros(1, 2)
    elif change == "nan":
        content["state_dict"][weight][0, 0] = torch.nan
    elif change == "moment":
        content["optimizer_states"][0]["state"][0]["exp_avg"] = torch.zeros(7, 7)
    else:
        content = [content]
    torch.save(content, "changed.ckpt")
    fit = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *SMALL, DENOISER]
    assert expected in mistake(capsys, *fit, "--ckpt_path=changed.ckpt")
    assert not list(Path().rglob("pretrained"))


@pytest.fixture(scope="module")
def one_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a small model."""
    folder = tmp_path_factory.mktemp("checkpoint")
    options = [f"--trainer.logger.init_args.save_dir={folder}", f"--model.output={folder / 'model'}", "--trainer.max_steps=4"]
    assert small("object_rearrangement.yaml", DENOISER, *options) == 0
    return folder / "object_rearrangement" / "fit" / "checkpoints" / "last.ckpt"


def test_checkpoints_are_written_beside_their_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder for temporary files on another file system, or none at all, changes nothing."""
    from ftl_lightning.learning.checkpoint import WholeCheckpoints, read_checkpoint

    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    content = {"state_dict": {"a": torch.ones(2)}, "epoch": 0, "global_step": 1, "loops": {}}
    WholeCheckpoints().save_checkpoint(content, "some.ckpt")
    assert read_checkpoint("some.ckpt")["global_step"] == 1

    def stop(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", stop)
    with pytest.raises(UserError, match=r"some.ckpt: cannot be written \(No space left on device\)"):
        WholeCheckpoints().save_checkpoint(content | {"global_step": 2}, "some.ckpt")
    assert read_checkpoint("some.ckpt")["global_step"] == 1
    assert [path.name for path in Path().iterdir()] == ["some.ckpt"]


def test_our_trainer_writes_checkpoints_so() -> None:
    from ftl_lightning.learning.checkpoint import WholeCheckpoints
    from ftl_lightning.trainer import Trainer

    assert isinstance(Trainer(logger=False, accelerator="cpu").strategy.checkpoint_io, WholeCheckpoints)


@pytest.mark.parametrize("verb", ["test", "validate"])
def test_there_is_no_last_checkpoint_to_evaluate(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    told = mistake(capsys, verb, "--config", str(CONF / "object_rearrangement.yaml"), *SMALL, DENOISER, "--ckpt_path=last")
    assert f"ckpt_path: {verb} expected a checkpoint file, found none" in told
    assert not list(Path().rglob("*.csv"))


def test_fit_says_that_it_starts_anew(capsys: pytest.CaptureFixture[str]) -> None:
    assert small("object_rearrangement.yaml", DENOISER, "--ckpt_path=last") == 0
    assert "ckpt_path: no last checkpoint in logs/object_rearrangement/fit; fit starts anew\n" in capsys.readouterr().out


# Parameters that are not finite


def test_a_gradient_that_is_not_finite_costs_no_checkpoint(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = PretrainingModule.on_after_backward

    def spoil(self: PretrainingModule) -> None:
        step(self)
        if self.global_step == 6:
            next(self.raw.parameters()).grad.fill_(torch.nan)  # type: ignore[union-attr]

    monkeypatch.setattr(PretrainingModule, "on_after_backward", spoil)
    fit = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *SMALL, DENOISER, *OFTEN]
    assert "training: step 7: expected finite numbers, found others in" in mistake(capsys, *fit)
    last = torch.load(CHECKPOINTS / "last.ckpt", weights_only=True)
    assert last["global_step"] == 6
    assert all(value.isfinite().all() for value in last["state_dict"].values())
    assert not list(Path().rglob("pretrained"))


def test_a_model_that_is_not_finite_is_not_exported(capsys: pytest.CaptureFixture[str]) -> None:
    fit = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *SMALL, DENOISER, "--trainer.max_steps=1"]
    told = mistake(capsys, *fit, "--model.learning_rate=1e6", "--model.warmup_steps=1", "--model.ema_decay=0")
    assert "expected finite numbers" in told
    assert not list(Path().rglob("model.safetensors"))
