"""Questions for raters, and the key with the sources of films and the known answers.

The raters' page identifies films and questions by random numbers. The key says what they are, and stays with whoever runs the
study.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ftl_lightning.apps.study.films import CHECKS, Film
from ftl_lightning.services.text import line

YES, NO = "yes", "no"
DEPICTS, BEST = "depicts", "best"
"""The two questions of the paper: whether a film depicts a concept, and which of several films depicts it best."""
CHECK, REPEAT = "check", "repeat"
"""Questions with a known answer, and repeated questions about the same film."""
INSTRUCTIONS = {YES: "This question checks attention: please answer Yes.", NO: "This question checks attention: please answer No."}


@dataclass(frozen=True)
class Questions:
    """A study's films and questions.

    Attributes:
        films: in the order of their numbers.
        still: numbers of films that are shown as their first state only.
        page: questions on the page: ``{"id", "text", "films"}``, a single film for yes or no, several films to choose from.
        key: meaning of each question, by id.
        shown: source of each film, by id.
        seed: random seed of the numbers.
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
    """The questions about some films.

    Args:
        films: one film of each method in every scenario, and checks.
        repeats: number of questions that are asked twice.
        still: number of films that are repeated as a standing picture, which depicts no motion.
        seed: random seed of the numbers, and of the repeated and standing films.

    Returns:
        Whether each film depicts its concept; two questions that state their answer, and the other checks; which film depicts a
        scenario's concept best.
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
    """Text of the first question."""
    return f"Does this film depict “{line(concept)}”?"


def _source(film: Film, still: bool) -> dict[str, Any]:
    source = {name: getattr(film, name) for name in ("setting", "scenario", "concept", "method", "file", "row", "hash")}
    return source | ({"still": True} if still else {})
