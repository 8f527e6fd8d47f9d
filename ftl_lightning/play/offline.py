"""The page without a program: recorded demonstrations, and samples that were made before for a grid of weights."""

import gzip
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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


def pairs_of(concepts: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Which concepts are mixed: learned ones with each other and with some training concepts; without any, those of training.

    Args:
        concepts: as a workspace lists them.
    """
    learned = [one["id"] for one in concepts if one["kind"] != "training"]
    training = [one["id"] for one in concepts if one["kind"] == "training"]
    if not learned:
        return list(itertools.combinations(training[: OTHERS + 1], 2))[:PAIRS]
    mixed = itertools.chain(zip(itertools.repeat(learned[0]), training[:OTHERS]), itertools.combinations(learned, 2))
    return list(mixed)[:PAIRS]


def answers_of(workspace: Workspace, tell: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """What the page would ask the program, by the name of the question.

    Args:
        workspace: with the demonstrations and concepts that are shown.
        tell: called after each mix.
    """
    state = workspace.state()
    pairs = pairs_of(state["concepts"])
    shown = set(itertools.chain(*pairs))
    concepts = [one for one in state["concepts"] if one["id"] in shown]
    offline = {"weights": list(WEIGHTS), "pairs": [list(pair) for pair in pairs]}
    found: dict[str, Any] = {"/api/state": state | {"concepts": concepts, "models": [], "offline": offline}}
    for one in concepts:
        found[request_key(f"/api/thumbnail?id={one['id']}")] = workspace.thumbnail(one["id"])
    for pair in pairs:
        for weights in itertools.product(WEIGHTS, repeat=2):
            mixed = tuple(requests.Mixed(key, weight) for key, weight in zip(pair, weights, strict=True))
            parts = [{"id": part.id, "weight": part.weight, "groups": []} for part in mixed]
            asked = {"parts": parts, "count": COUNT, "seed": 0, "temperature": state["temperature"], "execute": False, "task": ""}
            found[request_key("/api/sample", asked)] = workspace.sample(requests.Sample(mixed, COUNT)) | {"seconds": 0}
            tell()
    return found


def write_offline(workspace: Workspace, path: Path, tell: Callable[[], None] = lambda: None) -> int:
    """Write the page; the same samples give the same bytes.

    Args:
        workspace: with the demonstrations and concepts that are shown.
        path: of the HTML file.
        tell: called after each mix.

    Returns:
        Its size in bytes.
    """
    content = json.dumps(answers_of(workspace, tell), separators=(",", ":")).encode()
    text = page(bytes_hash(content), gzip.compress(content, mtime=0))
    write_text(path, text)
    return len(text.encode())
