"""A folder of files, which together may be larger than memory."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.data import shards
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.shards import Shards, Stream
from ftl_lightning.domains.from_file import FileSource, read_own
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import OwnData

TIME = 8


def write(folder: Path, files: int = 6, each: int = 4, texts: Sequence[str] = ("left", "right"), columns: int = 2) -> Path:
    """Files whose first column says which file and demonstration a state is of."""
    folder.mkdir(exist_ok=True)
    for number in range(files):
        states = np.random.default_rng(number).standard_normal((each * len(texts), TIME, columns)).cumsum(axis=1)
        states[..., 0] = 100 * number + np.arange(each * len(texts))[:, None] + 0.01 * np.arange(TIME)
        np.savez(folder / f"{number}.npz", states=states, concepts=np.repeat(texts, each))
    return folder


def batches(folder: Path, steps: int, **options: object) -> tuple[OwnData, list[torch.Tensor]]:
    data = OwnData(str(folder), encoder="hashing", check=False, metrics={}, batch_size=16, **options)  # type: ignore[arg-type]
    data.setup("fit")
    return data, [data.batch(step).states for step in range(steps)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write(tmp_path / "many")


def test_windows_come_from_all_training_demonstrations_and_from_no_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "STEPS", 1)
    data, found = batches(folder, 40)
    source = data.domain.source(None)
    assert isinstance(source, FileSource)
    held = {round(value) for value in source.split("validation", 0, 0).states[:, 0, 0].tolist()}
    seen = {round(value) for states in found for value in states[:, 0, 0].tolist()}
    every = {100 * number + row for number in range(6) for row in range(8)}
    assert held
    assert seen == every - held
    right = {number for number in every if number % 100 >= 4}
    batch = data.batch(0)
    assert [round(value) in right for value in batch.states[:, 0, 0].tolist()] == (batch.concepts == 1).tolist()


def test_a_step_has_the_same_windows_in_another_run(folder: Path) -> None:
    steps = 3 * shards.STEPS
    data, found = batches(folder, steps)
    again = OwnData(str(folder), encoder="hashing", check=False, metrics={}, batch_size=16)
    again.setup("fit")
    assert torch.equal(again.batch(steps - 1).states, found[-1])
    files = {round(value / 100) for value in data.batch(steps - 1).states[:, 0, 0].tolist()}
    assert len(files) <= shards.TOGETHER


def test_a_file_of_held_out_demonstrations_is_never_read(tmp_path: Path) -> None:
    folder = tmp_path / "single"
    folder.mkdir()
    for number in range(12):
        states = np.full((1, TIME, 2), 100.0 * number) + np.arange(TIME)[None, :, None] * 0.01
        np.savez(folder / f"{number:02d}.npz", states=states, concepts=("left", "right")[number % 2])
    data, found = batches(folder, 200)
    source = data.domain.source(None)
    assert isinstance(source, FileSource)
    held = {round(value / 100) for value in source.split("validation", 0, 0).states[:, 0, 0].tolist()}
    assert len(held) == 2
    assert {round(value / 100) for states in found for value in states[:, 0, 0].tolist()} <= {*range(12)} - held


def test_few_files_are_all_in_memory(tmp_path: Path) -> None:
    data, found = batches(write(tmp_path / "few", 3), 30)
    assert {round(value / 100) for states in found[:5] for value in states[:, 0, 0].tolist()} == {0, 1, 2}
    assert data._stream is not None
    assert data._stream.at(0) == data._stream.at(29)  # read once


def test_all_files_come_before_one_comes_again(folder: Path) -> None:
    opened = Shards.of(str(folder), read_own)
    stream = Stream(opened, read_own, {}, 0)
    for first in (0, 6):
        assert sorted(stream._file(place) for place in range(first, first + 6)) == [*range(6)]


def test_the_sample_has_the_longest_and_each_concept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "some", 3, 20)
    monkeypatch.setattr(shards, "SAMPLE", 1)
    longest = [np.zeros((TIME, 2))] * 2 + [np.ones((30, 2))]
    Demonstrations.of(longest, ("rare", "rare", "left")).save(folder / "9.npz")
    found = Shards.of(str(folder), read_own)
    assert {text: found.sample.concepts.count(text) >= 2 for text in found.sample.concepts} == dict.fromkeys(
        ("left", "right", "rare"), True
    )
    assert int(found.sample.lengths.max()) == 30
    assert len(found.sample) == len(found.origins) < sum(found.sizes) == 123
    for (number, row), states in zip(found.origins, found.sample.states, strict=True):
        if number < 3:
            assert round(float(states[0, 0])) == 100 * number + row


def test_a_folder_that_does_not_fit_is_refused_by_its_file(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="empty: expected files of demonstrations"):
        Shards.of(str(tmp_path / "empty"), read_own)
    np.savez(folder / "7.npz", states=np.zeros((4, TIME, 3)), concepts="left")
    with pytest.raises(UserError, match=r"7\.npz: key 'state_names': expected those of .*0\.npz"):
        Shards.of(str(folder), read_own)


def test_a_file_that_changes_is_told(folder: Path) -> None:
    data, _ = batches(folder, 1)
    np.savez(folder / "5.npz", states=np.zeros((4, TIME, 2)), concepts="up")
    with pytest.raises(UserError, match=r"5\.npz: expected the concepts that the file had at the start, found also 'up'"):
        data._opened(str(folder / "5.npz"))


FIT = """
import resource, sys
from ftl_lightning.cli.main import main
options = ["--data.encoder", "hashing", "--data.metrics", "{}", "--data.check", "false", "--data.horizon", "16"]
options += ["--trainer.max_steps", "2", "--trainer.logger", "false", "--model.output", "model"]
assert main(["fit", "--config", "conf/own.yaml", "--data.demonstrations", sys.argv[1], *options]) == 0
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_files(tmp_path: Path) -> None:
    def most(files: int) -> int:
        folder = tmp_path / f"{files}"
        folder.mkdir()
        for number in range(files):
            states = np.random.default_rng(number).standard_normal((40, 5_000, 10), dtype=np.float32).cumsum(axis=1)
            np.savez(folder / f"{number}.npz", states=states, concepts=np.repeat(("left", "right"), 20))
        told = subprocess.run([sys.executable, "-c", FIT, str(folder)], check=True, stdout=subprocess.PIPE, cwd=tmp_path).stdout
        return int(told.split()[-1])

    assert most(32) - most(8) < 2**26  # 24 files more have 192 MB
