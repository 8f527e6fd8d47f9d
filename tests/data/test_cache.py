"""The cache of demonstrations that take long to make."""

from pathlib import Path

import pytest
import torch

from ftl_lightning.data.cache import Tell, cached
from ftl_lightning.data.demonstrations import Demonstrations
from tests.data.samples import demonstrations


def test_demonstrations_are_made_once_and_again_where_their_file_is_damaged(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def make(tell: Tell) -> Demonstrations:
        calls.append(1)
        return demonstrations(torch.ones(2, 3, 1))

    first, second = (cached({"domain": "made"}, 2, make) for _ in range(2))
    assert len(calls) == 1
    assert first.hash == second.hash
    (file,) = Path("cache/ftl-lightning").glob("made-*.safetensors")
    file.write_bytes(file.read_bytes()[:-3])
    remove = Path.unlink

    def removed_by_another_process_first(path: Path, missing_ok: bool = False) -> None:
        if path.name == file.name:
            remove(path)
        remove(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", removed_by_another_process_first)
    assert cached({"domain": "made"}, 2, make).hash == first.hash
    assert len(calls) == 2
