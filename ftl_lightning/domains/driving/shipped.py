"""The expert's episodes that ship with the package."""

from pathlib import Path

from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.driving.tasks import TRAINING_CONCEPTS
from ftl_lightning.errors import UserError

SHIPPED = Path(__file__).parent / "demonstrations"
"""The expert's episodes of the training scenarios, a file each; see the data card beside them."""
HELD_OUT = 10
"""So many of the shipped episodes of each scenario, its last, are for validation."""


def training_set(name: Split, count: int, folder: Path | None = None) -> Demonstrations:
    """The first ``count`` shipped episodes of each training scenario; of ``'validation'``, of those that are held out.

    The expert takes half an hour for them, so they are the same for every seed.

    Args:
        name: of the split.
        count: of each scenario.
        folder: of others, a file for each scenario as ``generate`` writes them.

    Raises:
        UserError: if there are fewer, or no file.
    """
    parts = []
    for scenario in TRAINING_CONCEPTS:
        shipped = Demonstrations.load((folder or SHIPPED) / f"{scenario}.safetensors")
        rows = list(range(len(shipped)))
        pool = rows[-HELD_OUT:] if name == "validation" else rows[:-HELD_OUT]
        if count > len(pool):
            key = "samples_per_concept" if name == "train" else "validation_per_concept"
            raise UserError(f"data.{key}: expected at most {len(pool)} episodes of {scenario!r}, found {count}")
        parts.append(shipped.rows(pool[:count]))
    return concatenate(parts)
