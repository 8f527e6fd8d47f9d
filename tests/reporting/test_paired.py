from collections.abc import Mapping

import pandas as pd
import pytest

from ftl_lightning.domains.comparison import Compared
from ftl_lightning.reporting.paired import Lead, episodes, holm, leads, least_certain, sign_flip


def measured(**methods: list[list[float]]) -> pd.DataFrame:
    """Values by method, task and seed."""
    return pd.DataFrame(
        {"method": method, "form": "", "task": f"task {task}", "seed": seed, "value": value}
        for method, tasks in methods.items()
        for task, seeds in enumerate(tasks)
        for seed, value in enumerate(seeds)
    )


def one(learned: Mapping[str, str] | None = None, **methods: list[list[float]]) -> Lead:
    (found,) = leads(measured(**methods), Compared("ours"), [Compared("BC")], learned or {})
    return found


def test_p_is_the_share_of_sign_patterns_that_are_as_far_from_zero() -> None:
    assert sign_flip([0.1]) == 1.0  # one pair says nothing
    assert sign_flip([0.1, 0.2, 0.3]) == 2 / 8  # all agree: this pattern and its mirror
    # |+-1 +-2 +-3| is at least 4 for +++, -++ and their mirrors: four of eight.
    assert sign_flip([-0.1, 0.2, 0.3]) == 4 / 8
    assert sign_flip([0.3, 0.2, -0.1]) == sign_flip([-0.3, -0.2, 0.1])


def test_ties_count_as_far_whatever_floats_make_of_them_and_zeros_have_no_sign_to_flip() -> None:
    # 0.1 + 0.2 - 0.3 is not zero in floats; every pattern of a sum of zero is as far.
    assert sign_flip([0.1, 0.2, -0.3]) == 1.0
    assert sign_flip([0.7, -0.1]) == sign_flip([0.8 - 0.1, 0.6 - 0.7]) == 1.0
    assert sign_flip([0.1 / 3] * 3 + [-0.1]) == 1.0
    assert sign_flip([0.0] * 9) == 1.0
    assert sign_flip([]) == 1.0
    assert sign_flip([0.1, 0.2, 0.3, *[0.0] * 50]) == sign_flip([0.1, 0.2, 0.3])
    assert sign_flip([1e-6] * 30) == 1.0  # six digits are written


def test_many_differences_are_flipped_at_random_the_same_way_each_time() -> None:
    assert sign_flip([0.1] * 30) == 1 / 10_001
    mixed = [0.1] * 18 + [-0.1] * 12
    # Of 30 fair coins at least 18 are alike in 0.3616 of all cases (binomial, both sides).
    assert sign_flip(mixed) == pytest.approx(0.3616, abs=0.015)
    assert sign_flip(mixed) == sign_flip(mixed)


def test_holms_correction_multiplies_the_smallest_most_and_keeps_the_order() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_seeds_of_a_task_decide_nothing() -> None:
    found = one(ours=[[0.9, 0.8, 0.9]], BC=[[0.1, 0.2, 0.1]])
    assert found.p is None
    assert str(found) == "+0.73 against BC, undecided (1 task)"
    five = one(ours=[[0.6, 0.7, 0.8]] * 5, BC=[[0.5] * 3] * 5)
    assert five.p is None  # 2 of 32 at best
    assert five.units == "5 tasks"


def test_the_signs_of_whole_tasks_are_flipped() -> None:
    # One baseline, six tasks: 2 of 64. Three seeds of each, all alike, are not 18 independent pairs.
    assert one(ours=[[0.6] * 3] * 6, BC=[[0.5] * 3] * 6).p == 2 / 64
    # A seventh task against the others: seven of eight patterns with one sign differ are nearer, 2 + 2 * 7 are as far.
    assert one(ours=[[0.6]] * 6 + [[0.4]], BC=[[0.5]] * 7).p == 16 / 128


def test_tasks_that_share_a_learned_concept_are_one_unit() -> None:
    apart = [0.1, 0.2, 0.3, 0.2, 0.1, 0.1, 0.2, 0.2]
    methods = {"ours": [[0.5 + more] for more in apart], "BC": [[0.5]] * 8}
    assert one(**methods).p == 2 / 2**8
    shared = one({f"task {task}": f"concept {task // 2}" for task in range(8)}, **methods)
    assert (shared.p, shared.units, shared.difference) == (None, "4 learned concepts", one(**methods).difference)


def test_the_interval_is_students_over_tasks() -> None:
    # Differences .1, .1, .3, .3: mean .2, standard error .0577, and 3.182 of them with three degrees of freedom.
    low, high = 0.2 - 3.182 * 0.05774, 0.2 + 3.182 * 0.05774
    assert one(ours=[[0.6], [0.6], [0.8], [0.8]], BC=[[0.5]] * 4).interval == pytest.approx((low, high), abs=1e-4)
    assert one(ours=[[0.6]] * 3, BC=[[0.5]] * 3).interval is None


def test_more_baselines_need_more_pairs() -> None:
    rows = measured(ours=[[0.6]] * 7, BC=[[0.5]] * 7, CVAE=[[0.4]] * 7, language=[[0.3]] * 7)
    assert [lead.p for lead in leads(rows, Compared("ours"), [*map(Compared, ["BC", "CVAE"])], {})] == [4 / 128] * 2
    assert [lead.p for lead in leads(rows, Compared("ours"), [*map(Compared, ["BC", "CVAE", "language"])], {})] == [6 / 128] * 3
    wide = pd.concat((rows, rows[rows["method"] == "BC"].assign(method="fourth")))
    assert [lead.p for lead in leads(wide, Compared("ours"), [*map(Compared, ["BC", "CVAE", "language", "fourth"])], {})] == [
        None
    ] * 4


def test_tasks_weigh_alike_however_many_seeds_each_has_and_only_pairs_that_both_have_are_compared() -> None:
    found = one(ours=[[0.9], [0.5, 0.5, 0.5]], BC=[[0.5], [0.4, 0.4, 0.4]])
    assert found.difference == pytest.approx((0.4 + 0.1) / 2)
    rows = measured(ours=[[0.9, 0.7]], BC=[[0.5]])
    (found,) = leads(rows, Compared("ours"), [*map(Compared, ["BC", "not measured"])], {})
    assert found.difference == pytest.approx(0.4)
    assert leads(rows, Compared("not measured"), [Compared("BC")], {}) == []
    assert least_certain([]) is None


def test_the_verdict_is_in_words() -> None:
    assert str(one(ours=[[0.6]] * 6, BC=[[0.5]] * 6)) == "+0.10 [+0.10, +0.10] against BC, ahead (p = .032)"
    assert str(one(ours=[[0.5]] * 6, BC=[[0.6]] * 6)) == "-0.10 [-0.10, -0.10] against BC, behind (p = .032)"
    assert (
        str(one(ours=[[0.6]] * 3 + [[0.5]] * 3, BC=[[0.5]] * 6)) == "+0.05 [-0.01, +0.11] against BC, no difference shown (p = .25)"
    )
    assert str(one(ours=[[0.6]] * 11, BC=[[0.5]] * 11)) == "+0.10 [+0.10, +0.10] against BC, ahead (p < .001)"
    assert str(one(ours=[[0.5]] * 6, BC=[[0.5]] * 6)) == "+0.00 against BC, the same in every task and seed"
    assert str(one(ours=[[0.5]], BC=[[0.5]])) == "+0.00 against BC, the same in every task and seed"
    (fewer,) = leads(measured(ours=[[0.1]] * 6, BC=[[0.2]] * 6), Compared("ours"), [Compared("BC")], {}, less=True)
    assert str(fewer) == "+0.10 [+0.10, +0.10] against BC, ahead (p = .032)"  # of crashes fewer are better


def test_nothing_is_ahead_by_the_last_digit_of_a_float() -> None:
    assert str(one(ours=[[0.333333]] * 8, BC=[[0.333334]] * 8)) == "+0.00 against BC, the same in every task and seed"
    assert Lead(Compared("BC"), 0.1, "30 tasks", 0.0499999).verdict == "no difference shown"  # it is shown as .050
    assert str(Lead(Compared("BC"), 0.004, "30 tasks", 0.01)) == "+0.004 against BC, ahead (p = .010)"
    assert str(Lead(Compared("BC"), -0.0004, "30 tasks", 1.0)) == "+0.000 against BC, no difference shown (p = 1)"


def test_ahead_is_ahead_of_every_baseline_and_behind_is_behind_one() -> None:
    ahead, near = Lead(Compared("BC"), 0.3, "15 tasks", 0.001), Lead(Compared("CVAE"), 0.2, "15 tasks", 0.001)
    noisy, better = Lead(Compared("in-context"), 0.4, "15 tasks", 0.2), Lead(Compared("language"), -0.1, "15 tasks", 0.01)
    assert least_certain([ahead, near]) == near  # the best baseline
    assert least_certain([ahead, noisy, near]) == noisy
    assert least_certain([ahead, noisy, better]) == better


def test_paired_episodes_tell_interval_p_and_how_many_are_the_same() -> None:
    # McNemar's exact test of 8 against 2: 2 * (1 + 10 + 45) / 2^10 = .1094; the interval is of (6 +- 1.96 sqrt(11 - 36 / 52)) / 52.
    assert episodes(8, 2, 50) == "+0.12 [-0.01, +0.24], p = .11, same outcome in 40 of 50"
    assert episodes(0, 0, 50) == "+0.00 [-0.04, +0.04], p = 1, same outcome in 50 of 50"
    assert episodes(20, 0, 50).endswith("p < .001, same outcome in 30 of 50")
