"""The file of a learned concept."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

from ftl_lightning.igm.concept import KIND, VERSION, Concept, Origin
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import save_tensors
from tests.conftest import ROOT

COMMITTED = sorted((ROOT / "results" / "concepts").rglob("*.safetensors"))
ORIGIN = Origin("new", "object_rearrangement", "e", "p", "d", 5, "fixed", 0.15)


def concept(modes: int = 3, mixed: bool = False) -> Concept:
    """K = 2, one knot, n = 4."""
    draw = torch.Generator().manual_seed(0)
    several = Modes(torch.randn(modes, 2, 1, 4, generator=draw), torch.rand(modes, 2, generator=draw), mixed) if modes else None
    return Concept(torch.randn(2, 1, 4, generator=draw), torch.tensor([1.2, 0.6]), ORIGIN, several)


def header(path: str) -> dict[str, object]:
    with safe_open(path, framework="pt") as file:
        found: dict[str, object] = json.loads(file.metadata()["ftl_lightning"])
    return found


def test_committed_files_are_read_and_written_with_the_same_bytes() -> None:
    assert len(COMMITTED) >= 48
    for path in COMMITTED:
        found = Concept.load(path)
        assert (found.modes is not None) == any(part in path.as_posix() for part in ("_modes/", "/mocap/", "/mocap_adapter/"))
        found.save("again.safetensors")
        assert Path("again.safetensors").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("mixed", [False, True])
def test_a_concept_with_modes_comes_back_from_its_file(mixed: bool) -> None:
    own = concept(mixed=mixed)
    own.save("c.safetensors")
    found = Concept.load("c.safetensors")
    assert torch.equal(found.modes.embeddings, own.modes.embeddings)
    assert torch.equal(found.modes.weights, own.modes.weights)
    assert found.modes.mixed is mixed
    assert torch.equal(found.embeddings, own.embeddings)
    assert torch.equal(found.weights, own.weights)
    assert found.origin == ORIGIN
    before = Path("c.safetensors").read_bytes()
    found.save("c.safetensors")
    assert Path("c.safetensors").read_bytes() == before


def test_a_concept_without_modes_has_no_modes_when_read() -> None:
    concept(modes=0).save("c.safetensors")
    assert "mixed" not in header("c.safetensors")
    assert Concept.load("c.safetensors").modes is None
    assert Concept.load("c.safetensors").composition.modes is None


def write_changed(version: int = VERSION, without: str = "", **changes: object) -> None:
    """Write ``c.safetensors``, a concept with modes that lacks a key or a tensor, or whose header has changes."""
    own = concept()
    tensors = {"embeddings": own.embeddings, "weights": own.weights}
    tensors |= {"mode_embeddings": own.modes.embeddings, "mode_weights": own.modes.weights}
    content = {**ORIGIN.__dict__, "mixed": False, **changes}
    kept = {name: tensor for name, tensor in tensors.items() if name != without}
    save_tensors("c.safetensors", KIND, kept, {key: value for key, value in content.items() if key != without}, version)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 1}, f"key 'format': expected {VERSION}, found 1; it is of another version"),
        ({"version": VERSION + 1}, f"key 'format': expected {VERSION}, found {VERSION + 1}; it is of another version"),
        ({"without": "mixed"}, "expected the tensors embeddings, weights, found mode_embeddings, mode_weights too"),
        ({"without": "mode_weights"}, "expected the keys of a concept, found none of mode_weights"),
        ({"without": "embeddings"}, "expected the keys of a concept, found none of embeddings"),
        ({"without": "name"}, "expected the keys of a concept, found none of name"),
        ({"mixed": 1}, "key 'mixed': expected true or false, found 1"),
    ],
    ids=str,
)
def test_a_file_that_cannot_be_read_is_one_line(changes: dict[str, Any], message: str) -> None:
    write_changed(**changes)
    with pytest.raises(UserError) as told:
        Concept.load("c.safetensors")
    assert str(told.value) == f"c.safetensors: {message}"


def test_parts_are_the_components_and_those_of_every_mode_by_name() -> None:
    own = concept(modes=2)
    names = [f"{mode}component {number}" for mode in ("", "mode 1, ", "mode 2, ") for number in (1, 2)]
    assert list(own.parts()) == names
    part = own.parts()["mode 2, component 1"]
    assert part.weight == pytest.approx(float(own.modes.weights[1, 0]))
    assert torch.equal(part.embedding, own.modes.embeddings[1, 0, 0])
    assert (part.component, part.mode, part.knot) == (1, 2, None)
    assert list(replace(own, modes=None).parts()) == names[:2]
