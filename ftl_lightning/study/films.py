"""The films of a study: which behaviour, of which method, is said to depict which concept."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.schema import read_json
from ftl_lightning.tensor_file import file_hash, visible

LISTING = "films.json"
TRAINING, NEW = "training", "new"
"""Settings: concepts of pretraining and new ones."""
CHECKS = {"check-yes": "yes", "check-no": "no"}
"""Methods that are none: films whose answer is obvious, by the answer."""
_NEEDED, _TEXTS = ("concept", "method", "file"), ("scenario", "setting")
_OPTIONAL = (*_TEXTS, "row")


@dataclass(frozen=True)
class Film:
    """Behaviour that raters see.

    Attributes:
        setting: :data:`TRAINING` or :data:`NEW`, or any other that a listing names.
        scenario: what methods are compared in: a concept from one initial state.
        concept: the words that raters read.
        method: who made it, or one of :data:`CHECKS`.
        states: ``(time, state)`` in the domain's units.
        file, row: where it comes from.
        hash: of the file.
    """

    setting: str
    scenario: str
    concept: str
    method: str
    states: Tensor
    file: str
    row: int
    hash: str


def read_films(folder: Path, domain: Domain, scenarios: int, seed: int) -> list[Film]:
    """Films of a folder.

    Either the folder has a file ``films.json``, a list of ``{"concept", "method", "file"}`` with, if wanted, ``"scenario"``,
    ``"setting"`` and ``"row"``, or everything in it is named ``METHOD/CONCEPT.safetensors``. Files are what ``sample --out`` wrote:
    the concept is the one that the file tells, or else its name, where an underscore is a space.

    Which samples of a file are shown is drawn, not chosen: the same rows of all methods, because those have the same initial state.

    Args:
        folder: of the user.
        domain: whose behaviour it is.
        scenarios: how many of each concept.
        seed: decides the rows that no listing names.

    Raises:
        UserError: for a domain without films, for files that are missing, of another domain or without enough samples, and for a
            scenario that lacks a method.
    """
    if domain.show.film is None and domain.show.wireframe is None:
        raise UserError(f"domain: expected one whose plans are filmed, found {domain.name}, which has no films")
    if not folder.is_dir():
        raise UserError(f"films: expected a folder of generated behaviour, found {'a file' if folder.exists() else 'no'} {folder}")
    listing = folder / LISTING
    entries = _listed(listing) if listing.is_file() else _named(folder)
    sources = {str(entry["file"]): Demonstrations.load(folder / str(entry["file"])) for entry in entries}
    for name, source in sources.items():
        _check(folder / name, source, domain)
    for entry in entries:
        if "concept" not in entry:
            told = sources[str(entry["file"])].concepts
            entry["concept"] = told[0] if told[0] and len(set(told)) == 1 else Path(entry["file"]).stem.replace("_", " ")
    common = {
        concept: min(len(sources[str(e["file"])]) for e in entries if e["concept"] == concept and e["method"] not in CHECKS)
        for concept in {str(e["concept"]) for e in entries if e["method"] not in CHECKS}
    }
    films = []
    for entry in entries:
        name, concept, check = str(entry["file"]), str(entry["concept"]), entry["method"] in CHECKS
        source = sources[name]
        if "row" in entry:
            rows = [entry["row"]]
        elif check:
            rows = [0]
        else:
            rows = _drawn(common[concept], scenarios, seed, f"{folder / name}: of {concept!r}")
        for row in rows:
            if type(row) is not int or not 0 <= row < len(source):
                raise UserError(f"{listing}: key 'row' of {name}: expected 0 to {len(source) - 1}, found {shown(row)}")
            films.append(
                Film(
                    setting=str(entry.get("setting", TRAINING if concept in domain.concepts.training else NEW)),
                    scenario=str(entry.get("scenario", concept if len(rows) == 1 else f"{concept} {row}")),
                    concept=concept,
                    method=str(entry["method"]),
                    states=source.states[row, : int(source.lengths[row])],
                    file=name,
                    row=row,
                    hash=file_hash(folder / name),
                )
            )
    _compare(folder, [film for film in films if film.method not in CHECKS])
    return films


def _drawn(available: int, count: int, seed: int, what: str) -> list[int]:
    if available < count:
        raise UserError(f"{what} expected {count} samples or more in every method's file, found {available}; see --scenarios")
    return sorted(np.random.default_rng(seed).permutation(available)[:count].tolist())


def _named(folder: Path) -> list[dict[str, Any]]:
    paths = visible(folder, "*/*.safetensors")
    if not paths:
        raise UserError(
            f"{folder}: expected {LISTING} or files METHOD/CONCEPT.safetensors, found neither; make them with: sample --out"
        )
    return [{"method": path.parent.name, "file": str(path.relative_to(folder))} for path in paths]


def _listed(path: Path) -> list[dict[str, Any]]:
    try:
        entries = read_json(path)
    except OSError as error:
        raise UserError(f"{path}: expected JSON, found something else ({error})") from error
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path}: expected a list of films, found {type(entries).__name__ if entries != [] else 'an empty one'}")
    for number, entry in enumerate(entries):
        where = f"{path}: film {number}"
        if not isinstance(entry, dict):
            raise UserError(f"{where}: expected {{{', '.join(_NEEDED)}}}, found {type(entry).__name__}")
        if unknown := sorted(set(entry) - {*_NEEDED, *_OPTIONAL}):
            raise UserError(f"{where}: expected the keys {', '.join((*_NEEDED, *_OPTIONAL))}, found {short(', '.join(unknown))}")
        for key in (*_NEEDED, *(key for key in _TEXTS if key in entry)):
            if not isinstance(entry.get(key), str) or not entry[key]:
                raise UserError(f"{where}: key {key!r}: expected a text, found {shown(entry.get(key))}")
    return entries


def _check(path: Path, source: Demonstrations, domain: Domain) -> None:
    if source.domain not in ("", domain.name):
        raise UserError(f"{path}: expected behaviour of the domain {domain.name}, found {source.domain}")
    if source.states.shape[2] != len(domain.plans.columns):
        raise UserError(f"{path}: expected states of {len(domain.plans.columns)} columns, found {source.states.shape[2]}")


def _compare(folder: Path, films: Sequence[Film]) -> None:
    """Refuse scenarios in which a method has no film, or two."""
    if not films:
        raise UserError(f"{folder}: expected films of a method, found checks alone")
    methods = sorted({film.method for film in films})
    for scenario in sorted({film.scenario for film in films}):
        own = [film for film in films if film.scenario == scenario]
        if len({(film.setting, film.concept) for film in own}) > 1:
            told = short(", ".join(sorted({film.setting for film in own})))
            raise UserError(f"{folder}: scenario {shown(scenario)}: expected one concept and setting, found {told}")
        found = sorted(film.method for film in own)
        if found != methods:
            raise UserError(
                f"{folder}: scenario {shown(scenario)}: expected a film of each of {short(', '.join(methods))}, "
                f"found {short(', '.join(found))}"
            )
