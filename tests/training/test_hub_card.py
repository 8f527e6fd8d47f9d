"""The card of a model: names of strangers mean nothing in it."""

from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from markdown_it import MarkdownIt

from ftl_lightning.few_shot.shared_concept import model_card
from ftl_lightning.services.text import line, markdown_item
from tests.test_outputs import NAMES

BEGINNINGS = ["# x", "- x", "+ x", "1. x", "2) x", "---", "===", "- [ ] x", "", "   x", "-", "12345678901. x"]
MORE = ["```\nrm -rf ~\n```", "a\n---\nb: c", '"; !!python/object:os.system', "# x\n\n    code", "x" * 100_000]


@pytest.mark.parametrize("name", [*NAMES, *BEGINNINGS, *MORE])
def test_names_of_strangers_mean_nothing_in_a_card(name: str) -> None:
    config = SimpleNamespace(training_concepts=(name, "walk", name), horizon=3, state_dim=2, encoder=name)
    model: Any = SimpleNamespace(config=config, method=SimpleNamespace(name=name), domain=SimpleNamespace(name=name), hash="0" * 16)
    _, header, body = model_card(model).split("---\n", 2)
    assert set(yaml.safe_load(header)) == {"library_name", "tags"}
    tokens = MarkdownIt("commonmark").enable("table").parse(body)
    assert [token.tag for token in tokens if token.type == "heading_open"] == ["h1"]
    assert len([token for token in tokens if token.type == "bullet_list_open"]) == 1
    assert len([token for token in tokens if token.type == "list_item_open"]) == 3
    assert not [
        token for token in tokens if token.type in ("code_block", "html_block", "hr", "blockquote_open", "ordered_list_open")
    ]
    assert len([token for token in tokens if token.type == "fence"]) == 1
    inside = [child for token in tokens for child in token.children or ()]
    assert {child.type for child in inside} <= {"text", "text_special", "code_inline", "softbreak"}
    shown = ["".join(child.content for child in token.children or ()) for token in tokens if token.type == "inline"]
    assert not line(name) or shown.count(line(name)) == 2


def test_plain_names_stay_as_they_are() -> None:
    for name in ("go up", "5 m walk", "jump (high)", "3D", "walk - slowly"):
        assert markdown_item(name) == name
