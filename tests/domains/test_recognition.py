"""Behaviour is recognised by its examples: real behaviour is, whatever is not like it is not."""

import zlib
from collections.abc import Callable

import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.from_file import METRICS
from ftl_lightning.domains.recognition import Recognition
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT

Array = NDArray[np.float64]
UNITS = np.array([1e-3, 1.0, 250.0, 1e4])
TIME = 40
KINDS, NEW = 8, 3
"""The first eight kinds are for pretraining, the other three are new."""


def rng(*key: object) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


def paths(kind: int, count: int, seed: int) -> Array:
    """Smooth ways in the plane, no two of the same size, place and pace, from a hand that trembles: ``(count, 40, 2)``."""
    waves = rng("way", kind).normal(size=(4, 2)) * np.array([[0.4], [1.0], [1.0], [0.4]])  # no kind is nearly a straight line
    waves /= np.linalg.norm(waves)
    draw = rng("paths", kind, seed)
    even = np.linspace(0, 1, TIME)
    pace = even + draw.uniform(-0.1, 0.1, (count, 1)) * np.sin(np.pi * even)
    size = draw.uniform(1, 1.6, (count, 1, 1))
    place = draw.uniform(-1, 1, (count, 1, 2))
    way = np.cos(np.pi * np.arange(1, 5) * pace[..., None]) @ waves
    return size * way + place + draw.normal(0, 0.01, (count, TIME, 2))


def states(kind: int, count: int, seed: int) -> Array:
    """Single states of 64 columns, blots on a grid that are never at quite the same places: ``(count, 1, 64)``."""
    centres = rng("blots", kind).uniform(1, 6, (3, 2))
    draw = rng("states", kind, seed)
    moved = centres + draw.normal(0, 0.25, (count, 3, 2))
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2)
    apart = ((moved[:, :, None] - grid) ** 2).sum(axis=-1)
    ink = draw.uniform(0.8, 1.2, (count, 1)) * np.exp(-apart / 3).sum(axis=1) + draw.normal(0, 0.02, (count, 64))
    return 16 * ink[:, None]


def series(kind: int, count: int, seed: int) -> Array:
    """Measurements of four columns on scales from 1e-3 to 1e4: ``(count, 40, 4)``."""
    own = rng("series", kind)
    mixed, pitch, fades, onset = own.normal(size=(3, 4)), own.uniform(4, 16), own.uniform(0.5, 4), own.uniform(0.1, 0.6)
    draw = rng("measured", kind, seed)
    even = np.linspace(0, 1, TIME) - draw.uniform(-0.015, 0.015, (count, 1))
    parts = (np.exp(-fades * even) * np.sin(pitch * even), 1 - np.exp(-6 * np.clip(even - onset, 0, None)), even**2)
    found = draw.uniform(0.8, 1.25, (count, 1, 1)) * np.stack(parts, axis=-1) @ mixed + draw.normal(0, 0.01, (count, TIME, 4))
    return found * UNITS + 10 * UNITS


FAMILIES = {"paths": paths, "states": states, "series": series}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("states", "series")]


def known(behaviour: dict[str, Array], lengths: NDArray[np.int64] | None = None) -> Demonstrations:
    values = torch.from_numpy(np.concatenate(list(behaviour.values()))).float()
    texts = tuple(name for name, some in behaviour.items() for _ in some)
    count, time, columns = values.shape
    ends = torch.full((count,), time) if lengths is None else torch.from_numpy(lengths)
    return Demonstrations(values, ends, "", tuple(f"c{index}" for index in range(columns)), ("",) * columns, texts)


def rates(examples: Demonstrations, behaviour: dict[str, Array], share: float = 0.98) -> list[float]:
    """Share of plans that are recognised, of each goal."""
    metric = METRICS["recognised"](examples, next(iter(behaviour.values())).shape[1], share)
    found = [metric.measure(goal, torch.from_numpy(plans).float(), None) for goal, plans in behaviour.items()]
    assert [(one.dtype, one.shape) for one in found] == [(torch.bool, (len(plans),)) for plans in behaviour.values()]
    return [float(one.float().mean()) for one in found]


def accepted(examples: Demonstrations, goal: str, plans: Array) -> float:
    return rates(examples, {goal: plans})[0]


def jagged(real: Array, times: float = 3.0) -> Array:
    """With white noise, so that the root mean square second difference of each column is as many times that of real ones."""
    bends = (np.diff(real, 2, axis=1) ** 2).mean(axis=(0, 1))
    return real + rng("jagged").normal(size=real.shape) * np.sqrt((times**2 - 1) * bends / 6)


def frozen_after(real: Array, step: int) -> Array:
    return np.concatenate((real[:, :step], np.repeat(real[:, step : step + 1], real.shape[1] - step, axis=1)), axis=1)


def shuffled(real: Array) -> Array:
    draw = rng("shuffled")
    return np.stack([one[draw.permutation(len(one))] for one in real])


def straight(real: Array) -> Array:
    even = np.linspace(0, 1, real.shape[1])[:, None]
    return real[:, :1] * (1 - even) + real[:, -1:] * even


def smaller(real: Array) -> Array:
    middle = real.mean(axis=1, keepdims=True)
    return middle + 0.4 * (real - middle)


def drawn(name: str, seed: int) -> Demonstrations:
    """Examples of each kind of a family."""
    return known({str(kind): FAMILIES[name](kind, 10 if kind < KINDS else 5, seed) for kind in range(KINDS + NEW)})


@pytest.fixture(scope="module", params=["paths", *SLOW])
def family(request: pytest.FixtureRequest) -> tuple[str, Demonstrations, dict[str, Array]]:
    """Its name, examples, and fresh behaviour of each kind."""
    name = request.param
    return name, drawn(name, 0), {str(kind): FAMILIES[name](kind, 40, 1000) for kind in range(KINDS + NEW)}


@pytest.mark.slow
def test_real_behaviour_is_recognised_and_that_of_other_kinds_is_not(
    family: tuple[str, Demonstrations, dict[str, Array]],
) -> None:
    # Five examples may happen to be alike, so several draws of them.
    name, examples, fresh = family
    found = np.mean([rates(some, fresh) for some in (examples, *(drawn(name, seed) for seed in range(1, 4)))], axis=0)
    assert np.mean(found[:KINDS]) >= 0.95
    assert np.mean(found[KINDS:]) >= 0.93
    assert min(found) >= 0.85
    copies = {goal: examples.select(goal).states.double().numpy() for goal in dict.fromkeys(examples.concepts)}
    assert np.mean(rates(examples, copies)) >= 0.98
    goals = list(fresh)
    assert np.mean(rates(examples, {goal: fresh[goals[index - 1]] for index, goal in enumerate(goals)})) <= 0.02
    never_seen = FAMILIES[name]  # nor is what is of no kind with examples
    assert np.mean(rates(examples, {goal: never_seen(100 + index, 40, 1000) for index, goal in enumerate(goals)})) <= 0.05


@pytest.mark.parametrize("family", ["paths", SLOW[1]], indirect=True)  # single states have no time
@pytest.mark.parametrize(
    "change",
    [jagged, shuffled, straight, smaller, lambda real: frozen_after(real, 0), lambda real: frozen_after(real, real.shape[1] // 3)],
    ids=["jagged", "shuffled", "straight", "smaller", "frozen", "frozen after a third"],
)
def test_what_real_behaviour_never_does_is_not_recognised(
    family: tuple[str, Demonstrations, dict[str, Array]], change: Callable[[Array], Array]
) -> None:
    _, examples, fresh = family
    assert np.mean(rates(examples, {goal: change(real) for goal, real in fresh.items()})) <= 0.05


def test_single_states_that_are_mixed_up_or_faint_and_a_jump_in_one_small_column_beside_large_ones_are_not_recognised() -> None:
    examples = known({str(kind): states(kind, 10, 0) for kind in range(6)})
    fresh = states(2, 40, 1)
    assert accepted(examples, "2", fresh) >= 0.9
    assert accepted(examples, "2", fresh[..., rng("mixed").permutation(64)]) == 0
    assert accepted(examples, "2", 0.4 * fresh) == 0
    examples = known({str(kind): series(kind, 10, 0) for kind in range(4)})
    fresh = series(1, 40, 1)
    broken = fresh.copy()
    broken[:, ::2, 0] += UNITS[0]
    assert accepted(examples, "1", fresh) >= 0.9
    assert accepted(examples, "1", broken) == 0


@pytest.mark.slow
def test_pace_and_length_do_not_matter() -> None:
    draw = rng("lengths")

    def some(kind: int, count: int, seed: int) -> tuple[Array, NDArray[np.int64]]:
        """Ways that take 25 to 40 steps and then stay where they are."""
        ways, lengths = paths(kind, count, seed), draw.integers(25, TIME + 1, count)
        for way, length in zip(ways, lengths, strict=True):
            times = np.linspace(0, TIME - 1, length)
            way[:length] = np.stack([np.interp(times, np.arange(TIME), column) for column in way.T], axis=-1)
            way[length:] = way[length - 1]
        return ways, lengths

    drawn = {str(kind): some(kind, 10 if kind < 4 else 5, 0) for kind in range(5)}
    examples = known({kind: ways for kind, (ways, _) in drawn.items()}, np.concatenate([ends for _, ends in drawn.values()]))
    fresh = {str(kind): some(kind, 20, 1)[0] for kind in range(5)}
    assert np.mean(rates(examples, fresh)) >= 0.93
    assert np.mean(rates(examples, {goal: jagged(real) for goal, real in fresh.items()})) <= 0.05
    assert np.mean(rates(examples, {goal: frozen_after(real, 8) for goal, real in fresh.items()})) <= 0.05
    away = {goal: real.copy() for goal, real in fresh.items()}
    for real in away.values():  # behaviour that goes on elsewhere after its end
        real[:, 25:] = real[:, 24:25] + 5 * np.linspace(0, 1, 15)[:, None]
    assert np.mean(rates(examples, away)) <= 0.05


@pytest.mark.parametrize("count", [1, 2])
def test_a_concept_of_one_or_two_examples_is_judged(count: int) -> None:
    examples = known({str(kind): paths(kind, 10 if kind < KINDS else count, 0) for kind in range(KINDS + NEW)})
    fresh = {str(kind): paths(kind, 40, 1) for kind in range(KINDS + NEW)}
    found = rates(examples, fresh)
    assert np.mean(found[:KINDS]) >= 0.93
    assert np.mean(found[KINDS:]) >= 0.8
    assert np.mean(rates(examples, {goal: jagged(real) for goal, real in fresh.items()})) <= 0.05
    # Where all have but a single one, nothing is known of how real behaviour varies: the likeliest decides, and jags.
    single = known({str(kind): paths(kind, 1, 0) for kind in range(4)})
    assert np.mean([accepted(single, str(kind), paths(kind, 40, 1)) for kind in range(4)]) > 0.8
    assert np.mean([accepted(single, str(kind), paths((kind + 1) % 4, 40, 1)) for kind in range(4)]) < 0.2
    assert np.mean([accepted(single, str(kind), jagged(paths(kind, 40, 1), 4)) for kind in range(4)]) < 0.05


def test_columns_that_never_change_do_not_matter() -> None:
    def beside(kind: int, count: int, seed: int) -> Array:
        ways = paths(kind, count, seed)
        return np.concatenate((ways, np.full((*ways.shape[:2], 1), 7.0), np.zeros((*ways.shape[:2], 1))), axis=-1)

    examples = known({str(kind): beside(kind, 10, 0) for kind in range(4)})
    assert accepted(examples, "1", beside(1, 40, 1)) >= 0.9
    assert accepted(examples, "1", beside(2, 40, 1)) == 0
    still = known({"low": np.zeros((3, 12, 2)), "high": np.ones((3, 12, 2))})  # and no behaviour varies
    assert accepted(still, "low", np.zeros((2, 12, 2))) == 1
    assert accepted(still, "high", np.zeros((2, 12, 2))) == 0


def test_more_is_accepted_the_greater_the_share_and_plans_that_are_not_finite_are_not() -> None:
    examples = known({str(kind): paths(kind, 20, 0) for kind in range(5)})
    fresh = {str(kind): paths(kind, 40, 1) for kind in range(5)}
    found = [np.mean(rates(examples, fresh, share)) for share in (0.5, 0.8, 0.98)]
    assert 0.4 < found[0] < found[1] < found[2]
    assert found[0] < 0.85  # limits are wider than the share says, as five concepts say little about others
    assert found[2] > 0.95
    for number in (0, -1, 1.5):
        with pytest.raises(UserError, match=r"data\.metrics\.recognised: expected a share .* above 0, at most 1, found"):
            METRICS["recognised"](examples, TIME, number)
    examples = known({str(kind): paths(kind, 5, 0) for kind in range(3)})
    plans = paths(1, 3, 0)
    plans[0, 4, 1], plans[1, 0, 0] = np.nan, np.inf
    found = METRICS["recognised"](examples, TIME, 1).measure("1", torch.from_numpy(plans).float(), None)
    assert found.tolist() == [False, False, True]
    settings = yaml.safe_load((ROOT / "conf" / "own.yaml").read_text("utf-8"))
    assert settings["fit"]["data"]["init_args"]["metrics"] == {"recognised": 0.98}


def test_the_acceptance_of_fresh_behaviour_is_estimated_from_the_examples() -> None:
    for count, share in ((10, 0.98), (10, 0.6), (3, 0.98)):
        draw = np.random.default_rng(count)
        known, fresh = (
            {name: draw.normal(size=(some, 1, 4)) @ np.diag((1, 1, 0.3, 0.3)) + 2 * number for number, name in enumerate("abcdef")}
            for some in (count, 200)
        )
        states = torch.from_numpy(np.concatenate(list(known.values()))).float()
        texts = tuple(name for name, some in known.items() for _ in some)
        examples = Demonstrations(states, torch.ones(len(states), dtype=torch.int64), "", tuple("wxyz"), ("",) * 4, texts)
        recognition = Recognition(examples, 1, share)
        accepted = np.mean([recognition.recognised(name, torch.from_numpy(some)).float().mean() for name, some in fresh.items()])
        assert recognition.acceptance(count) == pytest.approx(accepted, abs=0.15)
