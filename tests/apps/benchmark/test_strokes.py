import re
from pathlib import Path

import numpy as np
import pytest

from ftl_lightning.apps.benchmark.strokes import (
    BACKWARDS,
    KNOWN,
    MIRRORED,
    NEW,
    RANDOM,
    STEPS,
    TEST,
    TRAINING,
    VALIDATION,
    Judge,
    drawn,
    recognised,
    strokes,
)
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.quality import Quality

CARD = Path(__file__).parents[3] / "pretrained" / "strokes" / "README.md"


@pytest.fixture(scope="module")
def judge() -> Judge:
    return Judge.of()


@pytest.fixture(scope="module")
def model() -> FewShot:
    return FewShot.from_pretrained("strokes")


def test_no_new_kind_is_one_of_pretraining_and_the_card_names_the_model_that_ships(model: FewShot) -> None:
    every = (*KNOWN, *VALIDATION, *TEST)
    assert len(set(every)) == len(every)
    plain = {text.removeprefix(MIRRORED).removeprefix(BACKWARDS) for text in model.training_concepts}
    assert plain == {*KNOWN, RANDOM}
    assert re.findall("hash `([0-9a-f]{16})`", CARD.read_text(encoding="utf-8")) == [model.model.hash]
    assert set(model.domain.plans.columns) == {"x", "y"}


@pytest.mark.parametrize("kind", [*TRAINING, *NEW])
def test_precise_strokes_are_recognised_and_differ_from_each_other(kind: str) -> None:
    found = strokes(kind, 200, seed=7)
    assert found.shape == (200, STEPS, 2)
    assert found.dtype == np.float32
    assert recognised(found).count(kind) >= 196
    assert found.std(axis=0).min() > 0.5  # of every point, in centimetres
    assert np.array_equal(found, strokes(kind, 200, seed=7))
    assert not np.array_equal(found, strokes(kind, 200, seed=8))


def test_place_and_size_do_not_matter_for_what_a_stroke_is_and_noise_is_none() -> None:
    found = strokes("heart", 20, seed=3)
    assert recognised(3 * found + 50) == recognised(found)
    noise = np.random.default_rng(0).normal(size=(200, STEPS, 2)).astype(np.float32)
    assert max(map(recognised(noise).count, [*TRAINING, *NEW])) < 0.3 * 200  # noise is no kind rather than another


@pytest.mark.parametrize("kind", [*KNOWN, *VALIDATION, *TEST])
def test_fresh_strokes_are_recognised_and_differ_from_each_other(judge: Judge, kind: str) -> None:
    found = drawn(kind, 100, seed=7)
    assert found.shape == (100, STEPS, 2)
    assert found.dtype == np.float32
    assert judge.rate(found, kind) >= 0.97
    assert np.array_equal(found, drawn(kind, 100, seed=7))
    assert not np.array_equal(found, drawn(kind, 100, seed=8))


def test_one_hand_draws_alike_and_mirrored_and_backwards_strokes_are_not_taken_for_the_kind_itself(judge: Judge) -> None:
    many, one = drawn("heart", 100, 0), drawn("heart", 100, 0, alike=0.8)
    assert one.std(axis=0).mean() < 0.5 * many.std(axis=0).mean()
    assert judge.rate(drawn(MIRRORED + "letter L", 50, 0), "letter L") == 0
    back, forth = drawn(BACKWARDS + "letter L", 200, 0).mean(axis=0), drawn("letter L", 200, 0).mean(axis=0)
    assert np.abs(back[::-1] - forth).max() < 0.5 < np.abs(back - forth).max()


def test_noise_is_no_kind_rather_than_another(judge: Judge) -> None:
    noise = np.random.default_rng(0).normal(size=(200, STEPS, 2)).astype(np.float32)
    found = judge.kind(noise)
    assert max(map(found.count, judge.kinds)) < 0.3 * len(found)
    assert judge.distance(noise, "circle") > 3 * judge.distance(drawn("circle", 50, 1), "circle")


@pytest.mark.slow
def test_a_new_kind_is_learned_from_five_strokes_in_a_hundred_steps(model: FewShot, judge: Judge) -> None:
    five = drawn("heart", 5, seed=11, alike=0.6)
    before = model.sample(model["circle"] * 0.0, 40).states.numpy()
    concept = model.learn(five, name="heart", form="paper", steps=100, samples=16, learning_rate=0.3)
    after = model.sample(concept, 40)
    assert judge.rate(before, "heart") <= 0.1
    assert judge.rate(after.states.numpy(), "heart") >= 0.9
    look = Quality.of(after.states, model.demonstrations(five).states)
    assert look.spread > 0.4
    assert look.novelty > 0.3  # no copies
    assert look.roughness < 1.2
