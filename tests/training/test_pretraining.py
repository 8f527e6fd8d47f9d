"""Pretraining: what is drawn, what a fit writes, and how it goes on from a checkpoint or refuses one."""

import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.cli.main import main
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.methods.ftl_igm.pretraining import LossOptions, PretrainingModule
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.checkpoint import WholeCheckpoints, read_checkpoint
from ftl_lightning.training.data import PretrainingData
from ftl_lightning.training.model_folder import read_model, save_model
from ftl_lightning.training.trainer import Trainer
from tests import tiny as sizes
from tests.conftest import refused, succeed

FIT = sizes.fit(Path("object_rearrangement.yaml"), "--data.batch_size=8", "--data.steps_per_epoch=8")
FIT += ["--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0"]
CHECKPOINTS = Path("logs/object_rearrangement/fit/checkpoints")


def fit(
    *callbacks: pl.Callback, steps: int = 4, ckpt_path: str | Path | None = None, data: dict[str, int] | None = None, **options: Any
) -> PretrainingModule:
    """A fit without a command line, whose model is written to ``pretrained``."""
    few = {"samples_per_concept": 4, "validation_per_concept": 1, "batch_size": 8, "steps_per_epoch": 4} | (data or {})
    network = {"hidden_dim": 16, "depth": 1, "condition_dim": 8, "dropout": 0.1}
    module = PretrainingModule(denoiser_args=network, output="pretrained", **options)
    quiet: dict[str, Any] = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "limit_val_batches": 0}
    keeps = any(isinstance(one, ModelCheckpoint) for one in callbacks)
    trainer = Trainer(max_steps=steps, accelerator="cpu", callbacks=[*callbacks], enable_checkpointing=keeps, **quiet)
    trainer.fit(module, datamodule=PretrainingData("object_rearrangement", **few), ckpt_path=ckpt_path, weights_only=True)
    return module


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of such a fit after four steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("checkpoint"))
        fit(ModelCheckpoint(dirpath=".", save_last=True))
        return Path("last.ckpt").absolute()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    hashes = []
    for seed in (1, 1, 2):
        pl.seed_everything(seed)  # as the command line does
        fit(seed=seed)
        hashes.append(read_model(GenerativeModel, "pretrained").hash)
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.slow
def test_several_threads_give_the_same_bytes_too() -> None:
    wide = ["--data.batch_size=512", "--model.denoiser_args={hidden_dim: 256, depth: 2, condition_dim: 32}"]
    torch.set_num_threads(2)
    for name in ("one", "two", "three"):
        succeed(*FIT, *wide, "--trainer.max_steps=6", f"--model.output={name}")
    assert len({read_model(GenerativeModel, name).hash for name in ("one", "two", "three")}) == 1


def test_training_lowers_the_loss(tiny: Path) -> None:
    events = EventAccumulator(str(tiny.parent)).Reload()
    losses = [event.value for event in events.Scalars("loss/val")]
    assert len(losses) == 2
    assert losses[-1] < losses[0] < 1.0


def killed(arguments: list[str]) -> None:
    """A fit that is killed in its thirteenth step; called in a process of its own."""
    step = PretrainingModule.training_step

    def last(self: PretrainingModule, batch: Any) -> torch.Tensor:
        if self.global_step == 12:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, batch)

    PretrainingModule.training_step = last  # type: ignore[method-assign]
    main(arguments)


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_to_the_same_result() -> None:
    options = [*FIT, "--trainer.max_steps=18"]
    often = [f"--trainer.callbacks.{name}" for name in ("save_last=true", "every_n_train_steps=5", "filename=often")]
    often = ["--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint", *often]
    succeed(*options, "--model.output=unbroken", "--trainer.logger.init_args.version=unbroken")
    run = multiprocessing.get_context("fork").Process(target=killed, args=([*options, *often, "--model.output=again"],))
    run.start()
    run.join()
    assert run.exitcode == -signal.SIGKILL
    assert torch.load(CHECKPOINTS / "last.ckpt", weights_only=True)["global_step"] == 10
    assert not Path("again").exists()
    succeed(*options, "--ckpt_path=last", "--model.output=again")
    assert Path("again/model.safetensors").read_bytes() == Path("unbroken/model.safetensors").read_bytes()


class Seen(pl.Callback):
    """Timesteps and rows of the concepts that the network is given in the first step of a fit."""

    def on_train_start(self, trainer: pl.Trainer, module: PretrainingModule) -> None:  # type: ignore[override]
        def spy(_: torch.nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
            self.timesteps, self.rows = inputs[1].clone(), inputs[3].clone()

        module.raw.denoiser.register_forward_pre_hook(spy)


def first_step(batch_size: int, loss: LossOptions) -> Seen:
    fit(seen := Seen(), steps=1, data={"batch_size": batch_size, "steps_per_epoch": 1}, loss=loss)
    return seen


def test_condition_dropout_is_drawn_per_sample() -> None:
    rows = first_step(400, LossOptions(condition_dropout=0.5)).rows
    assert 140 < (rows == 0).sum() < 260  # neither none nor all, as once a batch would give


@pytest.mark.parametrize(("power", "noisiest"), [(1.0, 0.10), (3.0, 0.46), (10.0, 0.79)])
def test_a_power_draws_noisy_timesteps(power: float, noisiest: float) -> None:
    timesteps = first_step(2000, LossOptions(timestep_power=power)).timesteps
    assert timesteps.min() >= 0
    assert timesteps.max() == 99
    assert (timesteps >= 90).float().mean().item() == pytest.approx(noisiest, abs=0.05)


def test_a_task_of_texts_is_composed_with_the_guidance_weight_and_against_others(tiny: Path) -> None:
    module = PretrainingModule(guidance=1.5)
    module.model = read_model(GenerativeModel, tiny)
    one, other = module.model.config.training_concepts[:2]
    found = module.composition(EvaluationTask("s", "g", texts=(one,), without=(other,)))
    assert found.weights.tolist() == [1.5, WITHOUT_WEIGHT]
    assert torch.equal(found.embeddings, torch.stack([module.model.concept(one), module.model.concept(other)])[:, None])
    assert module.composition(EvaluationTask("s", "g", learned=("new",), texts=(one,))) is None


def test_the_model_folder_round_trips_and_refuses_mixtures(tiny: Path) -> None:
    model = read_model(GenerativeModel, tiny)
    assert not any(parameter.requires_grad for parameter in model.parameters())
    save_model(model, "copy")
    assert read_model(GenerativeModel, "copy").hash == model.hash
    config = Path("copy/config.json")
    for content, expected in (
        (config.read_text().replace(model.hash, "0" * 16), "copy/model.safetensors: expected the hash 0000000000000000"),
        ("{}", "config.json: expected the configuration of a pretrained model"),
    ):
        config.write_text(content)
        with pytest.raises(UserError, match=expected):
            read_model(GenerativeModel, "copy")


# Checkpoints


def test_a_damaged_last_checkpoint_is_told_with_the_newest_whole_one(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    CHECKPOINTS.mkdir(parents=True)
    last, older, newer = (CHECKPOINTS / f"{name}.ckpt" for name in ("last", "often-step=9", "often-step=10"))
    whole = checkpoint.read_bytes()
    for path, content in ((older, whole), (newer, whole[:100]), (CHECKPOINTS / ".often-step=11.ckpt.rest.ckpt", whole)):
        path.write_bytes(content)  # the last is what a kill leaves, and is none
    for seconds, path in enumerate((older, newer), 2**31):
        os.utime(path, (seconds, seconds))
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    expected = (
        f"{last}: expected a checkpoint, found a damaged or foreign file; go on from the newest whole one: --ckpt_path {older}"
    )
    for content in (b"", whole[: len(whole) // 2], bytes(flipped)):
        last.write_bytes(content)
        with pytest.raises(UserError) as told:
            read_checkpoint(last)
        assert str(told.value) == expected
    for name in ("last", str(last)):
        assert main([*FIT, f"--ckpt_path={name}"]) == 2
        error = capsys.readouterr().err
        assert expected.rpartition(" ")[0] in error
        assert error.endswith(f"{older}\n")


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
def test_a_checkpoint_of_another_form_is_one_line(checkpoint: Path, change: str | dict[str, object], expected: str) -> None:
    content = torch.load(checkpoint, weights_only=True)
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
    with pytest.raises(UserError) as told:
        fit(steps=9, ckpt_path="changed.ckpt")
    assert expected in str(told.value)
    assert "\n" not in str(told.value)
    assert not Path("pretrained").exists()


def test_checkpoints_are_written_beside_their_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder for temporary files on another file system, or none at all, changes nothing."""
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    content = {"state_dict": {"a": torch.ones(2)}, "epoch": 0, "global_step": 1, "loops": {}}
    files = Trainer(logger=False, accelerator="cpu").strategy.checkpoint_io
    assert isinstance(files, WholeCheckpoints)
    files.save_checkpoint(content, "some.ckpt")
    assert read_checkpoint("some.ckpt")["global_step"] == 1

    def stop(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", stop)
    with pytest.raises(UserError, match=r"some.ckpt: cannot be written \(No space left on device\)"):
        files.save_checkpoint(content | {"global_step": 2}, "some.ckpt")
    assert read_checkpoint("some.ckpt")["global_step"] == 1
    assert [path.name for path in Path().iterdir()] == ["some.ckpt"]


def test_without_a_last_checkpoint_none_is_evaluated_and_fit_says_that_it_starts_anew(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("test", "validate"):
        refused(capsys, [verb, *FIT[1:], "--ckpt_path=last"], f"ckpt_path: {verb} expected a checkpoint file, found none")
    succeed(*FIT, "--trainer.max_steps=1", "--trainer.limit_val_batches=0", "--ckpt_path=last")
    assert (
        "ckpt_path: no last checkpoint in logs/object_rearrangement/fit; fit starts from the beginning\n" in capsys.readouterr().out
    )


# Numbers that are not finite


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_checkpoint(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--trainer.max_steps=60", "--model.learning_rate=1e30", "--model.warmup_steps=1", "--data.steps_per_epoch=1"]
    assert main([*FIT, *options]) == 2
    assert "training: the loss became" in capsys.readouterr().err
    assert not list(Path().rglob("pretrained"))


def test_a_gradient_that_is_not_finite_costs_no_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    step = PretrainingModule.on_after_backward

    def spoil(self: PretrainingModule) -> None:
        step(self)
        if self.global_step == 6:
            next(self.raw.parameters()).grad.fill_(torch.nan)  # type: ignore[union-attr]

    monkeypatch.setattr(PretrainingModule, "on_after_backward", spoil)
    often = ModelCheckpoint(dirpath=".", every_n_train_steps=1, save_top_k=-1, save_last=True)
    with pytest.raises(UserError, match=r"training: step 7: expected finite numbers, found others in"):
        fit(often, steps=10)
    last = torch.load("last.ckpt", weights_only=True)
    assert last["global_step"] == 6
    assert all(value.isfinite().all() for value in last["state_dict"].values())
    assert not Path("pretrained").exists()


def test_a_model_that_is_not_finite_is_not_exported() -> None:
    with pytest.raises(UserError, match="expected finite numbers"):
        fit(steps=1, learning_rate=1e6, warmup_steps=1, ema_decay=0)
    assert not list(Path().rglob("model.safetensors"))
