"""What the file of a learned concept says of it, without its numbers: lists of many concepts read no more."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from ftl_lightning.concepts.concept import ADAPTER, KIND, MODES, VERSION, Origin, QualityRecord
from ftl_lightning.errors import UserError, about
from ftl_lightning.representation import counted
from ftl_lightning.schema import from_mapping
from ftl_lightning.tensor_file import expect_kind, load_header

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class Summary:
    """A learned concept in words.

    Attributes:
        origin: where it comes from.
        form: such as ``'one set'``, ``'5 modes over time'`` or ``'adapter'``.
        quality: what its samples were like; ``None`` where nobody looked.
    """

    origin: Origin
    form: str
    quality: QualityRecord | None


def summary(path: str | Path) -> Summary | None:
    """The summary of a concept's file; its tensors are not read, so that they may still be damaged.

    Returns:
        ``None`` for a file of this program that holds something else, such as a model.

    Raises:
        UserError: for a file that is missing, damaged or of other software.
        OSError: if it cannot be read.
    """
    shapes, header = load_header(path, KIND)
    if isinstance(header, dict) and isinstance(header.get("kind"), str) and header["kind"] != KIND:
        return None
    with about(path):
        told = expect_kind(header, KIND, VERSION)
        names = [field.name for field in fields(Origin)]
        if missing := [*(key for key in names if key not in told), *({"embeddings", "weights"} - set(shapes))]:
            raise UserError(f"expected the keys of a concept, found none of {', '.join(missing)}")
        origin = from_mapping(Origin, {name: told[name] for name in names}, "")
        quality = from_mapping(QualityRecord, told["quality"], "quality") if told.get("quality") is not None else None
        return Summary(origin, _form(shapes, told.get("mixed") is True), quality)


def _form(shapes: Shapes, mixed: bool) -> str:
    """The form of a concept, by the shapes of its tensors."""
    modes, embeddings = shapes.get(MODES[0], ()), shapes["embeddings"]
    parts = ["mixtures" if mixed else counted(modes[0], "mode")] if modes else []
    parts += ["adapter"] if any(name.startswith(ADAPTER) for name in shapes) else []
    over_time = len(embeddings) == 3 and embeddings[1] > 1
    return f"{' and '.join(parts) or 'one set'}{' over time' if over_time else ''}"
