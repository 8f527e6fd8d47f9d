"""What a model says of demonstrations before, and after, it learns from some of them."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.leave_one_out import LeaveOneOut, find_outlier, leave_one_out, relative_losses, subsets
from ftl_lightning.reporting.concept_figures import check_figure
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.checks import Known, scale_findings, warnings_of
from tests.conftest import CONF, ROOT, refused, succeed

KNOWN, NEW = "circle right of square", "square diagonal to triangle"
STROKES = ROOT / "pretrained" / "strokes"
"""A model that ships: of what else people draw than squares and hearts."""


@pytest.fixture(scope="module")
def scenes() -> FewShot:
    return FewShot.from_pretrained("object_rearrangement")


@pytest.fixture(scope="module")
def five(scenes: FewShot) -> Demonstrations:
    return scenes.domain.source(None).draw(KNOWN, 5, 3)


def test_a_known_concept_is_recognised_and_a_new_one_is_not_and_a_picture_is_drawn(scenes: FewShot, five: Demonstrations) -> None:
    found = scenes.check(five)
    assert found.warnings == ()
    assert (found.known.text, found.known.clear) == (KNOWN, True)
    assert "no learning is needed" in str(found)
    other = scenes.check(scenes.domain.source(None).draw(NEW, 5, 0), name=NEW).known
    assert not other.clear
    assert str(other).startswith("known: no training concept fits them all")
    assert len(check_figure([found]).axes) == 2


def test_the_empty_concept_explains_as_much_as_itself(scenes: FewShot, five: Demonstrations) -> None:
    empty = 0 * scenes[KNOWN]
    together = replace(empty, embeddings=empty.embeddings[None], weights=empty.weights[None])
    assert torch.allclose(relative_losses(scenes.model, five, together, scenes.tuned.inversion), torch.ones(1, 5))


@pytest.mark.slow
def test_other_units_are_outside_of_what_pretraining_saw(scenes: FewShot, five: Demonstrations) -> None:
    (good,) = scale_findings(scenes.model, five)
    assert (good.severity, good.text[:29]) == ("note", "scale: 0 % of the states are ")
    larger = replace(five, states=100 * five.states)
    found = [str(one) for one in scale_findings(scenes.model, larger) if one.severity == "warning"]
    assert re.match(r"scale: \d+ % of the states are outside .*, most in .* times the range\)", found[0])
    with pytest.warns(UserWarning, match="outside of the range seen in pretraining"):
        scenes.learn(larger, steps=1)


@pytest.mark.slow
def test_learning_warns_of_faults_and_of_nothing_else(scenes: FewShot, five: Demonstrations) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenes.learn(five, steps=1)
    twice = five.rows([0, 1, 2, 3, 3])
    assert warnings_of(scenes.model, twice) == ("demonstrations 4 and 5: are the same",)
    with pytest.warns(UserWarning, match="demonstrations 4 and 5: are the same"):
        scenes.learn(twice, steps=1)


def test_missing_numbers_and_several_concepts_in_one_check_are_told_in_python(scenes: FewShot, five: Demonstrations) -> None:
    states = five.states.numpy().copy()
    states[1, 0, 4] = np.nan
    (error,) = [one for one in scenes.check(states).findings if one.severity == "error"]
    assert error.rows == (1,)
    with pytest.raises(UserError, match="expected finite numbers"):
        scenes.learn(states)
    with pytest.raises(UserError, match="expected demonstrations of one concept"):
        scenes.check(concatenate([five, replace(five, concepts=(NEW,) * 5)]))


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_subsets_hold_each_demonstration_equally_often(count: int) -> None:
    found = subsets(count)
    for size in {len(rows) for rows in found}:
        rows = [row for own in found if len(own) == size for row in own]
        assert {rows.count(row) for row in range(count)} == {size}
    assert {len(rows) for rows in found} == {size for size in (1, 2, 3, count - 1) if size < count}
    assert len(set(found)) == len(found) or count == 2


def test_the_odd_one_is_far_above_all_others() -> None:
    assert find_outlier(torch.tensor([0.5, 0.4, 1.9, 0.6])) == 2
    assert find_outlier(torch.tensor([0.5, 0.4, 0.7, 0.6])) is None
    assert find_outlier(torch.tensor([1.0, 0.9, 1.1, 1.7])) is None
    assert find_outlier(torch.tensor([0.2, 0.9, 0.2])) is None  # it is still explained better than by nothing
    assert find_outlier(torch.tensor([0.2, 2.0])) is None


def test_words_follow_the_numbers() -> None:
    suffice = LeaveOneOut((0.4, 0.5, 0.96), (0.3, 0.3, 0.4), {1: 0.7, 2: 0.69}, None, 0.1)
    assert (suffice.covered, suffice.falling) == (2, False)
    told = " ".join(suffice.lines())
    assert "explains 2 of 3, not demonstration 3" in told
    assert "these suffice" in told
    more = LeaveOneOut((0.4, 0.5, 1.9), (0.3, 0.3, 0.4), {1: 0.9, 2: 0.7}, 2, 0.02)
    assert more.falling
    assert suffice.lines()[-1].startswith("distance: where it is learned from them, they have 3.3 times")
    assert more.far  # without the outlier
    assert more.lines()[-1].startswith("far: where it is learned from them, they have 15.0 times")
    assert "outlier: demonstration 3, loss 1.90" in " ".join(more.lines())
    assert "more are likely to help" in " ".join(more.lines())
    assert "look at samples" in LeaveOneOut((1.0, 1.1, 1.0), (0.8, 0.8, 0.8), {1: 1.05, 2: 1.03}, None, 0.2).lines()[-2]
    assert not Known("a", (0.9, 0.9, 1.2, 0.9)).clear


@pytest.mark.slow
def test_a_stroke_of_another_kind_is_odd() -> None:
    model = FewShot.from_pretrained(STROKES)
    good = model.demonstrations(strokes("square", 5, 77))
    assert warnings_of(model.model, good) == ()
    mixed = model.demonstrations(np.concatenate([strokes("square", 4, 77), strokes("heart", 1, 77)]))
    found = leave_one_out(model.model, mixed, model.tuned.inversion, 60)
    assert found.left_out[4] == max(found.left_out)
    assert found.left_out[4] > 1.5 * sorted(found.left_out)[-2]
    fine = leave_one_out(model.model, good, model.tuned.inversion, 60)
    assert fine.outlier is None
    assert sum(fine.left_out) / 5 < 1
    assert not fine.far


@pytest.mark.slow
def test_the_verb_checks_learns_and_draws(capsys: pytest.CaptureFixture[str]) -> None:
    frozen = strokes("heart", 3, 1)
    frozen[1] = frozen[1, :1]
    np.savez("six.npz", states=np.concatenate([strokes("square", 3, 1), frozen]), concepts=np.repeat(["square", "heart"], 3))
    Path("few.yaml").write_text("defaults: [conf/own.yaml]\ndata: {init_args: {steps: 5}}\n")
    succeed("check", "six.npz")
    told = capsys.readouterr().out
    assert "square: 3 demonstrations of 40 steps, 2 columns\n  no faults" in told
    assert "  warning: demonstration 2: nothing moves" in told
    succeed("check", "six.npz", f"--pretrained={STROKES}", "--learn=true", "--settings=few.yaml", "--figure=six.png")
    told = capsys.readouterr().out
    assert max(len(part.splitlines()) for part in told.split("heart: ")) <= 12
    assert told.count("left out: ") == 2
    assert Path("six.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_invert_notes_faults_of_a_file_of_ones_own(tiny: Path, five: Demonstrations, capsys: pytest.CaptureFixture[str]) -> None:
    five.rows([0, 1, 2, 2]).save("four.safetensors")
    invert = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), f"--model.pretrained={tiny}", "--model.form=paper"]
    invert += ["--data.demonstrations=four.safetensors", "--data.steps=2", "--evaluation.samples=1", "--evaluation.steps=2"]
    succeed(*invert, "--evaluation.figures=0", "--trainer.accelerator=cpu")
    assert "note: four.safetensors: demonstrations 3 and 4: are the same" in capsys.readouterr().err


def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("five.npz", states=strokes("heart", 5, 1))
    refused(capsys, ["check", "none.npz"], "none.npz")
    refused(capsys, ["check", "five.npz", "--learn=true"], "learn: expected --pretrained MODEL")
    refused(capsys, ["check", "five.npz", "--pretrained=object_rearrangement"], "five.npz: ", "21 columns")
    refused(capsys, ["check", "five.npz", "--figure=five.txt"], "figure: expected a name that ends in .png")
    load_domain("agent").source(None).draw("go to bowl", 1, 0).save("drives.safetensors")
    reads = ["check", "drives.safetensors", "--pretrained=baseline/in_context/agent"]
    refused(capsys, reads, "model.pretrained: expected a model that concepts are learned through")
