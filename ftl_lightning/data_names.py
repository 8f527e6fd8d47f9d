"""What a name of demonstrations stands for: a file, a Minari data set, or a folder that is a LeRobot data set."""

import re
from pathlib import Path
from typing import Literal

Kind = Literal["file", "minari", "lerobot"]
MINARI = re.compile(r"[\w./-]+-v\d+")
"""How Minari names a data set."""
INFO = Path("meta") / "info.json"
"""What a folder has that is a LeRobot data set."""
FILES = (".npz", ".safetensors")
"""How files of demonstrations end."""


def read_from(name: str) -> tuple[Kind, str]:
    """What is read under a name, and where it is.

    Args:
        name: ``'minari:NAME'``, ``'lerobot:FOLDER'``, a folder with :data:`INFO`, the name of a Minari data set where no file has
            it, or a file.

    Returns:
        Its kind, and the name of the data set, the folder or the file.
    """
    kind, rest = written_to(name)
    if kind != "file" or Path(name).suffix in FILES:
        return kind, rest
    try:
        if (Path(name) / INFO).is_file():
            return "lerobot", name
        found = Path(name).exists()
    except (OSError, ValueError):  # no name that a file system takes: told where it is opened
        return "file", name
    return ("minari" if MINARI.fullmatch(name) and not found else "file"), name


def written_to(name: str) -> tuple[Kind, str]:
    """The same of a name that is written to, where a prefix alone decides: ``'minari:NAME'``, ``'lerobot:FOLDER'``, or a file."""
    kind, colon, rest = name.partition(":")
    if colon and kind == "minari":
        return "minari", rest
    if colon and kind == "lerobot":
        return "lerobot", rest
    return "file", name
