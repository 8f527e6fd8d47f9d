"""A run that goes on from a checkpoint ends with the bytes of an unbroken run: every configuration that ships."""

import resource
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.training.checkpoint import WholeCheckpoints, apply_rates, read_checkpoint
from tests import tiny as sizes
from tests.conftest import CONF, succeed

RUN = ["--data.batch_size=8", "--data.steps_per_epoch=3", "--trainer.max_steps=7"]
RUN += ["--evaluation.samples=1", "--evaluation.figures=0"]
OFTEN = ["--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint"]
OFTEN += ["--trainer.callbacks.save_top_k=-1", "--trainer.callbacks.filename=often-{step}"]
OFTEN += ["--trainer.callbacks.enable_version_counter=false"]
OURS, BC, CVAE = (Path(f"{method}object_rearrangement.yaml") for method in ("", "bc/", "cvae/"))
VALIDATED, UNSEEN = "--trainer.check_val_every_n_epoch=1", "--trainer.limit_val_batches=0"
SLOW = [(path, UNSEEN) for path in sizes.CONFIGURATIONS if path != OURS]
SLOW += [(BC, "--model.members=2"), (CVAE, VALIDATED), (OURS, VALIDATED)]
SLOW += [(OURS, "--trainer.check_val_every_n_epoch=2"), (OURS, "--trainer.val_check_interval=2")]


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("path", "option"), [(OURS, UNSEEN), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)], ids=str
)
def test_every_shipped_configuration_goes_on_to_the_same_bytes(path: Path, option: str) -> None:
    # Within an epoch, at its end, within another.
    steps, every = ((2, 3, 5), 1) if path == OURS and option != UNSEEN else ((5,), 5)
    fit = [*sizes.fit(path, *RUN, option)]
    succeed(*fit, *OFTEN, f"--trainer.callbacks.every_n_train_steps={every}", "--model.output=unbroken")
    (checkpoints,) = Path("logs").glob("*/fit/checkpoints")
    for step in steps:
        succeed(*fit, f"--model.output=again{step}", f"--ckpt_path={checkpoints / f'often-step={step}.ckpt'}")
        found = Path(f"again{step}/model.safetensors").read_bytes()
        assert found == Path("unbroken/model.safetensors").read_bytes(), step


OWN = ["--trainer.limit_val_batches=0", "--trainer.max_steps=4", "--data.batch_size=8", "--evaluation.figures=0"]
FURTHER = ["--trainer.max_steps=8", "--ckpt_path=last"]
Told = pytest.CaptureFixture[str]


@pytest.fixture
def fit() -> list[str]:
    """A run of four steps on data of one's own, which has ended."""
    arguments = sizes.fit(Path("own.yaml"), *OWN)
    succeed(*arguments)
    return arguments


def changed(**changes: object) -> str:
    """A file as that of the run, but for some arrays."""
    with np.load("strokes.npz") as file:
        np.savez("changed.npz", **{**file, **changes})  # type: ignore[arg-type]
    return "--data.demonstrations=changed.npz"


def strokes() -> tuple[np.ndarray, np.ndarray]:
    with np.load("strokes.npz") as file:
        return file["states"], file["concepts"]


def stopped(arguments: list[str], capsys: Told, *expected: str) -> None:
    """One line with these texts, and what the run has written stays, without anything new."""
    capsys.readouterr()
    before = {path: path.read_bytes() for path in Path("logs").rglob("*") if path.is_file()}
    assert main(arguments) == 2
    (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert all(text in error for text in expected), error
    assert len(error) <= LONGEST
    assert before == {path: path.read_bytes() for path in Path("logs").rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data(fit: list[str], capsys: Told) -> None:
    states, texts = strokes()
    others = "ckpt_path: expected the training data of the checkpoint (hash "
    stopped([*fit, *FURTHER, changed(states=3 * states)], capsys, others, "start again without --ckpt_path")
    stopped([*fit, *FURTHER, changed(states=states[::-1])], capsys, others)
    stopped([*fit, *FURTHER, "--data.validation_share=0.6"], capsys, others, "data.validation_share 0.6 (before: 0.1)")
    stopped([*fit, *FURTHER, changed(concepts=np.char.add(texts, " 2"))], capsys, "ckpt_path: key 'training_concepts': expected")
    stopped([*fit, *FURTHER, changed(state_names=["a", "b"])], capsys, "ckpt_path: key 'columns': expected", "'a', 'b'")
    stopped([*fit, *FURTHER, changed(state_units=["ft", "ft"])], capsys, "ckpt_path: key 'units': expected", "'ft', 'ft'")
    assert main([*fit, *FURTHER, changed()]) == 0  # the same content in another file
    assert "ckpt_path" not in capsys.readouterr().err


@pytest.mark.slow
def test_options_that_differ_from_the_checkpoint_are_applied_and_told(fit: list[str], capsys: Told) -> None:
    options = [
        "--model.learning_rate=0.01",
        "--model.weight_decay=0.5",
        "--data.batch_size=16",
        "--model.loss.condition_dropout=0.5",
    ]
    capsys.readouterr()
    succeed(*fit, *FURTHER, *options)
    (note,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ckpt_path")]
    expected = "model.learning_rate 0.01 (before: 0.001), model.weight_decay 0.5 (before: 0.01), "
    expected += "model.loss.condition_dropout 0.5 (before: 0.1), data.batch_size 16 (before: 8)"
    assert sorted(note.removeprefix("note: ckpt_path: from step 4 on, ").split(", ")) == sorted(expected.split(", "))
    checkpoint = read_checkpoint(next(Path("logs").rglob("last.ckpt")))
    (group,) = checkpoint["optimizer_states"][0]["param_groups"]
    assert (group["initial_lr"], group["weight_decay"]) == (0.01, 0.5)
    assert checkpoint["lr_schedulers"][0]["base_lrs"] == [0.01]


def test_a_learning_rate_takes_effect_at_the_step_of_the_checkpoint() -> None:
    group = {"lr": 0.0005, "initial_lr": 0.001, "weight_decay": 0.01}
    schedule = {"base_lrs": [0.001], "_last_lr": [0.0005], "last_epoch": 4}
    apply_rates({"lr_schedulers": [schedule], "optimizer_states": [{"param_groups": [group]}]}, 0.01, 0.5)
    assert group == {"lr": 0.005, "initial_lr": 0.01, "weight_decay": 0.5}
    assert schedule == {"base_lrs": [0.01], "_last_lr": [0.005], "last_epoch": 4}


@pytest.mark.slow
def test_a_run_that_has_ended_says_so(fit: list[str], capsys: Told) -> None:
    before = Path("logs/own/fit/pretrained/model.safetensors").read_bytes()
    capsys.readouterr()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        succeed(*fit, "--ckpt_path=last")
    assert not [str(each.message) for each in caught if "not empty" in str(each.message)]
    assert "note: ckpt_path: the run had ended at step 4, so nothing was learned" in capsys.readouterr().err
    assert Path("logs/own/fit/pretrained/model.safetensors").read_bytes() == before
    succeed(*fit, *FURTHER)
    assert "note: ckpt_path" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_checkpoint_is_evaluated_on_other_data_with_a_note(fit: list[str], capsys: Told) -> None:
    states, _ = strokes()
    path = next(Path("logs").rglob("last.ckpt"))
    succeed("test", *fit[1:], changed(states=3 * states), f"--ckpt_path={path}")
    assert "note: ckpt_path: the checkpoint was trained on other data than these" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_without_a_logger_does_not_write_into_the_current_folder() -> None:
    arguments = [*sizes.fit(Path("own.yaml"), *OWN), "--trainer.logger=false"]
    succeed(*arguments)
    assert {path.name for path in Path().iterdir()} - {"cache"} == {"logs", "strokes.npz"}
    assert Path("logs/fit/pretrained/model.safetensors").is_file()
    succeed(*arguments, *FURTHER)
    invert = ["invert", f"--config={CONF / 'own.yaml'}", "--model.pretrained=logs/fit/pretrained", *sizes.QUIET]
    invert += ["--data.demonstrations=strokes.npz", "--data.steps=1", "--model.form=paper", "--trainer.logger=false"]
    for folder in ("invert", "invert_1"):
        succeed(*invert, "--evaluation.samples=1", "--evaluation.figures=0")
        assert len(list(Path("logs", folder, "concepts").iterdir())) == 8
    assert not Path("concepts").exists()


def test_a_checkpoint_that_is_cut_off_leaves_the_one_before_it(tmp_path: Path) -> None:
    path, files, limits = tmp_path / "last.ckpt", WholeCheckpoints(), resource.getrlimit(resource.RLIMIT_FSIZE)
    content = {"epoch": 0, "global_step": 1, "loops": {}, "state_dict": {"weight": torch.ones(1000)}}
    files.save_checkpoint(content, path)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))  # as a disk with room for so many bytes
        with pytest.raises(UserError, match=r"last.ckpt: cannot be written \(File too large\)"):
            files.save_checkpoint(content | {"global_step": 2}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert read_checkpoint(path)["global_step"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.ckpt"]
