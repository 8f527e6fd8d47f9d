"""A run that goes on from a checkpoint ends with the bytes of an unbroken run: every configuration that ships."""

import resource
from pathlib import Path

import pytest
import torch

from ftl_lightning.services.errors import UserError
from ftl_lightning.training.checkpoint import WholeCheckpoints, read_checkpoint
from tests import tiny as sizes
from tests.conftest import succeed

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
