"""Faults of demonstrations: none in good ones, and each that is put in is found."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import NEW, TRAINING, strokes
from ftl_lightning.data.check import axes, check, mended, read_mended
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.registry import load_domain
from tests.conftest import ROOT, succeed


def demonstrations(states: np.ndarray | torch.Tensor, name: str = "heart") -> Demonstrations:
    """States ``(demo, time, state)`` as demonstrations."""
    found = torch.as_tensor(states).float()
    count, time, columns = found.shape
    names = tuple(map(str, range(columns)))
    return Demonstrations(found, torch.full((count,), time), "", names, ("",) * columns, (name,) * count)


def faults(found: Demonstrations) -> list[str]:
    """What is worse than a note."""
    return [str(one) for one in check(found) if one.severity != "note"]


@pytest.mark.parametrize("kind", [*TRAINING, *NEW])
def test_good_strokes_have_no_faults(kind: str) -> None:
    for count in (1, 3, 5, 10):
        assert faults(demonstrations(strokes(kind, count, 0))) == [], count


@pytest.mark.parametrize(("domain", "tasks"), [
    ("agent", ("go to bowl", "go to red cube")),
    ("object_rearrangement", ("circle right of square", "square diagonal to triangle")),
])  # fmt: skip
def test_good_demonstrations_of_domains_have_no_faults(domain: str, tasks: tuple[str, ...]) -> None:
    for seed, task in enumerate(tasks):
        assert faults(load_domain(domain).source(None).draw(task, 5, seed)) == [], task


def test_good_driving_has_no_faults() -> None:
    files = sorted((ROOT / "ftl_lightning/domains/driving/demonstrations").glob("*.safetensors"))
    assert files
    for path in files:
        assert faults(Demonstrations.load(path).rows(list(range(5)))) == [], path.stem


def test_noise_and_random_walks_have_no_faults() -> None:
    draw = np.random.default_rng(0)
    walks = draw.normal(size=(5, 50, 4)).cumsum(1)
    for states in (draw.normal(size=(5, 20, 8)), draw.normal(size=(5, 1, 8)), walks):
        assert faults(demonstrations(states)) == []


FAULTS: dict[str, tuple[Callable[[torch.Tensor], object], str]] = {
    "jump": (lambda states: states[20:].add_(4), "jumps after step 19"),
    "blip": (lambda states: states[20].add_(5), "jumps after step"),
    "frozen": (lambda states: states.copy_(states[0].clone()), "nothing moves in its 40 steps"),
    "half frozen": (
        lambda states: states[12:].copy_(states[12].clone()),
        "stands still from step 12 on, 27 of 39 steps; if it is padding",
    ),
    "units": (lambda states: states.mul_(100), "other units?"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_where_it_is(name: str) -> None:
    damage, told = FAULTS[name]
    for kind, count in itertools.product(("square", "spiral"), (3, 5, 10)):
        good = demonstrations(strokes(kind, count, 2))
        states = good.states.clone()
        damage(states[1])
        found = faults(replace(good, states=states))
        assert len(found) == 1
        assert found[0].startswith("demonstration 2: ")
        assert told in found[0]


@pytest.mark.parametrize("tremble", [0.0, 0.001])
def test_duplicates_are_found_and_their_observations_count(tremble: float) -> None:
    good = demonstrations(strokes("heart", 5, 0))
    states = good.states.clone()
    states[3] = states[0] + tremble * torch.randn(40, 2, generator=torch.Generator().manual_seed(0))
    twice = replace(good, states=states)
    (found,) = check(twice)
    assert found.rows == (0, 3)
    assert str(found).startswith("demonstrations 1 and 4: are " + ("nearly the same" if tremble else "the same"))
    elsewhere = replace(twice, observed={"start": torch.arange(5.0)[:, None]})
    assert check(elsewhere) == ()


def test_a_stroke_of_another_kind_is_found_by_its_shape() -> None:
    mixed = concatenate([demonstrations(strokes("line", 4, 0)), demonstrations(strokes("circle", 1, 0))])
    (found,) = faults(mixed)
    assert found.startswith("demonstration 5: moves otherwise than the others")


def test_a_length_far_from_the_others_and_columns_or_behaviour_that_never_change_are_told() -> None:
    good = demonstrations(np.concatenate([strokes("wave", 5, 0), np.ones((5, 40, 1))], axis=2))
    (note,) = check(good)
    assert (note.severity, str(note)) == ("note", "1 of 3 columns never changes (2)")
    short = replace(good, lengths=torch.tensor([40, 40, 9, 40, 40]))
    assert "demonstration 3: has 9 steps, the others 40 to 40" in faults(short)
    placed = torch.randn(5, 1, 3, generator=torch.Generator().manual_seed(0))
    assert faults(demonstrations(placed.expand(5, 40, 3))) == ["nothing moves in any of them"]
    assert faults(demonstrations(placed.expand(5, 2, 3))) == []  # behaviour has hardly any steps


def test_angles_that_wrap_are_noted() -> None:
    angle = (np.linspace(0, 12, 60) + np.linspace(0, 2, 5)[:, None]) % (2 * np.pi)
    found = check(demonstrations(np.stack((angle, np.random.default_rng(0).normal(size=(5, 60)).cumsum(1)), axis=-1)))
    assert any(one.severity == "note" and "angle with a turn of 6.28319" in one.text for one in found)


def test_what_is_missing_is_told_and_mended_by_straight_lines() -> None:
    states = torch.arange(12.0).reshape(1, 6, 2).repeat(2, 1, 1)
    states[1, 2:4, 0] = torch.nan
    states[1, 5, 1] = torch.inf
    whole, (found,) = mended(states, torch.tensor([6, 6]))
    assert (found.severity, found.rows) == ("error", (1,))
    assert "3 of 6 time steps are not finite (the first is 2), in 2 columns" in found.text
    assert torch.equal(whole[1, :, 0], states[0, :, 0])
    assert whole[1, 5, 1] == states[1, 4, 1]
    padding = states[:, :6].clone()
    padding[1, :, :] = states[0]
    padding[1, 5] = torch.nan
    assert "padding is not finite" in mended(padding, torch.tensor([6, 5]))[1][0].text
    assert mended(states[:1], torch.tensor([6]))[1] == ()


def test_a_file_with_missing_numbers_is_read_to_say_so() -> None:
    states = strokes("heart", 5, 1)
    states[2, 7] = np.nan
    np.savez("five.npz", states=states)
    found, (told,) = read_mended("five.npz")
    assert found.concepts == ("five",) * 5
    assert told.rows == (2,)


X, T = np.linspace(0, 2 * np.pi, 50), np.arange(30.0)[:, None]
PHASE = np.random.default_rng(0).uniform(0, 6, (8, 1, 1))
WAVES = {
    "travelling": np.sin(X - T + PHASE),
    "back": np.sin(X + 2 * T + PHASE),
    "the same": np.sin(X - T)[None] + np.random.default_rng(1).normal(0, 0.05, (5, 30, 50)),
    "short": np.sin(X - T[:5] + PHASE),
    "standing": np.sin(X) * np.cos(1.5 * T + PHASE),
    "two": np.sin(X - T + PHASE) + 0.5 * np.sin(2 * X - 2.7 * T + PHASE),
    "pulse": np.exp(-(((np.arange(50) - 5 * T[:9] - PHASE) / 2) ** 2)),
}


@pytest.mark.parametrize("name", WAVES)
def test_a_wave_over_the_columns_is_no_exchange_of_axes(name: str) -> None:
    assert not list(axes(Demonstrations.of(list(WAVES[name]), "a")))


HEART = strokes("heart", 6, 0)
WALKS = np.random.default_rng(0).normal(size=(6, 60, 10)).cumsum(axis=1)


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        (
            HEART.transpose(0, 2, 1),
            "smooth along axis 2, not along time; (demo, time, column) of shape (6, 40, 2): transpose(0, 2, 1)",
        ),
        (
            HEART.transpose(1, 0, 2),
            "smooth along axis 0, not along time; (demo, time, column) of shape (6, 40, 2): transpose(1, 0, 2)",
        ),
        (
            HEART.transpose(2, 1, 0),
            "alike along axis 2, as demonstrations are; (demo, time, column) of shape (6, 40, 2): transpose(2, 1, 0)",
        ),
        (HEART[..., :1].transpose(0, 2, 1), "(demo, time, column) of shape (6, 40, 1): transpose(0, 2, 1)"),
        (HEART[..., :1].transpose(1, 0, 2), "(demo, time, column) of shape (6, 40, 1): transpose(1, 0, 2)"),
        (HEART[..., :1].transpose(2, 1, 0), "(demo, time, column) of shape (6, 40, 1): transpose(2, 1, 0)"),
        (WALKS.transpose(0, 2, 1), "transpose(0, 2, 1)"),
        (WALKS.transpose(1, 0, 2), "transpose(1, 0, 2)"),
    ],
)
def test_exchanged_axes_are_noted_once_with_their_order(
    states: np.ndarray, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez("five.npz", states=states, concepts=np.array("a"))
    succeed("check", "five.npz")
    told = capsys.readouterr()
    assert told.err.count("note: five.npz: axes are likely exchanged") == 1
    assert expected in told.err
    assert "axes" not in told.out


def test_exchanged_axes_are_noted_once_for_all_concepts(capsys: pytest.CaptureFixture[str]) -> None:
    states = np.concatenate([HEART, strokes("spiral", 6, 0), strokes("square", 6, 0)]).transpose(0, 2, 1)
    np.savez("three.npz", states=states, concepts=np.repeat(["a", "b", "c"], 6))
    succeed("check", "three.npz")
    told = capsys.readouterr()
    assert (told.err.count("axes are likely exchanged"), told.out.count("axes")) == (1, 0)


def test_states_of_a_single_time_are_no_exchange_of_axes() -> None:
    digits = pytest.importorskip("sklearn.datasets").load_digits()
    for states in (digits.data[:, None], digits.data[np.argsort(digits.target)][:, None], digits.images):
        assert not list(axes(Demonstrations.of(list(states[:500]), "a")))
    named = Demonstrations.of(list(HEART[..., :1].transpose(0, 2, 1)), "a", state_names=tuple(f"x{column}" for column in range(40)))
    assert not list(axes(named))
