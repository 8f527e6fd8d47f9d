"""A copy of this checkout, in which what is built leaves nothing behind."""

import shutil
from pathlib import Path

from tests.conftest import ROOT

LEFT_OUT = (".*", "__pycache__", "*.egg-info", "build", "logs", "lightning_logs", "_build")
"""What a fresh checkout has not, and the folders whose names begin with a dot."""


def copied(folder: Path) -> Path:
    """Copy the checkout to a folder that is not there yet; links stay links."""
    return Path(shutil.copytree(ROOT, folder, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT)))
