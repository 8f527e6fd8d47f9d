"""Summary of a concept's file without its tensors, for lists of many concepts."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from ftl_lightning.igm.concept import ADAPTER, KIND, MODES, VERSION, Origin, QualityRecord
from ftl_lightning.services.errors import UserError, about
from ftl_lightning.services.tensor_file import check_kind, load_header
from ftl_lightning.services.text import counted
from ftl_lightning.services.validation import from_mapping

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class Summary:
    """Summary of a learned concept.

    Attributes:
        origin: provenance.
        form: such as ``'one set'``, ``'5 modes over time'`` or ``'adapter'``.
        quality: quality of the samples; ``None`` if not measured.
    """

    origin: Origin
    form: str
    quality: QualityRecord | None


def summary(path: str | Path) -> Summary | None:
    """Summarise a concept's file. The tensors are neither read nor checked.

    Returns:
        ``None`` for another kind of file of this package, such as a model.

    Raises:
        UserError: for a file that is missing, damaged or of other software.
        OSError: if the file cannot be read.
    """
    shapes, header = load_header(path, KIND)
    if isinstance(header, dict) and isinstance(header.get("kind"), str) and header["kind"] != KIND:
        return None
    with about(path):
        keys = check_kind(header, KIND, VERSION)
        names = [field.name for field in fields(Origin)]
        if missing := [*(key for key in names if key not in keys), *({"embeddings", "weights"} - set(shapes))]:
            raise UserError(f"expected the keys of a concept, found none of {', '.join(missing)}")
        origin = from_mapping(Origin, {name: keys[name] for name in names}, "")
        quality = from_mapping(QualityRecord, keys["quality"], "quality") if keys.get("quality") is not None else None
        return Summary(origin, _form(shapes, keys.get("mixed") is True), quality)


def _form(shapes: Shapes, mixed: bool) -> str:
    """Derive the form of a concept from the shapes of its tensors."""
    modes, embeddings = shapes.get(MODES[0], ()), shapes["embeddings"]
    parts = ["mixtures" if mixed else counted(modes[0], "mode")] if modes else []
    parts += ["adapter"] if any(name.startswith(ADAPTER) for name in shapes) else []
    over_time = len(embeddings) == 3 and embeddings[1] > 1
    return f"{' and '.join(parts) or 'one set'}{' over time' if over_time else ''}"
