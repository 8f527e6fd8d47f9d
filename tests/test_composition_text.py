"""Compositions in words."""

import pytest

from ftl_lightning.igm.composition import Part, parse_composition
from ftl_lightning.services.errors import UserError


def test_compositions_in_words() -> None:
    assert parse_composition("") == []
    assert parse_composition("a right of b:1.2 + c above d") == [Part("a right of b", 1.2), Part("c above d")]
    assert parse_composition("a right of b:1.2 + c above d:-0.5") == [Part("a right of b", 1.2), Part("c above d", -0.5)]
    assert parse_composition("walk@legs,trunk:0.8 + a.safetensors@arms") == [
        Part("walk", 0.8, ("legs", "trunk")),
        Part("a.safetensors", 1.0, ("arms",)),
    ]
    for wrong in ("a:heavy", "a:nan", "a:inf", ":1", "a + "):
        with pytest.raises(UserError, match="expected 'concept:weight"):
            parse_composition(wrong)
