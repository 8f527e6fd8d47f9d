"""Every configuration that ships goes on from a checkpoint to the bytes of an unbroken run."""

import resource
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.cli import main
from ftl_lightning.domains.mocap.tasks import TRAINING_CONCEPTS
from ftl_lightning.errors import UserError
from ftl_lightning.learning.checkpoint import WholeCheckpoints, read_checkpoint
from ftl_lightning.testing.strokes import TRAINING, strokes
from tests.conftest import CONF
from tests.domains.mocap_samples import folder

OURS = ("agent", "driving", "mocap", "object_rearrangement", "own", "tabletop", "tabletop_wide")
FITS = [Path(f"{domain}.yaml") for domain in OURS] + sorted(
    path.relative_to(CONF) for method in ("bc", "cvae", "in_context") for path in (CONF / method).glob("*.yaml")
)
FEW = ["--data.samples_per_concept=2", "--data.validation_per_concept=1"]
DATA = {
    "object_rearrangement": ["--data.samples_per_concept=4", "--data.validation_per_concept=1"],
    "agent": FEW,
    "driving": FEW,
    "mocap": [],
    "own": [],
    "tabletop": ["--data.samples_per_concept=1", "--data.validation_per_concept=1", "--data.recoveries=1"],
    "tabletop_wide": ["--data.samples_per_concept=1", "--data.validation_per_concept=1", "--data.recoveries=1"],
}
NETWORK = {
    "agent": [
        "--model.denoiser_args={width: 8, multipliers: [1, 2], initial_encoder: entities, film: true, broadcast: true, clock: 8}"
    ],
    "driving": [
        "--model.denoiser_args={hidden_dim: 16, depth: 2, condition_dim: 16, initial_encoder: set, initial_dim: 16, dropout: 0.1}"
    ],
    "mocap": [
        "--model.denoiser_args={width: 8, multipliers: [1, 2], film: true, broadcast: true, clock: 8, skip: true, smooth: 2}"
    ],
    "object_rearrangement": ["--model.denoiser_args={hidden_dim: 16, depth: 2, condition_dim: 16, dropout: 0.1}"],
    "own": ["--model.denoiser_args={hidden_dim: 16, depth: 2, condition_dim: 16, dropout: 0.1}"],
    "tabletop": ["--model.denoiser_args={hidden_dim: 16, depth: 2, condition_dim: 16, initial_dim: 16}"],
    "tabletop_wide": ["--model.denoiser_args={hidden_dim: 16, depth: 2, condition_dim: 16, initial_dim: 16}"],
    "bc": ["--model.hidden_dim=16"],
    "cvae": ["--model.hidden_dim=16", "--model.latent_dim=4"],
    "in_context": ["--model.width=16", "--model.layers=1", "--model.heads=2"],
}
"""Sizes alone; everything else is as it ships, and dropout on top of it where the network has some."""
RUN = ["--data.batch_size=8", "--data.steps_per_epoch=3", "--trainer.max_steps=7", "--trainer.limit_val_batches=0"]
RUN += ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
OFTEN = ["--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint", "--trainer.callbacks.every_n_train_steps=1"]
OFTEN += ["--trainer.callbacks.save_top_k=-1", "--trainer.callbacks.filename=often-{step}"]
OFTEN += ["--trainer.callbacks.enable_version_counter=false"]


@pytest.mark.parametrize("path", FITS, ids=str)
def test_every_shipped_configuration_goes_on_to_the_same_bytes(path: Path, tmp_path: Path) -> None:
    domain, method = path.stem, path.parent.name or path.stem
    options = [*RUN, *DATA[domain], *NETWORK[method]]
    if domain == "mocap":
        options += [f"--data.root={folder(tmp_path / 'recordings', TRAINING_CONCEPTS)}"]
    if domain == "own":
        states = np.concatenate([strokes(kind, 4, 0) for kind in TRAINING])
        np.savez("strokes.npz", states=states, concepts=np.repeat(TRAINING, 4))
        options += ["--data.demonstrations=strokes.npz"]
    if path == Path("bc/object_rearrangement.yaml"):
        options += ["--model.members=2"]
    fit = ["fit", "--config", str(CONF / path), *options]
    assert main([*fit, *OFTEN, "--model.output=unbroken"]) == 0
    (checkpoints,) = Path("logs").glob("*/fit/checkpoints")
    for step in (2, 3, 5):  # the second ends an epoch
        assert main([*fit, f"--model.output=again{step}", f"--ckpt_path={checkpoints / f'often-step={step}.ckpt'}"]) == 0
        found = (Path(f"again{step}") / "model.safetensors").read_bytes()
        assert found == Path("unbroken/model.safetensors").read_bytes(), step


@pytest.mark.parametrize(
    "options", [[], ["--model.adapter.rank=2", "--model.budget.tolerance=null"], ["--model.modes.sets=each"]], ids=str
)
def test_learning_that_is_interrupted_goes_on_to_the_same_bytes(options: list[str], tiny: Path) -> None:
    invert = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), f"--model.pretrained={tiny}", *options]
    invert += ["--data.suite=validation", "--data.steps=7", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
    invert += ["--evaluation.suites=[validation]", "--evaluation.samples=2", "--evaluation.figures=0"]
    often = ["--trainer.callbacks.init_args.train_time_interval=null", "--trainer.callbacks.init_args.every_n_train_steps=3"]
    assert main([*invert, *often, "--model.output=unbroken"]) == 0
    assert main([*invert, "--ckpt_path=last", "--model.output=again"]) == 0  # from step 6 of 7
    names = sorted(path.name for path in Path("unbroken").iterdir())
    assert names
    for name in names:
        assert (Path("again") / name).read_bytes() == (Path("unbroken") / name).read_bytes()


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
