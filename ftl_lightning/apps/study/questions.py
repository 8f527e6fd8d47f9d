"""Films of a study, the questions about them, and the key with the sources of films and the known answers.

The raters' page identifies films and questions by random numbers. The key says what they are, and stays with whoever runs the
study.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.services.errors import about, require, short, shown
from ftl_lightning.services.tensor_file import file_hash, visible
from ftl_lightning.services.text import line
from ftl_lightning.services.validation import from_mapping, read_json

LISTING = "films.json"
MOST_FILMS = 10_000  #: Maximum number of films of a listing.
TRAINING, NEW = "training", "new"  #: Settings: concepts of pretraining, and new concepts.
CHECKS = {"check-yes": "yes", "check-no": "no"}  #: Pseudo-methods of films with an obvious answer, and that answer.
YES, NO = "yes", "no"
DEPICTS, BEST = "depicts", "best"
"""The two questions of the paper: whether a film depicts a concept, and which of several films depicts it best."""
CHECK, REPEAT = "check", "repeat"  #: Questions with a known answer, and repeated questions about the same film.
INSTRUCTIONS = {YES: "This question checks attention: please answer Yes.", NO: "This question checks attention: please answer No."}


@dataclass(frozen=True)
class ListedFilm:
    """Film of a listing; an empty text or a row of -1, which no listing may give, for a default."""

    concept: str
    method: str
    file: str
    scenario: str = ""
    setting: str = ""
    row: int = -1


@dataclass(frozen=True, kw_only=True)
class FilmSource:
    """Source of a film, as in the key.

    Attributes:
        setting: :data:`TRAINING` or :data:`NEW`, or another name from a listing.
        scenario: unit of comparison between methods: a concept and an initial state.
        concept: text shown to raters.
        method: method that generated the behaviour, or a key of :data:`CHECKS`.
        file, row, hash: source of the behaviour, and hash of the file.
        still: whether only the first state is shown.
    """

    setting: str
    scenario: str
    concept: str
    method: str
    file: str
    row: int
    hash: str
    still: bool = False


@dataclass(frozen=True, kw_only=True)
class Film(FilmSource):
    """Behaviour shown to raters, with its states ``(time, state)`` in the domain's units."""

    states: Tensor


def read_films(folder: Path, domain: Domain, scenarios: int, seed: int) -> list[Film]:
    """Read the films of a folder: either of a file ``films.json``, a list of ``{"concept", "method", "file"}`` with optional
    ``"scenario"``, ``"setting"`` and ``"row"``, or of files ``METHOD/CONCEPT.safetensors``, outputs of ``sample --out``. The
    concept is read from the file, or else is the file's name, where an underscore is a space. Rows that are not listed are drawn by
    ``seed`` for a number of ``scenarios`` of each concept, equal for all methods, because equal rows have the same initial state.
    Raise UserError for a domain without films, for files that are missing, of another domain or without enough samples, and for a
    scenario that lacks a method.
    """
    filmed = domain.show.film is not None or domain.show.wireframe is not None
    require(filmed, "domain", "a domain whose plans are filmed", f"{domain.name}, which has no films")
    require(folder.is_dir(), "films", "a folder of generated behaviour", f"{'a file' if folder.exists() else 'no'} {folder}")
    listing = folder / LISTING
    entries = _listed(listing) if listing.is_file() else _named(folder)
    sources = {entry.file: _source_of(folder / entry.file, domain) for entry in entries}
    entries = [replace(entry, concept=entry.concept or _concept_of(entry.file, sources[entry.file])) for entry in entries]
    available: dict[str, int] = {}  # number of samples that every method has of a concept
    for entry in entries:
        if entry.method not in CHECKS:
            count = len(sources[entry.file])
            available[entry.concept] = min(available.get(entry.concept, count), count)
    films = []
    for entry in entries:
        source, concept = sources[entry.file], entry.concept
        if entry.row >= 0:
            rows = [entry.row]
        elif entry.method in CHECKS:
            rows = [0]
        else:
            where, actual = f"{folder / entry.file}: of {concept!r}", f"{available[concept]}; see --scenarios"
            require(available[concept] >= scenarios, where, f"{scenarios} samples or more in every method's file", actual)
            rows = sorted(np.random.default_rng(seed).permutation(available[concept])[:scenarios].tolist())
        for row in rows:
            require(row < len(source), f"{listing}: key 'row' of {entry.file}", f"0 to {len(source) - 1}", row)
            films.append(
                Film(
                    setting=entry.setting or (TRAINING if concept in domain.concepts.training else NEW),
                    scenario=entry.scenario or (concept if len(rows) == 1 else f"{concept} {row}"),
                    concept=concept,
                    method=entry.method,
                    states=source.states[row, : int(source.lengths[row])],
                    file=entry.file,
                    row=row,
                    hash=file_hash(folder / entry.file),
                )
            )
    _check_scenarios(folder, [film for film in films if film.method not in CHECKS])
    return films


def _named(folder: Path) -> list[ListedFilm]:
    """Entries of the files in the folders of methods."""
    paths = visible(folder, "*/*.safetensors")
    require(paths, str(folder), f"{LISTING} or files METHOD/CONCEPT.safetensors", "neither; make them with: sample --out")
    return [ListedFilm("", path.parent.name, str(path.relative_to(folder))) for path in paths]


def _listed(path: Path) -> list[ListedFilm]:
    """Entries of a listing."""
    content = read_json(path)
    with about(path):
        require(isinstance(content, list) and content, "films", "a list with one or more films", content)
        require(len(content) <= MOST_FILMS, "films", f"at most {MOST_FILMS}", len(content))
        return [from_mapping(ListedFilm, entry, f"films[{number}]") for number, entry in enumerate(content)]


def _concept_of(file: str, source: Demonstrations) -> str:
    """Concept of a file, if it has a single concept; else the file's name."""
    (concept, *others) = dict.fromkeys(source.concepts)
    return concept if concept and not others else Path(file).stem.replace("_", " ")


def _source_of(path: Path, domain: Domain) -> Demonstrations:
    """Behaviour of a file, checked for the domain."""
    source, columns = Demonstrations.load(path), len(domain.plans.columns)
    require(source.domain in ("", domain.name), str(path), f"behaviour of the domain {domain.name}", source.domain)
    require(source.states.shape[2] == columns, str(path), f"states of {columns} columns", source.states.shape[2])
    return source


def _check_scenarios(folder: Path, films: Sequence[Film]) -> None:
    """Refuse scenarios in which a method has no film, or two films."""
    require(films, str(folder), "films of a method", "checks alone")
    methods = sorted({film.method for film in films})
    for scenario in sorted({film.scenario for film in films}):
        where = f"{folder}: scenario {shown(scenario)}"
        group = [film for film in films if film.scenario == scenario]
        settings = short(", ".join(sorted({film.setting for film in group})))
        require(len({(film.setting, film.concept) for film in group}) == 1, where, "one concept and setting", settings)
        present = sorted(film.method for film in group)
        require(present == methods, where, f"a film of each of {short(', '.join(methods))}", short(", ".join(present)))


@dataclass(frozen=True)
class Questions:
    """A study's films, in the order of their numbers, and questions.

    Attributes:
        still: numbers of films of which only the first state is shown.
        page: questions on the page: ``{"id", "text", "films"}``, a single film for yes or no, several films to choose from.
        key, shown: meaning of each question, and source of each film, by id.
    """

    films: tuple[Film, ...]
    still: frozenset[int]
    page: tuple[Mapping[str, Any], ...]
    key: Mapping[str, Mapping[str, Any]]
    shown: Mapping[str, Mapping[str, Any]]
    seed: int


def film_id(number: int) -> str:
    """Identifier of a film on the page."""
    return f"f{number + 1:02d}"


def ask(films: Sequence[Film], repeats: int, still: int, seed: int) -> Questions:
    """Ask whether each film depicts its concept, and which film of a scenario depicts it best. As checks, ``repeats`` questions are
    asked twice, and ``still`` films are repeated as still pictures, which depict no motion. ``films`` has a film of each method in
    every scenario, and checks; ``seed`` determines the numbering, and the repeated and still films.
    """
    rng = np.random.default_rng(seed)
    real = [film for film in films if film.method not in CHECKS]
    stilled = [real[index] for index in rng.permutation(len(real))[:still]]
    order = rng.permutation(len(films) + len(stilled)).tolist()
    dealt = [(*films, *stilled)[index] for index in order]
    standing = frozenset(number for number, index in enumerate(order) if index >= len(films))
    number_of = {id(film): number for number, film in enumerate(dealt) if number not in standing}
    questions: list[tuple[dict[str, Any], dict[str, Any]]] = []

    def add(text: str, shown: Sequence[int], **kind: Any) -> None:
        questions.append(({"text": text, "films": [film_id(number) for number in shown]}, kind))

    for number, film in enumerate(dealt):
        if number in standing:
            add(whether(film.concept), [number], kind=CHECK, expected=NO)
        elif film.method in CHECKS:
            add(whether(film.concept), [number], kind=CHECK, expected=CHECKS[film.method])
        else:
            add(whether(film.concept), [number], kind=DEPICTS)
    for film in [real[index] for index in rng.permutation(len(real))[:repeats]]:
        add(whether(film.concept), [number_of[id(film)]], kind=REPEAT)
    for (expected, text), index in zip(INSTRUCTIONS.items(), rng.permutation(len(real)), strict=False):
        add(text, [number_of[id(real[index])]], kind=CHECK, expected=expected)
    for scenario in sorted({film.scenario for film in real}):
        pool = [film for film in real if film.scenario == scenario]
        if len(pool) > 1:
            shown = sorted(number_of[id(film)] for film in pool)
            add(f"Which film depicts “{line(pool[0].concept)}” best?", shown, kind=BEST, scenario=scenario, setting=pool[0].setting)
    page, key = [], {}
    for number, index in enumerate(rng.permutation(len(questions)).tolist()):
        shown, kind = questions[index]
        name = f"q{number + 1:02d}"
        page.append({"id": name, **shown})
        key[name] = {**kind, "films": shown["films"], "text": shown["text"]}
    return Questions(
        films=tuple(dealt),
        still=standing,
        page=tuple(page),
        key=key,
        shown={film_id(number): _source(film, number in standing) for number, film in enumerate(dealt)},
        seed=seed,
    )


def whether(concept: str) -> str:
    """Text of the question whether a film depicts a concept."""
    return f"Does this film depict “{line(concept)}”?"


def _source(film: Film, still: bool) -> dict[str, Any]:
    source = {field.name: getattr(film, field.name) for field in fields(FilmSource) if field.name != "still"}
    return source | ({"still": True} if still else {})
