import os
from pathlib import Path

import pytest

from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import atomic, write_text


def test_nothing_half_written_is_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def interrupted() -> None:
        with atomic(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.txt"]


def test_a_full_disk_is_a_clear_error() -> None:
    if not Path("/dev/full").is_char_device():  # whoever wrote to it as root may have put a file there
        pytest.skip("needs the device /dev/full, which this system lacks")
    with pytest.raises(UserError, match="No space left on device"), atomic("file.txt"):
        Path("/dev/full").write_text("x")


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    for name, found in (("pipe", "a device"), ("folder", "a folder"), ("link", "a device"), ("null", "a device")):
        with pytest.raises(UserError, match=f"{name}: expected a file or nothing there, found {found}"):
            write_text(tmp_path / name, "x")
    assert (tmp_path / "pipe").is_fifo()
    assert Path("/dev/null").is_char_device()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "link", "null", "pipe"]


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to("elsewhere/file")
    for text in ("made", "replaced"):
        write_text(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "elsewhere" / "file").read_text() == text
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["file"]
