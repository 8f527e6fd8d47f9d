"""``invert MODEL FILE``: what ``invert --config`` learns, without a trainer."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ftl_lightning import Demonstrations, FewShot
from ftl_lightning.data.demonstrations import concatenate
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from tests.conftest import CONF, refused, succeed
from tests.tiny import QUIET

GOALS = ("square diagonal to triangle", "circle right of square and square above triangle")


@pytest.fixture
def model(tiny_of: Callable[[str], Path]) -> Path:
    """Folder of a model of scenes."""
    return tiny_of("object_rearrangement")


@pytest.fixture
def file() -> Path:
    """Five demonstrations of each of two relations."""
    source = FewShot.from_pretrained("object_rearrangement").domain.source(None)
    concatenate([source.draw(goal, 5, 0) for goal in GOALS]).save("two.npz")
    return Path("two.npz")


@pytest.mark.slow
def test_it_writes_and_prints_what_the_trainer_does(model: Path, file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    options = ["--data.steps=5", "--model.form=paper", "--seed_everything=3", "--evaluation.samples=1", "--evaluation.steps=2"]
    options += ["--evaluation.figures=0", "--evaluation.diversity=false", *QUIET]
    trained = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", f"--model.pretrained={model}"]
    succeed(*trained, f"--data.demonstrations={file}", "--model.output=trained", *options)
    by_trainer = capfd.readouterr().out.splitlines()
    succeed("invert", str(model), str(file), "--steps=5", "--form=paper", "--seed=3", "--out=own")
    without = capfd.readouterr()
    names = sorted(path.name for path in Path("own").iterdir())
    assert len(names) == len(GOALS)
    for name in names:
        assert (Path("own") / name).read_bytes() == (Path("trained") / name).read_bytes()
    printed = without.out.splitlines()
    assert [line.partition(":")[0] for line in printed[1::2]] == ["  quality"] * len(GOALS)
    assert {line.replace("own/", "trained/") for line in printed} <= {*by_trainer}
    assert "learning 2 concepts: 5 steps" in without.err


@pytest.mark.parametrize(
    ("options", "form"), [pytest.param([], "form chosen", marks=pytest.mark.slow), (["--model.form=paper"], "")]
)
def test_rows_name_the_form_that_was_learned(model: Path, file: Path, options: list[str], form: str) -> None:
    quick = ["--data.steps=2", "--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0"]
    quick += ["--evaluation.diversity=false", "--evaluation.results=rows.csv", *QUIET, *options]
    trained = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", f"--model.pretrained={model}"]
    succeed(*trained, f"--data.demonstrations={file}", *quick)
    assert set(read_rows(Path("rows.csv"))["form"]) == {form}


def test_faults_of_demonstrations_are_noted(model: Path, capfd: pytest.CaptureFixture[str]) -> None:
    source = FewShot.from_pretrained("object_rearrangement").domain.source(None)
    source.draw(GOALS[0], 5, 0).rows([0, 0, 0, 1]).save("copied.npz")
    succeed("invert", str(model), "copied.npz", "--steps=1", "--form=paper")
    assert "note: " in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nowhere", "two.npz"], "nowhere/config.json: expected a pretrained model"),
        (["object_rearrangement"], "demonstrations"),
        (["object_rearrangement", "no.npz"], "no.npz: expected a demonstrations file, found nothing"),
        (["agent", "two.npz"], "two.npz: states: expected behaviour of agent"),
        (["object_rearrangement", "two.npz", "--form=round"], "model.form: expected one of paper, auto"),
        (["baseline/cvae/object_rearrangement", "two.npz", "--form=warped demonstrations"], "model.form: expected paper, one set"),
        (["object_rearrangement", "two.npz", "--steps=-1"], "steps: expected 0 or more, found -1"),
        (["object_rearrangement", "two.npz", "--out=two.npz"], "out: two.npz"),
        (["object_rearrangement", "two.npz", "--trainer.max_steps=3"], "trainer.max_steps"),
    ],
)
def test_mistakes_are_one_line(file: Path, arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, ["invert", *arguments], expected)


def test_in_python_several_concepts_are_learned_together(file: Path) -> None:
    learner, two = FewShot.from_pretrained("object_rearrangement"), Demonstrations.load(file)
    learned = learner.learn_all(two, steps=2, form="paper")
    assert list(learned) == list(GOALS)
    for goal, concept in learned.items():
        alone = learner.learn(two.select(goal), name=goal, steps=2, form="paper")
        torch.testing.assert_close(concept.embeddings, alone.embeddings, rtol=1e-4, atol=1e-5)
        assert concept.demonstrations is not None
        assert set(concept.demonstrations.concepts) == {goal}
    with pytest.raises(UserError, match="learn_all: expected Demonstrations"):
        learner.learn_all(two.states)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="demonstrations: expected a text for each"):
        learner.learn_all(replace(two, concepts=("",) * len(two)))
    with pytest.raises(UserError, match="learn_all: "):
        learner.learn_all(two, iterations=3)
