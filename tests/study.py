"""A small domain of waving stick figures, and what is asked about it: for tests of the study alone. Nobody answered anything."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ftl_lightning.apps.study.page import Made, make_study
from ftl_lightning.apps.study.questions import ask, read_films
from ftl_lightning.apps.study.report import Key, Question
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import Concepts, Domain, Plans
from ftl_lightning.domains.mocap.rendering import film, picture, wireframe
from ftl_lightning.domains.mocap.skeleton import COLUMNS
from ftl_lightning.domains.pictures import Show
from tests.domains.test_mocap_rendering import waving

TRAINING = ("march", "run", "walk")
NEW = ("breaststroke", "chop wood", "jumping jacks")
METHODS = ("BC", "VAE", "Ours")
FRAMES = 3


def _nothing(root: Path | None) -> Any:
    raise AssertionError("a study draws no behaviour")


def _domain(name: str, show: Show) -> Domain:
    return Domain(
        name=name, plans=Plans(FRAMES, COLUMNS, ("m",) * len(COLUMNS)), concepts=Concepts(TRAINING), source=_nothing, show=show
    )


PEOPLE = _domain("people", Show(picture, film, wireframe))
FILMED = _domain("people", Show(picture, film))
"""The same without points and lines."""
UNSEEN = _domain("unseen", Show(picture))


def write_films(folder: Path, samples: int = 2) -> Path:
    """Files ``METHOD/CONCEPT.safetensors`` of all methods and concepts."""
    for method_number, method in enumerate(METHODS):
        for concept in (*TRAINING, *NEW):
            one = waving(FRAMES)
            states = torch.stack([one * (1 + 0.01 * sample + 0.05 * method_number) for sample in range(samples)])
            made = Demonstrations(
                states, torch.full((samples,), FRAMES), "people", COLUMNS, ("m",) * len(COLUMNS), (concept,) * samples
            )
            made.save(folder / method / f"{concept.replace(' ', '_')}.safetensors")
    return folder


def make(films: Path, out: Path, **options: Any) -> Made:
    """The page of a small study, and its key."""
    told = {"domain": PEOPLE, "scenarios": 1, "repeats": 2, "still": 1, "seed": 0} | options
    domain, scenarios, repeats, still, seed = (told.pop(name) for name in ("domain", "scenarios", "repeats", "still", "seed"))
    questions = ask(read_films(films, domain, scenarios, seed), repeats, still, seed)
    return make_study(domain, questions, out, **told)


Opinion = Callable[[Question, Key], str | None]
"""``(question, key) -> answer``, or ``None`` for that of somebody attentive who says yes to ours alone."""


def simulated(path: Path, key: Key, name: str, opinion: Opinion = lambda question, key: None, **changes: Any) -> Path:
    """A file of answers as a page would save it, of nobody."""
    answers = []
    for number, question in key.questions.items():
        methods = {film: key.films[film].method for film in question.films}
        usual = question.expected or ("yes" if set(methods.values()) == {"Ours"} else "no")
        if question.kind == "best":
            usual = next(film for film, method in methods.items() if method == "Ours")
        answers.append({"id": number, "answer": opinion(question, key) or usual, "milliseconds": 900})
    content = {"kind": "study answers", "format": 1, "study": key.study, "page": key.page, "rater": name, "finished": "now"}
    path.write_text(json.dumps({**content, "answers": answers, **changes}))
    return path
