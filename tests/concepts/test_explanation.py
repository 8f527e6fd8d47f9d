from pathlib import Path

import pytest
import torch

from ftl_lightning.cli import main
from ftl_lightning.concepts.explanation import explain
from ftl_lightning.learning.pretrained import load_model
from tests.conftest import CONF, ROOT

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


def test_the_verb_finds_the_model_and_says_what_a_concept_is_made_of(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [f"--model.pretrained={tiny}", "--data.suite=validation", "--data.steps=2", "--evaluation.samples=2"]
    options += ["--evaluation.steps=2", "--model.output=concepts", "--trainer.enable_progress_bar=false"]
    assert main(["invert", "--config", str(CONF / "invert" / "object_rearrangement.yaml"), *options]) == 0
    concept = str(next(Path("concepts").iterdir()))
    capsys.readouterr()
    assert main(["explain", "--concept", concept]) == 2
    assert f"expected the model with the hash {load_model(tiny).hash} below pretrained, logs" in capsys.readouterr().err
    Path("logs/some").mkdir(parents=True)
    Path("logs/some/config.json").write_text("{}")  # the configuration of something else does not matter
    Path("logs/model").symlink_to(tiny)
    assert main(["explain", "--concept", concept, "--nearest", "2"]) == 2  # links are not followed
    Path("pretrained").mkdir()
    for name in ("config.json", "model.safetensors"):
        (Path("pretrained") / name).write_bytes((tiny / name).read_bytes())
    capsys.readouterr()
    assert main(["explain", "--concept", concept, "--nearest", "2"]) == 0
    out = capsys.readouterr().out
    assert out.count("nearest: ") == 3  # two components and their sum
    assert "component 2, weight 1.20: nearest: " in out
    assert "explains 0." in out
    assert main(["explain", "--concept", concept, "--pretrained", str(ROOT / "pretrained" / "agent")]) == 2
    assert "key 'domain': expected 'agent' (the pretrained model's)" in capsys.readouterr().err
