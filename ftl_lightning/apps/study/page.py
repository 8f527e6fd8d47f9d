"""The page for raters: a single file with films, questions and scripts, which uses no network."""

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ftl_lightning.apps.study.questions import Questions, film_id
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.films import ABOVE, Wireframe, seen, window
from ftl_lightning.evaluation.pictures import frame_milliseconds, gif
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.tensor_file import bytes_hash, content_hash, write_text
from ftl_lightning.services.text import filled, line, plain, script_json
from ftl_lightning.services.validation import read_json

PAGE, KEY = "study.html", "key.json"
KEY_KIND, FORMAT = "study key", 1  #: Kind and format of the key's file.
HERE = Path(__file__).parent
CONSENT = (
    "You will see short films of generated behaviour and say what they depict. It takes about {minutes} minutes. "
    "Nobody asks for your name. Your answers stay in this browser until you save them as a file yourself at the end. "
    "You may stop at any time, and what you do not save is not used. Some questions check attention."
)
"""Default consent of raters."""
AGREE = "I am 18 or older, I have read this, and I take part voluntarily."
SECONDS_A_QUESTION = 9
MILLIMETRES = 1000


@dataclass(frozen=True)
class Made:
    """Paths and 16-digit identifier of a study, bytes of its page, and numbers of films and of questions for a rater."""

    page: Path
    key: Path
    study: str
    size: int
    films: int
    questions: int


def make_study(domain: Domain, questions: Questions, out: Path, title: str = "", consent: str = "") -> Made:
    """Write a study's page and key; the same questions and options give the same bytes. Raise UserError if ``out`` has the key of
    another study.

    Args:
        domain, questions: domain of the films, and questions about them.
        out: folder to write to.
        title, consent: title of the page, and consent of raters; empty for a neutral title and :data:`CONSENT`.
    """
    minutes = max(1, round(len(questions.page) * SECONDS_A_QUESTION / 60))
    content: dict[str, Any] = {
        "title": line(title) or "Which films depict what they should?",
        "consent": (plain(consent).strip() or CONSENT).replace("{minutes}", str(minutes)),
        "agree": AGREE,
        "questions": questions.page,
        **_drawings(domain, questions),
    }
    content["study"] = content_hash(content)
    content["page"] = bytes_hash(_html({**content, "page": ""}).encode())
    key = {
        "kind": KEY_KIND,
        "format": FORMAT,
        "study": content["study"],
        "page": content["page"],
        "domain": domain.name,
        "seed": questions.seed,
        "questions": questions.key,
        "films": questions.shown,
    }
    _keep_other_keys(out / KEY, content["study"])
    text = _html(content)
    write_text(out / KEY, json.dumps(key, indent=1, ensure_ascii=False) + "\n")
    write_text(out / PAGE, text)
    return Made(out / PAGE, out / KEY, content["study"], len(text.encode()), len(questions.films), len(questions.page))


def _keep_other_keys(path: Path, study: str) -> None:
    """Refuse to overwrite the key of another study, without which its answers cannot be read."""
    if path.is_file():
        try:
            existing = read_json(path).get("study")
        except (UserError, OSError, AttributeError):
            existing = "something else"
        actual = f"that of {short(str(existing))}; name another folder with --out"
        require(existing == study, str(path), "no key of another study", actual)


def _drawings(domain: Domain, questions: Questions) -> dict[str, Any]:
    """Films for the page: wireframes if the domain offers them, else animations."""
    motions = [film.states[:1] if number in questions.still else film.states for number, film in enumerate(questions.films)]
    if domain.show.wireframe is not None:
        # Standing pictures are as long as the other films, so that length does not reveal them.
        frames = max(len(film.states) for film in questions.films)
        standing = [states.expand(frames, -1) if len(states) == 1 else states for states in motions]
        return _lines([domain.show.wireframe(states) for states in standing])
    assert domain.show.film is not None
    return _animations([domain.show.film(states) for states in motions], questions)


def _lines(wireframes: Sequence[Wireframe]) -> dict[str, Any]:
    first = wireframes[0]
    left, lower, side = window(wireframes)
    films = {}
    for number, wireframe in enumerate(wireframes):
        whole = np.clip(np.rint(seen(wireframe.points) * MILLIMETRES), -32768, 32767).astype("<i2")  # a body is within 32 m
        films[film_id(number)] = {"frames": len(whole), "points": base64.b64encode(whole.tobytes()).decode()}
    drawing = {
        "points": first.points.shape[1],
        "lines": first.lines,
        "colours": first.colours,
        "heads": first.heads,
        "rate": first.rate,
        "window": [round(left, 4), round(lower, 4), round(side, 4)],
        "floor": first.room[0],
        "above": ABOVE,
    }
    return {"films": films, "drawing": drawing}


def _animations(pictures: Sequence[Sequence[np.ndarray[Any, Any]]], questions: Questions) -> dict[str, Any]:
    films: dict[str, Any] = {}
    for number, frames in enumerate(pictures):
        still = number in questions.still
        shown = list(frames[:1]) * 2 if still else list(frames)  # a single frame would be recognisable
        films[film_id(number)] = {
            "gif": base64.b64encode(gif(shown)).decode(),
            "seconds": len(shown) * frame_milliseconds(len(shown)) / 1000,
        }
    return {"films": films, "drawing": None}


def _html(content: Mapping[str, Any]) -> str:
    parts = {
        "TITLE": html.escape(str(content["title"])),
        "STYLE": (HERE / "page.css").read_text(encoding="utf-8"),
        "SCRIPT": (HERE / "page.js").read_text(encoding="utf-8"),
        "DATA": script_json(content),
    }
    return filled((HERE / "page.html").read_text(encoding="utf-8"), parts)
