"""What names of demonstrations stand for."""

from pathlib import Path

import pytest

from ftl_lightning.services.files import read_from, written_to


def test_a_name_is_a_file_unless_it_says_or_is_something_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot-v1/meta").mkdir(parents=True)
    Path("robot-v1/meta/info.json").touch()
    Path("folder-v1").mkdir()
    Path("file-v1").touch()
    names = {
        "robot-v1": ("lerobot", "robot-v1"),
        "lerobot:any": ("lerobot", "any"),
        "strokes/five-v0": ("minari", "strokes/five-v0"),
        "minari:folder-v1": ("minari", "folder-v1"),
        "folder-v1": ("folder", "folder-v1"),
        "file-v1": ("file", "file-v1"),
        "x-v1.npz": ("file", "x-v1.npz"),
        "a:b.npz": ("file", "a:b.npz"),
        "nothing": ("file", "nothing"),
        "x" * 5000: ("file", "x" * 5000),
        "\0": ("file", "\0"),
    }
    assert {name: read_from(name) for name in names} == names
    assert written_to("robot-v1") == ("file", "robot-v1")
    assert written_to("lerobot:a:b") == ("lerobot", "a:b")
