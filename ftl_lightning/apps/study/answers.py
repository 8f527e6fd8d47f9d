"""Answers of raters: files saved by their browsers, read and checked against a study's key."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ftl_lightning.apps.study.page import FORMAT, KEY_KIND
from ftl_lightning.apps.study.questions import BEST, CHECK, DEPICTS, NO, REPEAT, YES
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.validation import read_json

ANSWERS_KIND = "study answers"
REPEATS_THAT_MAY_DIFFER = 0.5
"""Maximum fraction of repeated questions that an attentive rater may answer inconsistently."""


@dataclass(frozen=True)
class Key:
    """Meaning of a study's questions and films.

    Attributes:
        study, page: 16-digit identifiers of the study and of its page.
        questions: by id: ``kind``, ``text``, ``films``, and ``expected`` of a check, ``scenario`` and ``setting`` of a comparison.
        films: by id: ``setting``, ``scenario``, ``concept``, ``method``, and the film's source.
    """

    study: str
    page: str
    questions: Mapping[str, Mapping[str, Any]]
    films: Mapping[str, Mapping[str, Any]]

    def of_kind(self, kind: str) -> dict[str, Mapping[str, Any]]:
        """Questions of one kind, by id."""
        return {name: question for name, question in self.questions.items() if question["kind"] == kind}


@dataclass(frozen=True)
class Rater:
    """Answers of one person.

    Attributes:
        file: source of the answers.
        name: 16 digits drawn by the browser.
        answers: by question id: ``'yes'``, ``'no'``, or a film's id.
    """

    file: Path
    name: str
    answers: Mapping[str, str]


def _json(path: Path, kind: str) -> dict[str, Any]:
    content = read_json(path, f"a {kind} file")
    actual = content.get("kind") if isinstance(content, dict) else None
    if actual != kind:
        description = f"a {short(str(actual))} file" if actual else "a file of other software"
        raise UserError(f"{path}: expected a {kind} file, found {description}")
    if content.get("format") != FORMAT:
        raise UserError(f"{path}: key 'format': expected {FORMAT}, found {shown(content.get('format'))}; it is of another version")
    return content


def read_key(path: Path) -> Key:
    """Read the key written by ``study``.

    Raises:
        UserError: naming the file, if it is missing, damaged or of another kind.
    """
    content = _json(path, KEY_KIND)
    try:
        key = Key(str(content["study"]), str(content["page"]), dict(content["questions"]), dict(content["films"]))
        for film in key.films.values():
            _expect_texts(film, ("setting", "scenario", "method"))
        for question in key.questions.values():
            _expect_texts(question, {CHECK: ("expected",), BEST: ("scenario", "setting")}.get(question["kind"], ()))
            _expect_texts(question, ("text", "kind"))
            if not question["films"] or not {*question["films"]} <= key.films.keys():
                raise KeyError("films")
        original = {_identity(question) for question in key.of_kind(DEPICTS).values()}
        if not {_identity(question) for question in key.of_kind(REPEAT).values()} <= original:
            raise KeyError("a question that is repeated")
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path}: expected a study's key with study, page, questions and films, found a damaged one ({short(str(error))})"
        ) from error
    return key


def _expect_texts(entry: Mapping[str, Any], names: Sequence[str]) -> None:
    for name in names:
        if not isinstance(entry[name], str):
            raise ValueError(f"{name}: {shown(entry[name])}")


def _identity(question: Mapping[str, Any]) -> tuple[str, ...]:
    """Content by which repeated questions are equal."""
    return (question["text"], *question["films"])


def read_rater(path: Path, key: Key) -> Rater:
    """Read one file of answers.

    Raises:
        UserError: naming the file, if it is missing, damaged, of another study, of another page, or not finished.
    """
    content = _json(path, ANSWERS_KIND)
    for part, expected in (("study", key.study), ("page", key.page)):
        if content.get(part) != expected:
            raise UserError(
                f"{path}: key {part!r}: expected {expected}, found {shown(content.get(part))}; the answers are of another {part}"
            )
    name, given = content.get("rater"), content.get("answers")
    if not isinstance(name, str) or not name or not isinstance(given, list):
        raise UserError(f"{path}: expected a rater and a list of answers, found a damaged file")
    answers: dict[str, str] = {}
    for entry in given:
        if entry is None:  # a question that was not reached
            continue
        identifier = entry.get("id") if isinstance(entry, dict) else None
        question = key.questions.get(identifier) if isinstance(identifier, str) else None
        if question is None or entry["id"] in answers:
            raise UserError(f"{path}: key 'answers': expected one answer to each question, found {shown(entry)}")
        allowed = (YES, NO) if question["kind"] != BEST else question["films"]
        if entry.get("answer") not in allowed:
            choices = " or ".join(allowed)
            raise UserError(f"{path}: answer to {entry['id']}: expected {choices}, found {entry.get('answer')!r}")
        answers[entry["id"]] = entry["answer"]
    if not content.get("finished") or len(answers) < len(key.questions):
        raise UserError(
            f"{path}: expected {len(key.questions)} answers of a finished run, found {len(answers)}; finish it in the same browser"
        )
    return Rater(path, name, answers)


def read_raters(paths: Sequence[Path], key: Key) -> tuple[list[Rater], list[str]]:
    """Read files of answers; invalid files are reported and skipped.

    Args:
        paths: files, or folders with files ``answers*.json``.
        key: key of the study.

    Returns:
        Unique raters, and one line for each refused file.
    """
    files: list[Path] = []
    refused: list[str] = []
    for path in paths:
        inside = sorted(path.glob("answers*.json")) if path.is_dir() else [path]
        if not inside:
            refused.append(f"{path}: expected files answers*.json in this folder, found none")
        files += inside
    raters: dict[str, Rater] = {}
    for path in dict.fromkeys(files):
        try:
            rater = read_rater(path, key)
        except UserError as error:
            refused.append(str(error))
            continue
        if rater.name in raters:
            refused.append(
                f"{path}: expected another rater than {raters[rater.name].file} has, found the same; keep one of the two"
            )
            continue
        raters[rater.name] = rater
    return list(raters.values()), refused


def inattention(rater: Rater, key: Key) -> str:
    """Reason to exclude a rater's answers; empty if they count.

    A rater fails by answering any check wrongly, or more than :data:`REPEATS_THAT_MAY_DIFFER` of the repeated questions
    inconsistently.
    """
    checks = key.of_kind(CHECK)
    wrong = sum(rater.answers[name] != question["expected"] for name, question in checks.items())
    if wrong:
        return f"{wrong} of {len(checks)} attention checks answered wrongly"
    first = {_identity(question): name for name, question in key.of_kind(DEPICTS).items()}
    pairs = [(name, first[_identity(question)]) for name, question in key.of_kind(REPEAT).items()]
    differ = sum(rater.answers[repeat] != rater.answers[original] for repeat, original in pairs)
    if differ > REPEATS_THAT_MAY_DIFFER * len(pairs):
        return f"{differ} of {len(pairs)} questions that were asked twice answered in two ways"
    return ""
