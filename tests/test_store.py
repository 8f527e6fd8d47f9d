"""Models and checkpoints in object stores."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.store import fetched
from tests.conftest import ROOT

SMALL = [
    "fit",
    f"--config={ROOT}/conf/object_rearrangement.yaml",
    "--data.samples_per_concept=2",
    "--data.validation_per_concept=1",
]
SMALL += ["--data.steps_per_epoch=2", "--trainer.limit_val_batches=0", "--trainer.callbacks.init_args.every_n_train_steps=2"]
SMALL += ["--model.denoiser_args={hidden_dim: 32, depth: 2, condition_dim: 16}", "--trainer.enable_progress_bar=false"]


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.chdir(tmp_path)
    files = fsspec.filesystem("memory")
    yield files
    files.rm("/", recursive=True)


@pytest.mark.slow
def test_a_fit_goes_on_from_a_store_and_writes_its_model_there(
    memory: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    remote = [*SMALL, "--trainer.callbacks.init_args.dirpath=memory://runs/a", "--model.output=memory://models/a"]
    assert main([*remote, "--trainer.max_steps=2"]) == 0
    assert {path.rpartition("/")[2] for path in memory.ls("/models/a", detail=False)} == {"model.safetensors", "config.json"}
    assert main([*remote, "--trainer.max_steps=4", "--ckpt_path=last"]) == 0
    assert "starts from the beginning" not in capsys.readouterr().out
    assert main([*remote, "--trainer.max_steps=4", "--ckpt_path=memory://runs/a/none.ckpt"]) == 2
    assert "expected a checkpoint file, found nothing at memory://runs/a/none.ckpt" in capsys.readouterr().err
    assert main([*remote, "--trainer.max_steps=6", "--ckpt_path=memory://runs/a/last.ckpt"]) == 0
    there = FewShot.from_pretrained("memory://models/a")
    assert there.model.config.training["max_steps"] == 6
    assert main([*SMALL, "--trainer.max_steps=2", f"--model.output={tmp_path}/first"]) == 0
    first = FewShot.from_pretrained(tmp_path / "first").model.state_dict()
    assert not all(torch.equal(value, first[name]) for name, value in there.model.state_dict().items())
    assert not list(tmp_path.glob("memory:*"))
    inverts = ["invert", f"--config={ROOT}/conf/object_rearrangement.yaml", "--model.pretrained=memory://models/a"]
    assert main([*inverts, "--model.output=memory://concepts"]) == 2
    assert "model.output: expected a folder on this machine, found" in capsys.readouterr().err


def test_a_url_of_the_local_file_system_is_a_store_too(tmp_path: Path) -> None:
    for content in ("{}", "{1: 2}"):
        (tmp_path / "config.json").write_text(content)
        assert (fetched(f"file://{tmp_path}", ["none", "config.json"]) / "config.json").read_text() == content


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("memory://nothing/here", "expected a pretrained model, found nothing"),
        ("nonsense://bucket/model", "nonsense://bucket/model: expected a place in a store that can be reached, found ValueError"),
    ],
)
def test_a_store_without_a_model_is_one_line(url: str, message: str) -> None:
    with pytest.raises(UserError) as error:
        FewShot.from_pretrained(url)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
