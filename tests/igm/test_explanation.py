import shutil
from pathlib import Path

import pytest
import torch

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.explanation import explain
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.training.model_folder import load_model
from tests.conftest import ROOT, refused, succeed

NAMES = ("a", "b", "c", "d")


def test_a_combination_is_found_again() -> None:
    training = torch.randn(4, 10, generator=torch.Generator().manual_seed(0))
    found = explain(0.5 * training[2] + 2 * training[0], NAMES, training)
    assert [name for name, _ in found.combination] == ["a", "c"]
    assert [weight for _, weight in found.combination] == pytest.approx([2.0, 0.5], abs=1e-5)
    assert found.explained == pytest.approx(1.0, abs=1e-6)
    assert found.nearest[0][0] == "a"
    assert len(found.nearest) == 3


def test_what_points_the_other_way_is_not_explained() -> None:
    training = torch.eye(4, 6)
    found = explain(torch.tensor([-1.0, 0, 0, 0, 2.0, 0]), NAMES, training)
    assert found.combination == ()
    assert found.explained == pytest.approx(0.0)
    assert dict(explain(3 * training[1], NAMES, training, 4).nearest) == pytest.approx({"a": 0, "b": 1, "c": 0, "d": 0})
    half = explain(torch.tensor([1.0, 0, 0, 0, 1.0, 0]), NAMES, training)
    assert half.explained == pytest.approx(0.5)


def test_of_equivalent_weights_the_smallest_are_taken() -> None:
    training = torch.randn(4, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    training -= training.mean(dim=0)  # now a constant may be added to all weights
    found = explain(1002 * training[0] + 1000.5 * training[2] + 1000 * (training[1] + training[3]), NAMES, training)
    assert [name for name, _ in found.combination] == ["a", "c"]
    assert [weight for _, weight in found.combination] == pytest.approx([2.0, 0.5], abs=1e-4)
    minus = explain(-training[1], NAMES, training)  # the sum of the others
    assert dict(minus.combination) == pytest.approx({"a": 1, "c": 1, "d": 1}, abs=1e-5)
    assert minus.explained == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("domain", ["object_rearrangement", "agent", "driving"])
def test_learned_concepts_are_combinations_with_small_weights_that_explain_as_much_as_any(domain: str) -> None:
    model = load_model(ROOT / "pretrained" / domain)
    names, training = model.config.training_concepts, model.training_embeddings
    basis = torch.linalg.svd(training.double(), full_matrices=False).Vh[: len(training) - 1]
    files = (ROOT / "results" / "concepts" / domain).rglob("*.safetensors")
    embeddings = [row for path in files for row in Concept.load(path).embeddings[:, 0]]
    assert embeddings
    for embedding in embeddings:
        found = explain(embedding, names, training)
        assert 0 < len(found.combination) < len(names)
        assert max(weight for _, weight in found.combination) < 5
        # The training concepts' mean is the origin: with non-negative weights they reach their whole span.
        own = embedding.double()
        assert found.explained == pytest.approx(float((basis @ own).square().sum() / own.square().sum()), abs=1e-4)
    for name, embedding in zip(names, training, strict=True):
        assert explain(embedding, names, training).combination == ((name, pytest.approx(1, abs=1e-4)),)


def test_the_verb_finds_the_model_and_says_what_a_concept_is_made_of(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = load_domain("object_rearrangement").source(None).draw("square diagonal to triangle", 5, 0)
    (concept,) = invert(model := load_model(tiny), scenes, InversionSettings().changed(samples=2), 2).values()
    concept.save("c.safetensors")
    explain = ["explain", "--concept", "c.safetensors"]
    expected = f"expected the model with the hash {model.hash} below pretrained, logs"
    refused(capsys, explain, expected)
    Path("logs/some").mkdir(parents=True)
    Path("logs/some/config.json").write_text("{}")  # the configuration of something else does not matter
    Path("logs/model").symlink_to(tiny)
    refused(capsys, explain, expected)  # links are not followed
    shutil.copytree(tiny, "pretrained")
    succeed(*explain, "--nearest", "2")
    out = capsys.readouterr().out
    assert out.count("nearest: ") == 3  # two components and their sum
    assert "component 2, weight 1.20: nearest: " in out
    assert "explains 0." in out
    refused(capsys, [*explain, f"--pretrained={ROOT}/pretrained/agent"], "key 'domain': expected 'agent' (the pretrained model's)")
