"""Expert episodes shipped with the package."""

from pathlib import Path

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.driving.tasks import TRAINING_CONCEPTS
from ftl_lightning.services.errors import UserError

SHIPPED = Path(__file__).parent / "demonstrations"
"""Folder with a file of expert episodes per training scenario; see its data card."""
HELD_OUT = 10
"""Number of validation episodes per scenario, the last of its file."""


def training_set(name: Split, count: int, folder: Path | None = None) -> Demonstrations:
    """The first ``count`` shipped episodes per training scenario; for ``'validation'``, held-out episodes.

    They are the same for every seed, as generation takes half an hour.

    Args:
        name: name of the split.
        count: number per scenario.
        folder: folder of other episodes, a file per scenario as written by ``generate``.

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
