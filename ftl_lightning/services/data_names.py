"""Names of demonstrations: a file, a Minari data set, or a folder that is a LeRobot data set."""

import re
from pathlib import Path
from typing import Literal

Kind = Literal["file", "minari", "lerobot"]
MINARI = re.compile(r"[\w./-]+-v\d+")
"""Pattern of names of Minari data sets."""
INFO = Path("meta") / "info.json"
"""File that marks a folder as a LeRobot data set."""
FILES = (".npz", ".safetensors")
"""Suffixes of files of demonstrations."""


def read_from(name: str) -> tuple[Kind, str]:
    """Resolve a name to read from.

    Args:
        name: ``'minari:NAME'``, ``'lerobot:FOLDER'``, a folder with :data:`INFO`, the name of a Minari data set unless a file has
            it, or a file.

    Returns:
        Kind, and the name of the data set, the folder or the file.
    """
    kind, rest = written_to(name)
    if kind != "file" or Path(name).suffix in FILES:
        return kind, rest
    try:
        if (Path(name) / INFO).is_file():
            return "lerobot", name
        exists = Path(name).exists()
    except (OSError, ValueError):  # an invalid path, reported when it is opened
        return "file", name
    return ("minari" if MINARI.fullmatch(name) and not exists else "file"), name


def written_to(name: str) -> tuple[Kind, str]:
    """Resolve a name to write to by its prefix alone: ``'minari:NAME'``, ``'lerobot:FOLDER'``, or a file."""
    kind, colon, rest = name.partition(":")
    if colon and kind == "minari":
        return "minari", rest
    if colon and kind == "lerobot":
        return "lerobot", rest
    return "file", name
