"""A file of demonstrations some of whose numbers are missing, read to say which."""

from pathlib import Path

import torch

from ftl_lightning.demonstrations.check import mended
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.file_format import read
from ftl_lightning.demonstrations.finding import Finding
from ftl_lightning.errors import about


def read_mended(path: str) -> tuple[Demonstrations, tuple[Finding, ...]]:
    """Demonstrations of a file, those without a text named after it, with states that are not finite mended.

    Args:
        path: ``.npz``, safetensors, or a data set.

    Returns:
        Demonstrations, and where states were not finite.

    Raises:
        UserError: naming the file, for every other mistake in it.
    """
    contents = read(path)
    found: tuple[Finding, ...] = ()
    states, lengths = contents["states"], contents["lengths"]
    if states.dim() == 3 and states.dtype == torch.float32 and lengths.shape == states.shape[:1]:
        contents["states"], found = mended(states, lengths)
    with about(path):
        return Demonstrations(**contents).named(Path(path).stem), found
