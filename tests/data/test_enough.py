"""Whether a few demonstrations suffice, and which of them is an outlier, by energy scores."""

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.enough import HIGH, Enough, Outliers
from tests.conftest import succeed


def drawn(kind: str, count: int, seed: int = 0, text: str = "") -> Demonstrations:
    return Demonstrations.of(list(strokes(kind, count, seed)), text or kind)


def to_place(count: int, seed: int, share: float, text: str) -> Demonstrations:
    """Paths from a start to a share of the way to a place."""
    draw = np.random.default_rng(seed)
    place = draw.uniform(-1, 1, (count, 2))
    times = np.linspace(0, 1, 12)[None, :, None]
    paths = share * place[:, None] * times + 0.02 * draw.standard_normal((count, 12, 2)).cumsum(axis=1)
    return Demonstrations.of(list(paths), text, observed={"place": torch.from_numpy(place).float()})


@pytest.fixture(scope="module")
def training() -> Demonstrations:
    return concatenate([drawn(kind, 10, 7) for kind in TRAINING])


def test_an_exchanged_demonstration_is_named_at_any_place_and_a_good_set_is_not_blamed(training: Demonstrations) -> None:
    score = Outliers(training, training.states.shape[1])
    for seed in range(4):
        good = drawn("heart", 5, seed)
        assert score.outlier(good) is None
        other = drawn(("S-curve", TRAINING[seed])[seed % 2], 1, seed, "heart")
        rows = [good.rows([row]) for row in range(5)]
        rows[seed] = other
        assert score.outlier(concatenate(rows)) == seed
    assert score.outlier(good.rows([0, 1])) is None  # two do not show which is the outlier
    single = Outliers(drawn("circle", 10), training.states.shape[1])
    assert single.outlier(good) is None  # nothing to compare with


def test_what_goes_to_another_share_of_the_way_to_a_place_is_odd() -> None:
    known = concatenate([to_place(8, number, share, f"{share}") for number, share in enumerate((-0.5, 0.2, 1.0, 1.4))])
    score = Outliers(known, 12)
    assert dict(score.setting.places)
    good = to_place(5, 20, 0.6, "new")
    assert score.outlier(good) is None
    assert score.outlier(concatenate([good.rows(range(4)), to_place(1, 21, -0.5, "new")])) == 4


def test_a_skill_is_rounded_down_and_demonstrations_that_are_all_faulty_have_none(training: Demonstrations) -> None:
    assert "0.85 from 4" in str(Enough("warped demonstrations", {3: 0.8, 4: 0.8599}, None, None))
    five = drawn("heart", 5)
    assert Enough.of(five, five.states.shape[1], training, without=range(5)) is None


def test_five_alike_suffice_and_few_that_differ_in_kind_do_not(training: Demonstrations) -> None:
    horizon = training.states.shape[1]
    for known in (training, None):
        hearts = Enough.of(drawn("heart", 6, 3), horizon, known)
        assert hearts is not None
        assert hearts.suffices
        assert hearts.last >= HIGH
        assert str(hearts).endswith("(Gaussian of demonstrations, without learning): these suffice")
        mixed = Enough.of(concatenate([drawn(kind, 1, 0, "any") for kind in TRAINING[:5]]), horizon, known)  # five kinds
        assert mixed is not None
        assert not mixed.suffices
        if known is not None:
            assert str(mixed).endswith("no: they differ from each other as much as demonstrations of different training concepts")
    assert Enough.of(drawn("heart", 2), horizon, training) is None
    wide = Demonstrations.of(list(np.random.default_rng(0).normal(size=(5, 300, 100))), "wide")
    assert Enough.of(wide, 300) is None  # too large to measure in seconds


def test_places_that_are_not_yet_followed_are_not_enough_unless_a_learned_form_is_better() -> None:
    known = concatenate([to_place(8, number, share, f"{share}") for number, share in enumerate((-0.5, 0.2, 1.0, 1.4))])
    few = to_place(3, 20, 0.6, "new")
    alone = Enough.of(few, 12, known)
    assert alone is not None
    assert not alone.suffices
    assert "asked for" in str(alone)
    many = Enough.of(to_place(12, 21, 0.6, "new"), 12, known)
    assert many is not None
    assert many.suffices
    assert alone.more is None or 0 < alone.more <= 47


def test_a_better_learned_form_suffices_only_where_its_skill_is_high_and_that_of_references_rises_no_more() -> None:
    flat = {2: 0.5, 3: 0.7, 4: 0.71}
    with pytest.MonkeyPatch.context() as patch:
        for skills, skill, suffices in ((flat, 0.8, True), (flat, 0.55, False), ({2: 0.4, 3: 0.5, 4: 0.7}, 0.8, False)):
            patch.setattr("ftl_lightning.data.enough._skills", lambda *_, skills=skills: ({"warped demonstrations": skills}, 0.5))
            found = Enough.of(drawn("heart", 5), 40, None, ("combination", skill))
            assert found is not None
            assert found.suffices == suffices
            assert ("combination has skill 0.80" in str(found)) == suffices


def test_check_says_whether_they_suffice_without_the_odd_one(capsys: pytest.CaptureFixture[str]) -> None:
    def checked(file: str) -> str:
        succeed("check", file)
        return capsys.readouterr().out

    good = drawn("heart", 6, 1)
    good.save("good.npz")
    out = checked("good.npz")
    assert "these suffice" in out
    states = good.states.clone()
    states[2] = torch.from_numpy(strokes("square", 1, 3)[0])
    Demonstrations.of(list(states.numpy()), "heart").save("outlier.npz")
    out = checked("outlier.npz")
    assert "demonstration 3: moves otherwise than the others" in out
    assert "enough: without demonstration 3, " in out
    good.rows([0, 1]).save("two.npz")
    assert "enough" not in checked("two.npz")
    broken = states.numpy().copy()
    broken[0, 3, 0] = np.nan
    np.savez("broken.npz", states=broken, concepts="heart")
    assert "enough" not in checked("broken.npz")


@pytest.mark.slow
def test_a_model_of_own_data_names_the_odd_one_and_judges_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    states = drawn("heart", 5, 1).states.numpy().copy()
    states[2] = strokes("S-curve", 1, 3)[0]
    Demonstrations.of(list(states), "heart").save("outlier.npz")
    succeed("check", "outlier.npz", "--pretrained", "strokes")
    out = capsys.readouterr().out
    assert "warning: demonstration 3: differs from the others more than is usual within a concept; another concept?" in out
    assert "enough: without demonstration 3, " in out
