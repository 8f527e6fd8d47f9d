"""The page without a program: recorded demonstrations, and samples that were made before for a grid of weights."""

import gzip
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ftl_lightning.errors import UserError, short
from ftl_lightning.play import requests
from ftl_lightning.play.page import page, request_key
from ftl_lightning.play.workspace import Workspace
from ftl_lightning.tensor_file import bytes_hash, write_text

WEIGHTS = (0.0, 0.5, 1.0, 1.5)
"""Of each concept of a pair."""
PAIRS, OTHERS = 4, 3
"""Pairs of concepts of a page, and training concepts that a learned one is mixed with."""
COUNT = 8
"""Samples of each mix."""


def pairs_of(concepts: Sequence[dict[str, Any]], named: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Which concepts are mixed, by their names on the page: learned ones with some training concepts and with one another; without
    any, those of training.

    Args:
        concepts: as a workspace lists them.
        named: pairs of their texts in place of these.

    Raises:
        UserError: for a text that is none of theirs.
    """
    if named:
        by_name = {one["name"]: one["id"] for one in concepts}
        if unknown := [name for name in itertools.chain(*named) if name not in by_name]:
            raise UserError(f"pairs: expected concepts of the model, found {short(unknown[0])!r}; the verb concepts lists them")
        return [(by_name[one], by_name[other]) for one, other in named]
    learned = [one["id"] for one in concepts if one["kind"] != "training"]
    training = [one["id"] for one in concepts if one["kind"] == "training"]
    if not learned:
        return list(itertools.combinations(training[: OTHERS + 1], 2))[:PAIRS]
    mixed = itertools.chain(zip(itertools.repeat(learned[0]), training[:OTHERS]), itertools.combinations(learned, 2))
    return list(mixed)[:PAIRS]


def answers_of(
    workspace: Workspace, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """What the page would ask the program, by the name of the question.

    Args:
        workspace: with the demonstrations and concepts that are shown.
        pairs: of concepts by their texts; by default see :func:`pairs_of`.
        tell: called after each mix.
    """
    state = workspace.state()
    mixes = pairs_of(state["concepts"], pairs)
    shown = set(itertools.chain(*mixes))
    concepts = [one for one in state["concepts"] if one["id"] in shown]
    offline = {"weights": list(WEIGHTS), "pairs": [list(pair) for pair in mixes]}
    found: dict[str, Any] = {"/api/state": state | {"concepts": concepts, "models": [], "offline": offline}}
    for one in concepts:
        found[request_key(f"/api/thumbnail?id={one['id']}")] = workspace.thumbnail(one["id"])
    for pair in mixes:
        for weights in itertools.product(WEIGHTS, repeat=2):
            mixed = tuple(requests.Mixed(key, weight) for key, weight in zip(pair, weights, strict=True))
            parts = [{"id": part.id, "weight": part.weight, "groups": []} for part in mixed]
            asked = {"parts": parts, "count": COUNT, "seed": 0, "temperature": state["temperature"], "execute": False, "task": ""}
            found[request_key("/api/sample", asked)] = workspace.sample(requests.Sample(mixed, COUNT)) | {"seconds": 0}
            tell()
    return found


def write_offline(
    workspace: Workspace, path: Path, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> int:
    """Write the page; the same samples give the same bytes.

    Args:
        workspace: with the demonstrations and concepts that are shown.
        path: of the HTML file.
        pairs: as of :func:`answers_of`.
        tell: called after each mix.

    Returns:
        Its size in bytes.
    """
    content = json.dumps(answers_of(workspace, pairs, tell), separators=(",", ":")).encode()
    text = page(bytes_hash(content), gzip.compress(content, mtime=0))
    write_text(path, text)
    return len(text.encode())
