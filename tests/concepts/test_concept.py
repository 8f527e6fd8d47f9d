"""A learned concept's file: form 1 without modes, form 2 with them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from ftl_lightning.concepts.concept import AXES, KIND, Concept, Origin
from ftl_lightning.concepts.modes import Modes
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import save_tensors
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
    assert header("c.safetensors")["format"] == 2
    assert header("c.safetensors")["axes"] == "mode component n"
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


def test_a_concept_without_modes_is_written_in_the_first_form_and_has_no_modes_when_read() -> None:
    concept(modes=0).save("c.safetensors")
    assert header("c.safetensors")["format"] == 1
    assert not {"axes", "mixed"} & header("c.safetensors").keys()
    assert Concept.load("c.safetensors").modes is None
    assert Concept.load("c.safetensors").composition.modes is None


def written(form: int, without: str = "", **changes: object) -> str:
    """A file whose header differs from that of a concept with modes."""
    own = concept()
    tensors = {"embeddings": own.embeddings[:, 0], "weights": own.weights}
    tensors |= {"mode_embeddings": own.modes.embeddings[:, :, 0], "mode_weights": own.modes.weights}
    told = {**ORIGIN.__dict__, "axes": AXES[2], "mixed": False, **changes}
    kept = {name: tensor for name, tensor in tensors.items() if name != without}
    save_tensors("c.safetensors", KIND, kept, {key: value for key, value in told.items() if key != without}, form)
    return "c.safetensors"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            {"form": 2, "axes": "mode time component n"},
            "key 'axes': expected 'mode component n', found 'mode time component n'; a newer version may read it",
        ),
        ({"form": 5}, "key 'format': expected 1 or 2 or 3 or 4, found 5; it is of another version"),
        ({"form": 2, "without": "axes"}, "expected the keys of a concept, found none of axes"),
        ({"form": 2, "without": "mode_weights"}, "expected the keys of a concept, found none of mode_weights"),
        ({"form": 1, "without": "embeddings"}, "expected the keys of a concept, found none of embeddings"),
    ],
    ids=str,
)
def test_a_form_that_cannot_be_read_is_told_in_one_line(path: dict[str, object], message: str) -> None:
    with pytest.raises(UserError) as told:
        Concept.load(written(**path))  # type: ignore[arg-type]
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
