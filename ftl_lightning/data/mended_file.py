"""Read files of demonstrations with missing numbers."""

from pathlib import Path

import torch

from ftl_lightning.data.check import mended
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.finding import Finding
from ftl_lightning.data.formats.file_format import read
from ftl_lightning.services.errors import about


def read_mended(path: str) -> tuple[Demonstrations, tuple[Finding, ...]]:
    """Read demonstrations with states that are not finite mended; those without a text are named after the file.

    Args:
        path: ``.npz``, safetensors, or a data set.

    Returns:
        Demonstrations, and findings for states that were not finite.

    Raises:
        UserError: naming the file, for every other mistake in it.
    """
    contents = read(path)
    findings: tuple[Finding, ...] = ()
    states, lengths = contents["states"], contents["lengths"]
    if states.dim() == 3 and states.dtype == torch.float32 and lengths.shape == states.shape[:1]:
        contents["states"], findings = mended(states, lengths)
    with about(path):
        return Demonstrations(**contents).named(Path(path).stem), findings
