"""The concepts that a model can be asked for by name: its training concepts, learned ones that ship with it, and saved ones.

Files are read as data, and no more than what they say of themselves. Only concepts of this very model count.
"""

import collections
import difflib
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ftl_lightning.concepts.concept import file_name
from ftl_lightning.concepts.summary import summary
from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.printing import line
from ftl_lightning.representation import Shown, counted
from ftl_lightning.tensor_file import data_folder, visible

Kind = Literal["training", "shipped", "saved"]
CONCEPT = "concept.safetensors"
"""The file of a concept that is shared, in a folder of its own."""
HEADINGS = ("name", "kind", "demonstrations", "form", "accuracy", "model", "file")
NEAREST = 3
"""Names that are told in place of one that is unknown."""
MOST_LETTERS = 60
"""Of a name in the table."""
LONGEST_STEM = 60
"""Letters of a concept's name that its file's takes over."""


@dataclass(frozen=True)
class Entry:
    """A concept of a library.

    Attributes:
        name: in words, of a learned concept that of its demonstrations.
        kind: ``'training'``; ``'shipped'``, learned and in the model's own folder; or ``'saved'``, learned and in another folder.
        model: hash of the model that it belongs to.
        count: demonstrations that it was learned from; ``None`` for a training concept.
        form: such as ``'one set'`` or ``'adapter'``; empty for a training concept.
        accuracy: share of right samples, 0 to 1, where its file says so.
        metric: of which domain's metric; empty where there is no accuracy.
        path: its file; ``None`` for a training concept.
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
        """Its file's name without the ending, or its folder's where all such files have the same; empty without a file."""
        return "" if self.path is None else self.path.parent.name if self.path.name == CONCEPT else self.path.stem

    @property
    def cells(self) -> tuple[str, ...]:
        """What a table tells of it, under :data:`HEADINGS`."""
        rate = "-" if self.accuracy is None else f"{self.accuracy:.2f}{f' ({short(self.metric, 20)})' if self.metric else ''}"
        count = "-" if self.count is None else str(self.count)
        path = "-" if self.path is None else str(self.path)
        cells = (short(self.name, MOST_LETTERS), self.kind, count, self.form or "-", rate, self.model, path)
        return tuple(map(line, cells))


@dataclass(frozen=True, repr=False)
class Library(Shown):
    """Concepts of one model.

    Attributes:
        entries: training concepts first, then those that ship, then saved ones.
        others: how many files hold concepts of other models.
        damaged: a line for each file that cannot be read.
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
        """Without the training concepts."""
        return tuple(entry for entry in self if entry.path is not None)

    @property
    def notes(self) -> tuple[str, ...]:
        """What else lies in its folders, in a line each."""
        others = f"{counted(self.others, 'concept')} of other models"
        return (*((f"not listed: {others}",) if self.others else ()), *self.damaged)

    def __str__(self) -> str:
        return table(self.entries)

    def learned_as(self, name: str) -> Entry | None:
        """The learned concept of this exact name, or else in a file of this name (without its ending).

        Raises:
            UserError: naming the files, if there are several.
        """
        for found in ([one for one in self.learned if one.name == name], [one for one in self.learned if one.stem == name]):
            if len(found) > 1:
                told = " and ".join(short(str(one.path), 100) for one in found[:2])
                more = f" and {len(found) - 2} more" if len(found) > 2 else ""
                raise UserError(f"concept {shown(name, 40)}: expected one, found {told}{more}; give one of these files")
            if found:
                return found[0]
        return None

    def nearest(self, name: str) -> list[str]:
        """Names of concepts that are most like one; of several with one name, those of their files."""
        often = collections.Counter(one.name for one in self.learned)
        known = dict.fromkeys(one.stem if often[one.name] > 1 and one.stem else one.name for one in self)
        return difflib.get_close_matches(name, known, n=NEAREST, cutoff=0)


def table(entries: Sequence[Entry]) -> str:
    """Concepts, an entry each, in aligned columns under :data:`HEADINGS`.

    Args:
        entries: of a :class:`Library`.
    """
    rows = [HEADINGS, *(entry.cells for entry in entries)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def concepts_folder() -> Path:
    """Where a user's own concepts are kept: ``concepts`` in :func:`~ftl_lightning.tensor_file.data_folder`."""
    return data_folder() / "concepts"


def kept_file(model: str, name: str) -> Path:
    """Where a concept of a model is kept in :func:`concepts_folder`: that of the same name, or a new file."""
    folder, stem = concepts_folder() / model, file_name(name)[:LONGEST_STEM].strip(".") or "concept"
    paths = (folder / f"{stem}{f'_{number}' if number else ''}.safetensors" for number in itertools.count())
    return next(path for path in paths if not path.exists() or _name_in(path) == name)


def _name_in(path: Path) -> str:
    """The name of the concept in a file; empty where none can be read."""
    try:
        told = summary(path)
    except (UserError, OSError):
        return ""
    return "" if told is None else told.origin.name


def library(model: str, training: Sequence[str], own: Path | None = None, folders: Iterable[str | Path] = ()) -> Library:
    """The concepts of a model.

    Args:
        model: hash of it.
        training: texts of its training concepts.
        own: the model's folder, whose files ``*.safetensors`` are looked at; ``None`` where it has none.
        folders: with saved concepts, as files ``*.safetensors`` or in folders within; those of :func:`concepts_folder` are always
            looked at.

    Raises:
        UserError: for one of ``folders`` that is none.
    """
    places = [Path(folder) for folder in folders]
    for place in places:
        if not place.is_dir():
            found = "a file" if place.exists() else "nothing"
            raise UserError(f"folder: expected a folder of learned concepts, found {found} at {short(str(place), 150)}")
    files: list[tuple[Kind, Path]] = [("shipped", path) for path in visible(own, "*.safetensors")] if own is not None else []
    for place in (*places, concepts_folder()):
        files += [("saved", path) for pattern in ("*.safetensors", "*/*.safetensors") for path in visible(place, pattern)]
    entries, others, damaged = [Entry(text, "training", model) for text in training], 0, []
    seen: set[str] = set()
    for kind, path in files:
        if (real := os.path.realpath(path)) in seen:
            continue
        seen.add(real)
        try:
            told = summary(path)
        except (UserError, OSError) as error:
            damaged.append(f"not listed: {error}" if isinstance(error, UserError) else f"not listed: {path}: {error.strerror}")
            continue
        if told is None:
            continue
        origin, quality = told.origin, told.quality
        if origin.pretrained != model:
            others += 1
            continue
        rate, metric = (None, "") if quality is None or quality.right is None else (quality.right, quality.metric)
        entries.append(Entry(origin.name, kind, model, origin.count, told.form, rate, metric, path))
    return Library(tuple(entries), others, tuple(damaged))
