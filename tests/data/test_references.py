"""Places, frames and references that need no learning."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.places import Frames, first_windows, places, starts
from ftl_lightning.data.references import GAUSSIAN, NAMES, NEAREST, SHIFTED, WARPED, Reference, Setting
from ftl_lightning.services.errors import UserError

TIME = 30


def reaches(kind: str, count: int, seed: int) -> Demonstrations:
    """Paths from a start to a place: an object, a goal or the middle of both; beside them a column of time."""
    rng = np.random.default_rng(seed)
    start, thing, goal = (rng.uniform(-1, 1, (count, 2)) for _ in range(3))
    end = {"thing": thing, "goal": goal, "middle": (thing + goal) / 2}[kind]
    share = (np.linspace(0, 1, TIME) ** 2)[None, :, None]
    bow = 0.1 * rng.normal(size=(count, 1, 1)) * np.sin(np.pi * np.linspace(0, 1, TIME))[None, :, None]
    path = start[:, None] * (1 - share) + end[:, None] * share + bow
    clock = np.linspace(0, 1, TIME)[None, :, None].repeat(count, axis=0)
    observed = {"start": start, "thing": thing, "goal": goal, "colour": rng.uniform(0, 1, (count, 2))}
    features = {name: torch.tensor(values, dtype=torch.float32) for name, values in observed.items()}
    return Demonstrations.of(list(np.concatenate((path, clock), axis=2)), kind, observed=features)


@pytest.fixture(scope="module")
def training() -> Demonstrations:
    return concatenate([reaches("thing", 20, 1), reaches("goal", 20, 2)])


def test_places_and_starts_are_found_with_their_columns_and_nothing_else(training: Demonstrations) -> None:
    assert starts(training) == {"start": (0, 1)}
    assert places(training, TIME) == {"start": (0, 1), "thing": (0, 1), "goal": (0, 1)}


def test_a_feature_of_another_unit_is_no_place(training: Demonstrations) -> None:
    moved = replace(training, observed={**training.observed, "thing": 100 * training.observed["thing"]})
    assert "thing" not in places(moved, TIME)


def test_frames_say_what_a_path_follows_when(training: Demonstrations) -> None:
    few = reaches("middle", 5, 3)
    frames = Frames.fit(first_windows(few, TIME), few.initial_states.observed, places(training, TIME))
    start, thing, goal = (frames.shares[list(frames.places).index(name)] for name in ("start", "thing", "goal"))
    assert start[0] == pytest.approx(1, abs=0.05)
    assert (float(thing[-1]), float(goal[-1])) == pytest.approx((0.5, 0.5), abs=0.05)
    assert float(start[-1]) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("name", NAMES)
def test_references_go_where_a_new_situation_asks(training: Demonstrations, name: str) -> None:
    fresh, few = reaches("middle", 50, 4), reaches("middle", 5, 3)
    observed = fresh.initial_states.observed
    samples = Reference.of(name, few, Setting.of(training, TIME), TIME).sample(observed, 50, torch.Generator().manual_seed(0))
    middle = (observed["thing"] + observed["goal"]) / 2
    right = ((samples[:, -1, :2] - middle).norm(dim=1) < 0.15).float().mean()
    assert float(right) < 0.3 if name == NEAREST else float(right) > 0.9
    if name != NEAREST:
        assert torch.equal(samples[:, 0, :2], observed["start"])


def test_without_observations_warped_demonstrations_vary_and_a_gaussian_has_the_mean_and_spread() -> None:
    few = replace(reaches("goal", 6, 5), observed={}, per_step=())
    setting = Setting.of(concatenate([replace(reaches(kind, 20, 1), observed={}) for kind in ("thing", "goal")]), TIME)
    paths = first_windows(few, TIME)

    def drawn(name: str) -> Tensor:
        return Reference.of(name, few, setting, TIME).sample({}, 2000, torch.Generator().manual_seed(0))

    torch.testing.assert_close(drawn(GAUSSIAN).mean(dim=0), paths.mean(dim=0), atol=0.05, rtol=0)
    torch.testing.assert_close(drawn(GAUSSIAN).std(dim=0), paths.std(dim=0), atol=0.05, rtol=0)
    assert float(torch.cdist(drawn(WARPED)[:20].flatten(1), paths.flatten(1)).min()) > 0.05
    assert torch.equal(drawn(SHIFTED)[:6], paths)


def test_a_reference_comes_back_from_its_file_and_what_does_not_fit_is_refused(training: Demonstrations) -> None:
    few = reaches("middle", 5, 3)
    reference = Reference.of(WARPED, few, Setting.of(training, TIME), TIME)
    again = Reference.from_file(reference.tensors(), reference.header)
    observed = reaches("middle", 7, 4).initial_states.observed
    first, second = (each.sample(observed, 7, torch.Generator().manual_seed(1)) for each in (reference, again))
    assert torch.equal(first, second)
    for change in ({"paths": torch.zeros(5, 3)}, {"place": torch.zeros(9)}, {"observed/thing": torch.zeros(2, 2)}):
        with pytest.raises(UserError, match="reference"):
            Reference.from_file({**reference.tensors(), **change}, reference.header)
    with pytest.raises(UserError, match="reference"):
        Reference.from_file(reference.tensors(), {**reference.header, "places": {"thing": (0, 9)}})
    with pytest.raises(UserError, match="form: expected one of"):
        Reference.from_file(reference.tensors(), {**reference.header, "name": "a program"})


def test_large_offsets_are_kept(training: Demonstrations) -> None:
    few = reaches("middle", 5, 3)
    far = replace(few, states=few.states.double() + torch.tensor([5e6, 4e5, 0.0], dtype=torch.float64), observed={}, per_step=())
    whole = replace(training, states=training.states.double() + 5e6, observed={}, per_step=())
    for name in NAMES:
        samples = Reference.of(name, far, Setting.of(whole, TIME), TIME).sample({}, 10, torch.Generator().manual_seed(0))
        assert samples.dtype == torch.float64
        moved = samples[:, -1] - samples[:, 0]
        steps = (samples[:, 1:, :2] - samples[:, :-1, :2]).norm(dim=2)
        assert float(moved.norm(dim=1).min()) > 0.1
        assert float(steps[steps > 0].min()) < 0.1  # float32 has steps of half a metre there
