"""The page without a server: recorded demonstrations, and precomputed samples for a grid of weights."""

import gzip
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.page import page, request_key
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.tensor_file import bytes_hash, write_text

WEIGHTS = (0.0, 0.5, 1.0, 1.5)
"""Weights of each concept of a pair."""
PAIRS, OTHERS = 4, 3
"""Maximum number of pairs of concepts, and of training concepts mixed with a learned concept."""
COUNT = 8
"""Number of samples of each mixture."""


def pairs_of(concepts: Sequence[dict[str, Any]], named: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Pairs of concepts to mix, by their identifiers on the page: learned concepts with training concepts and with each other, or
    training concepts if none are learned.

    Args:
        concepts: list of concepts of a workspace.
        named: pairs of concept names that replace the default pairs.

    Raises:
        UserError: for an unknown name.
    """
    if named:
        by_name = {concept["name"]: concept["id"] for concept in concepts}
        if unknown := [name for name in itertools.chain(*named) if name not in by_name]:
            raise UserError(f"pairs: expected concepts of the model, found {short(unknown[0])!r}; the verb concepts lists them")
        return [(by_name[first], by_name[second]) for first, second in named]
    learned = [concept["id"] for concept in concepts if concept["kind"] != "training"]
    training = [concept["id"] for concept in concepts if concept["kind"] == "training"]
    if not learned:
        return list(itertools.combinations(training[: OTHERS + 1], 2))[:PAIRS]
    mixed = itertools.chain(zip(itertools.repeat(learned[0]), training[:OTHERS]), itertools.combinations(learned, 2))
    return list(mixed)[:PAIRS]


def answers_of(
    workspace: Workspace, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Answers to all requests of the page, by request key.

    Args:
        workspace: workspace with the demonstrations and concepts to show.
        pairs: pairs of concept names; by default see :func:`pairs_of`.
        tell: called after each mixture.
    """
    state = workspace.state()
    mixes = pairs_of(state["concepts"], pairs)
    shown = set(itertools.chain(*mixes))
    concepts = [concept for concept in state["concepts"] if concept["id"] in shown]
    offline = {"weights": list(WEIGHTS), "pairs": [list(pair) for pair in mixes]}
    answers: dict[str, Any] = {"/api/state": state | {"concepts": concepts, "models": [], "offline": offline}}
    for concept in concepts:
        answers[request_key(f"/api/thumbnail?id={concept['id']}")] = workspace.thumbnail(concept["id"])
    for pair in mixes:
        for weights in itertools.product(WEIGHTS, repeat=2):
            mixed = tuple(requests.Mixed(key, weight) for key, weight in zip(pair, weights, strict=True))
            parts = [{"id": part.id, "weight": part.weight, "groups": []} for part in mixed]
            body = {"parts": parts, "count": COUNT, "seed": 0, "temperature": state["temperature"], "execute": False, "task": ""}
            answers[request_key("/api/sample", body)] = workspace.sample(requests.Sample(mixed, COUNT)) | {"seconds": 0}
            tell()
    return answers


def write_offline(
    workspace: Workspace, path: Path, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> int:
    """Write the page; the same samples give the same bytes.

    Args:
        workspace: workspace with the demonstrations and concepts to show.
        path: path of the HTML file.
        pairs: as in :func:`answers_of`.
        tell: called after each mixture.

    Returns:
        Size of the page in bytes.
    """
    content = json.dumps(answers_of(workspace, pairs, tell), separators=(",", ":")).encode()
    text = page(bytes_hash(content), gzip.compress(content, mtime=0))
    write_text(path, text)
    return len(text.encode())
