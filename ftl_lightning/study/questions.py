"""What raters are asked, and the key that says who made what and which answers are known.

Raters' page and key are apart: the page knows films and questions by numbers that were dealt out at random, the key says what they
are and stays with whoever runs the study.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ftl_lightning.printing import line
from ftl_lightning.study.films import CHECKS, Film

YES, NO = "yes", "no"
DEPICTS, BEST = "depicts", "best"
"""The two questions of the paper: whether a film depicts a concept, and which of several depicts it best."""
CHECK, REPEAT = "check", "repeat"
"""Questions whose answer is known; the same question about the same film once more."""
INSTRUCTIONS = {YES: "This question checks attention: please answer Yes.", NO: "This question checks attention: please answer No."}


@dataclass(frozen=True)
class Questions:
    """A study's films and questions.

    Attributes:
        films: in the order of their numbers, without what they are.
        still: numbers of films that are shown as their first state alone.
        page: questions as the page has them: ``{"id", "text", "films"}``, a single film for yes or no, several to choose from.
        key: what each question is, by its id.
        shown: what each film is, by its id.
        seed: that dealt them out.
    """

    films: tuple[Film, ...]
    still: frozenset[int]
    page: tuple[Mapping[str, Any], ...]
    key: Mapping[str, Mapping[str, Any]]
    shown: Mapping[str, Mapping[str, Any]]
    seed: int


def film_id(number: int) -> str:
    """The name of a film in the page."""
    return f"f{number + 1:02d}"


def ask(films: Sequence[Film], repeats: int, still: int, seed: int) -> Questions:
    """The questions about some films.

    Args:
        films: every scenario's with one of each method, and checks.
        repeats: questions that are asked twice.
        still: films that are shown once more as a standing picture, which depicts no motion.
        seed: deals out numbers and draws what is repeated and stilled.

    Returns:
        Whether each film depicts its concept; two questions that say what to answer, and the other checks; which film depicts a
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
        own = [film for film in real if film.scenario == scenario]
        if len(own) > 1:
            shown = sorted(number_of[id(film)] for film in own)
            add(f"Which film depicts “{line(own[0].concept)}” best?", shown, kind=BEST, scenario=scenario, setting=own[0].setting)
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
        shown={film_id(number): _told(film, number in standing) for number, film in enumerate(dealt)},
        seed=seed,
    )


def whether(concept: str) -> str:
    """The first question."""
    return f"Does this film depict “{line(concept)}”?"


def _told(film: Film, still: bool) -> dict[str, Any]:
    told = {name: getattr(film, name) for name in ("setting", "scenario", "concept", "method", "file", "row", "hash")}
    return told | ({"still": True} if still else {})
