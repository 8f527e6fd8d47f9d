from dataclasses import replace

import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import Feature
from ftl_lightning.services.errors import UserError
from tests.data.samples import demonstrations


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"states": torch.zeros(0, 1, 2)},
            r"at least one demonstration, time and column, found none in \(0, 1, 2\)",
        ),
        ({"states": torch.full((1, 1, 2), float("nan"))}, r"key 'states': expected finite numbers, found nan at index \[0, 0, 0\]"),
        ({"states": torch.zeros(1, 2)}, r"expected float32 of shape \(demo, time, state\)"),
        ({"lengths": torch.tensor([3])}, "key 'lengths': expected 1 values between 1 and 1"),
        ({"concepts": ("a", "b")}, "key 'concepts': expected 1 entries, found 2"),
        ({"observed": {"place": torch.zeros(2, 3)}}, r"key 'observed/place': expected shape \(1, ...\), found \(2, 3\)"),
        ({"observed": {"place": torch.zeros(1)}}, r"key 'observed/place': expected shape \(1, ...\), found \(1,\)"),
        (
            {"observed": {"place": torch.zeros(1, 3)}, "per_step": ("place",)},
            r"key 'observed/place': expected shape \(1, 1, ...\), found \(1, 3\)",
        ),
        ({"observed": {"place": torch.full((1, 3), float("inf"))}}, "key 'observed/place': expected finite numbers, found inf"),
        ({"per_step": ("place",)}, "key 'per_step': expected names of observed features, found place"),
        ({"scenes": torch.zeros(2, 3)}, r"key 'scenes': expected shape \(1, scene\), found \(2, 3\)"),
        ({"scenes": torch.full((1, 3), float("nan"))}, "key 'scenes': expected finite numbers, found nan"),
    ],
)
def test_content_is_checked(changes: dict[str, object], message: str) -> None:
    states = changes.get("states", torch.zeros(1, 1, 2))
    base = {"state_names": ("a", "b"), "state_units": ("", ""), "lengths": torch.ones(1, dtype=torch.int64), "concepts": ("a",)}
    with pytest.raises(UserError, match=message):
        Demonstrations(**({"states": states, "domain": ""} | base | changes))  # type: ignore[arg-type]


def test_selection_naming_and_concatenation() -> None:
    both = demonstrations(torch.arange(8.0).reshape(4, 1, 2))
    one, other = both.select("task 0"), both.select("task 1")
    assert torch.equal(one.states, both.states[[0, 2]])
    joined = concatenate([one, other])
    assert joined.concepts == ("task 0", "task 0", "task 1", "task 1")
    assert demonstrations(torch.zeros(2, 1, 1), concepts=("", "x")).named("mine").concepts == ("mine", "x")


def test_windows_are_padded_with_the_last_state_and_start_at_the_beginning_where_only_that_is_observed() -> None:
    states = torch.arange(10.0).reshape(2, 5, 1)
    whole = replace(demonstrations(states), lengths=torch.tensor([5, 3]), observed={"place": states + 100}, per_step=("place",))
    assert whole.starts(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 0.9999, 0.5, 0.9]), 3.0, 4).tolist() == [0, 4, 0, 2]
    found, seen = whole.windows(torch.tensor([0, 1]), torch.tensor([3, 0]), 4)
    assert found[..., 0].tolist() == [[3, 4, 4, 4], [5, 6, 7, 8]]
    assert seen["place"][:, 0].tolist() == [103, 105]
    observed = {"first": torch.eye(2), "always": torch.zeros(2, 5, 1)}  # of the former, only the beginning is known
    whole = demonstrations(torch.zeros(2, 5, 1), lengths=torch.tensor([5, 3]), observed=observed, per_step=("always",))
    assert whole.starts(torch.tensor([0, 1]), torch.tensor([0.1, 0.9]), 3.0, 2).tolist() == [0, 0]
    assert torch.equal(whole.windows(torch.tensor([1]), torch.tensor([0]), 2)[1]["first"], torch.eye(2)[1:])


def test_where_nothing_is_observed_windows_stay_within_a_behaviour_and_one_as_long_starts_at_0() -> None:
    whole = demonstrations(torch.zeros(3, 9, 1), lengths=torch.tensor([9, 6, 2]))
    share = torch.rand(2000, generator=torch.Generator().manual_seed(0))
    rows = torch.arange(2000) % 3
    for exponent in (1.0, 3.0):
        for horizon in (1, 4, 6, 9, 20):
            starts = whole.starts(rows, share, exponent, horizon)
            for row, length in enumerate(whole.lengths.tolist()):
                latest = max(length - horizon, 0)
                found = starts[rows == row]
                assert found.min() == 0
                assert found.max() == latest  # all that fit are reached, and none goes over the end
    assert whole.starts(rows, share, 1.0, 9).max() == 0
    even = whole.starts(torch.zeros(2000, dtype=torch.int64), share, 1.0, 6).bincount()
    assert even.shape == (4,)
    assert even.min() > 400  # spread evenly over the four places


def test_a_feature_is_per_step_because_the_file_says_so_not_because_of_its_shape() -> None:
    # As many columns as times: the shape alone would not tell.
    states, square = torch.zeros(2, 4, 1), torch.arange(2 * 4 * 3.0).reshape(2, 4, 3)
    once = demonstrations(states, observed={"map": square})
    always = demonstrations(states, observed={"map": square}, per_step=("map",))
    assert once.features["map"].shape == (4, 3)
    assert always.features["map"].shape == (3,)
    assert torch.equal(once.initial_states.observed["map"], square)
    assert torch.equal(always.initial_states.observed["map"], square[:, 0])
    ending = demonstrations(states, observed={"map": square}, per_step=("map",), lengths=torch.tensor([4, 2]))
    assert torch.equal(ending.final_states.observed["map"], torch.stack((square[0, 3], square[1, 1])))
    assert torch.equal(once.final_states.observed["map"], square), "what is observed once"
    rows, starts = torch.tensor([1]), torch.tensor([2])
    assert torch.equal(once.windows(rows, starts, 2)[1]["map"], square[1:])
    assert torch.equal(always.windows(rows, starts, 2)[1]["map"], square[1:, 2])


def test_selecting_and_joining_keep_what_is_observed_and_scenes() -> None:
    def part(count: int, time: int, offset: float) -> Demonstrations:
        always = offset + torch.arange(count * time * 2.0).reshape(count, time, 2)
        return demonstrations(
            torch.full((count, time, 1), offset),
            observed={"always": always, "once": torch.full((count, 3), offset)},
            per_step=("always",),
            scenes=torch.full((count, 2), offset),
        )

    joined = concatenate([part(1, 2, 0.0), part(2, 4, 10.0)])
    assert joined.states.shape == (3, 4, 1)
    assert joined.lengths.tolist() == [2, 4, 4]
    assert joined.observed["always"][0].tolist() == [[0, 1], [2, 3], [2, 3], [2, 3]]  # padded with its last
    assert joined.observed["once"][:, 0].tolist() == [0, 10, 10]
    assert joined.scenes is not None
    assert joined.scenes[:, 0].tolist() == [0, 10, 10]
    one = joined.select("task 1")
    assert len(one) == 1
    assert one.observed["always"][0, 0].tolist() == [18, 19]
    assert one.scenes is not None
    assert one.scenes.tolist() == [[10, 10]]


def test_what_only_some_know_at_every_time_is_joined_at_the_first() -> None:
    values = torch.arange(6.0).reshape(1, 2, 3)
    always = demonstrations(torch.zeros(1, 2, 1), observed={"a": values}, per_step=("a",), scenes=torch.zeros(1, 2))
    once = demonstrations(torch.zeros(1, 4, 1), observed={"a": values[:, 1]})
    for parts in ([always, once], [once, always]):
        joined = concatenate(parts)
        assert joined.per_step == ()
        assert sorted(joined.observed["a"].tolist()) == [[0, 1, 2], [3, 4, 5]]
        assert joined.scenes is None


def test_the_hash_is_of_what_is_observed_and_scenes_too() -> None:
    states = torch.zeros(2, 3, 1)
    plain = demonstrations(states)
    seen = demonstrations(states, observed={"place": torch.zeros(2, 3)})
    observed = {"spot": torch.zeros(2, 3)}, {"place": torch.ones(2, 3)}
    others = [plain, seen, *(demonstrations(states, observed=one) for one in observed)]
    others += [demonstrations(states, scenes=torch.zeros(2, 3))]
    assert len({one.hash for one in others}) == 5
    assert replace(seen, concepts=("x", "y"), provenance={"seed": 1}).hash == seen.hash


def test_features_that_a_domain_does_not_find_are_told() -> None:
    seen = demonstrations(torch.zeros(2, 3, 1), observed={"place": torch.zeros(2, 3)})
    assert seen.fitted({"place": Feature((3,))}) is seen
    assert seen.fitted({}) is seen
    for name, feature, expected in (
        ("place", Feature((4,)), r"observed/place': expected float32 of shape \(4,\) each, found float32 of shape \(3,\)"),
        ("photo", Feature((3, 8, 8), "image"), r"observed/photo': expected uint8 images of shape \(3, 8, 8\) each, found none"),
        (
            "place",
            Feature((3,), "image"),
            r"observed/place': expected uint8 images of shape \(3,\) each, found float32 of shape \(3,\)",
        ),
    ):
        with pytest.raises(UserError, match=f"key '{expected}"):
            seen.fitted({name: feature})
    with pytest.raises(UserError, match="key 'observed/place': expected float32, or uint8 for images, found float64"):
        demonstrations(torch.zeros(2, 3, 1), observed={"place": torch.zeros(2, 3, dtype=torch.float64)})
