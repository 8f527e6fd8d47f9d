"""Library of a model's concepts by name: training concepts, shipped learned concepts, and saved concepts.

Files are read as data, and only their headers. Concepts of other models are excluded.
"""

import collections
import difflib
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from ftl_lightning.igm.concept import ADAPTER, KIND, MODES, VERSION, Concept, Origin, QualityRecord, file_name
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.files import check_writable_file
from ftl_lightning.services.tensor_file import check_kind, data_folder, load_header, visible
from ftl_lightning.services.text import Shown, counted, folded, line, say
from ftl_lightning.services.validation import from_mapping

Kind = Literal["training", "shipped", "saved"]
CONCEPT = "concept.safetensors"
"""File name of a shared concept, in its folder."""
HEADINGS = ("name", "kind", "demonstrations", "form", "accuracy", "model", "file")
NEAREST = 3
"""Number of suggestions for an unknown name."""
MOST_LETTERS = 60
"""Maximum length of a name in the table."""
LONGEST_STEM = 60
"""Maximum length of a file's stem."""


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
    """Summarise a concept's file ``path``. The tensors are neither read nor checked.

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


def _form(shapes: Mapping[str, tuple[int, ...]], mixed: bool) -> str:
    """Derive the form of a concept from the shapes of its tensors."""
    modes, embeddings = shapes.get(MODES[0], ()), shapes["embeddings"]
    parts = ["mixtures" if mixed else counted(modes[0], "mode")] if modes else []
    parts += ["adapter"] if any(name.startswith(ADAPTER) for name in shapes) else []
    over_time = len(embeddings) == 3 and embeddings[1] > 1
    return f"{' and '.join(parts) or 'one set'}{' over time' if over_time else ''}"


@dataclass(frozen=True)
class Entry:
    """A concept of a library.

    Attributes:
        name: name in words; for a learned concept the text of its demonstrations.
        kind: ``'training'``; ``'shipped'``, learned and in the model's folder; or ``'saved'``, learned and in another folder.
        model: hash of the model.
        count: number of demonstrations; ``None`` for a training concept.
        form: form, such as ``'one set'`` or ``'adapter'``; empty for a training concept.
        accuracy: share of correct samples, 0 to 1, if recorded.
        metric: the accuracy's domain metric; empty without an accuracy.
        path: file; ``None`` for a training concept.
    """

    name: str
    kind: Kind
    model: str
    count: int | None = None
    form: str = ""
    accuracy: float | None = None
    metric: str = ""
    path: Path | None = None

    @property
    def stem(self) -> str:
        """Name of the file without its ending, or of the folder of a shared concept; empty without a file."""
        return "" if self.path is None else self.path.parent.name if self.path.name == CONCEPT else self.path.stem

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table row under :data:`HEADINGS`."""
        rate = "-" if self.accuracy is None else f"{self.accuracy:.2f}{f' ({short(self.metric, 20)})' if self.metric else ''}"
        count = "-" if self.count is None else str(self.count)
        path = "-" if self.path is None else str(self.path)
        cells = (short(self.name, MOST_LETTERS), self.kind, count, self.form or "-", rate, self.model, path)
        return tuple(map(line, cells))


@dataclass(frozen=True, repr=False)
class Library(Shown):
    """Concepts of a model.

    Attributes:
        entries: training concepts, then shipped, then saved concepts.
        others: number of files with concepts of other models.
        damaged: a line for each unreadable file.
    """

    entries: tuple[Entry, ...]
    others: int = 0
    damaged: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Entry]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def _words(self) -> Iterator[str]:
        for kind in ("training", "shipped", "saved"):
            yield counted(sum(entry.kind == kind for entry in self), f"{kind} concept")
        yield from self.notes

    @property
    def learned(self) -> tuple[Entry, ...]:
        """Entries without the training concepts."""
        return tuple(entry for entry in self if entry.path is not None)

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about other and damaged files."""
        others = f"{counted(self.others, 'concept')} of other models"
        return (*((f"not listed: {others}",) if self.others else ()), *self.damaged)

    def __str__(self) -> str:
        return table(self.entries)

    def learned_as(self, name: str) -> Entry | None:
        """The learned concept with this exact name, or else with this file stem.

        Raises:
            UserError: with the files, if there are several.
        """
        for matches in (
            [entry for entry in self.learned if entry.name == name],
            [entry for entry in self.learned if entry.stem == name],
        ):
            if len(matches) > 1:
                files = " and ".join(short(str(entry.path), 100) for entry in matches[:2])
                more = f" and {len(matches) - 2} more" if len(matches) > 2 else ""
                raise UserError(f"concept {shown(name, 40)}: expected one, found {files}{more}; give one of these files")
            if matches:
                return matches[0]
        return None

    def nearest(self, name: str) -> list[str]:
        """The concept names most similar to ``name``; file stems for equal names."""
        often = collections.Counter(entry.name for entry in self.learned)
        known = dict.fromkeys(entry.stem if often[entry.name] > 1 and entry.stem else entry.name for entry in self)
        return difflib.get_close_matches(name, known, n=NEAREST, cutoff=0)


def table(entries: Sequence[Entry]) -> str:
    """Table of ``entries``: table of concepts in aligned columns under :data:`HEADINGS`."""
    rows = [HEADINGS, *(entry.cells for entry in entries)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def concepts_folder() -> Path:
    """Folder of a user's concepts: ``concepts`` in :func:`~ftl_lightning.services.tensor_file.data_folder`."""
    return data_folder() / "concepts"


def kept_file(model: str, name: str) -> Path:
    """File of a model's concept in :func:`concepts_folder`: the file with the same concept name, or a new file."""
    folder, stem = concepts_folder() / model, file_name(name)[:LONGEST_STEM].strip(".") or "concept"
    paths = (folder / f"{stem}{f'_{number}' if number else ''}.safetensors" for number in itertools.count())
    return next(path for path in paths if not path.exists() or _name_in(path) == name)


def _name_in(path: Path) -> str:
    """Name of the concept in a file; empty if unreadable."""
    try:
        content = summary(path)
    except (UserError, OSError):
        return ""
    return "" if content is None else content.origin.name


def library(model: str, training: Sequence[str], shipped: Path | None = None, folders: Iterable[str | Path] = ()) -> Library:
    """Library of a model's concepts; ``UserError`` for an entry of ``folders`` that is not a folder.

    Args:
        model: hash of the model.
        training: texts of the training concepts.
        shipped: the model's folder, with shipped concepts ``*.safetensors``; ``None`` without a folder.
        folders: folders of saved concepts ``*.safetensors``, directly or in subfolders; :func:`concepts_folder` is always
            searched.
    """
    places = [Path(folder) for folder in folders]
    for place in places:
        if not place.is_dir():
            actual = "a file" if place.exists() else "nothing"
            raise UserError(f"folder: expected a folder of learned concepts, found {actual} at {short(str(place), 150)}")
    files: list[tuple[Kind, Path]] = [] if shipped is None else [("shipped", path) for path in visible(shipped, "*.safetensors")]
    for place in (*places, concepts_folder()):
        files += [("saved", path) for pattern in ("*.safetensors", "*/*.safetensors") for path in visible(place, pattern)]
    entries, others, damaged = [Entry(text, "training", model) for text in training], 0, []
    paths_read: set[str] = set()
    for kind, path in files:
        if (real := os.path.realpath(path)) in paths_read:
            continue
        paths_read.add(real)
        try:
            content = summary(path)
        except (UserError, OSError) as error:
            damaged.append(f"not listed: {error}" if isinstance(error, UserError) else f"not listed: {path}: {error.strerror}")
            continue
        if content is None:
            continue
        origin, quality = content.origin, content.quality
        if origin.pretrained != model:
            others += 1
            continue
        rate, metric = (None, "") if quality is None or quality.right is None else (quality.right, quality.metric)
        entries.append(Entry(origin.name, kind, model, origin.count, content.form, rate, metric, path))
    return Library(tuple(entries), others, tuple(damaged))


def concept_files(names: Iterable[str], folder: Path, place: str) -> dict[str, Path]:
    """Output files of learned concepts in ``folder``, by the ``names`` of the concepts. ``place`` names the option in messages.

    Files are numbered from the second on if their names are equal, or differ only by case or Unicode normal form, which some file
    systems do not distinguish.

    Raises:
        UserError: for a file that cannot be written.
    """
    files: dict[str, Path] = {}
    taken: set[str] = set()
    for name in dict.fromkeys(names):
        stems = (f"{file_name(name)}{f'_{number}' if number else ''}" for number in itertools.count())
        stem = next(stem for stem in stems if folded(stem) not in taken)
        taken.add(folded(stem))
        files[name] = folder / f"{stem}.safetensors"
    for path in files.values():
        check_writable_file(path, place)
    return files


def write_concept(concept: Concept, path: Path, quality: object = None) -> None:
    """Write a learned concept to ``path``, and print its loss, weights, form and ``quality``."""
    concept.save(path)
    weights = ", ".join(f"{weight:.2f}" for weight in concept.weights.tolist())
    say(f"{path}: loss {concept.origin.loss:.3f}, weights {weights}")
    if concept.choice is not None:
        say(f"  form: {concept.choice}")
    if quality is not None:
        say(f"  quality: {quality}")
