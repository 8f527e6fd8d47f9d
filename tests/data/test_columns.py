"""Precision, names and units of columns, and padding."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning import Demonstrations, FewShot
from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
from ftl_lightning.data.columns import aligned, check_precision
from ftl_lightning.data.demonstrations import held
from ftl_lightning.data.features import precise
from ftl_lightning.services.errors import Note, UserError
from tests.conftest import CONF, refused, succeed
from tests.tiny import QUIET

FIT = ["fit", f"--config={CONF / 'own.yaml'}", "--trainer.max_steps=3", *QUIET]
KINDS = list(TRAINING)[:2]
RAMP = np.linspace(0, 1, 40)


def some(**changes: object) -> Demonstrations:
    names = {"state_names": ("x", "y"), "state_units": ("m", "cm")}
    return Demonstrations.of([path + 2.0 for path in strokes("heart", 3, 0)], "heart", **names | changes)


@pytest.mark.parametrize("offset", [0.0, 30.0, -30.0])
def test_small_offsets_stay_float32(offset: float) -> None:
    assert precise(strokes("heart", 3, 0).astype(np.float64) + offset).dtype == np.float32


@pytest.mark.parametrize("offset", [5_820_000.0, 1.7e9, -1e7])
def test_large_offsets_are_kept_in_float64_and_samples_move(offset: float) -> None:
    states = np.concatenate([strokes(kind, 6, 0) for kind in KINDS]).astype(np.float64) + np.array([0.0, offset])
    np.savez("far.npz", states=states, concepts=np.repeat(KINDS, 6))
    read = Demonstrations.load("far.npz")
    assert np.abs(read.states.numpy() - states).max() == 0
    read.save("far.safetensors")
    assert torch.equal(Demonstrations.load("far.safetensors").states, read.states)
    succeed(*FIT, "--data.demonstrations=far.npz")
    model = FewShot.from_pretrained(Path("logs/own/fit/pretrained"))
    plans = model.sample(model[KINDS[0]], count=4).states
    assert plans.dtype == torch.float64
    low, high = states.min(axis=(0, 1)), states.max(axis=(0, 1))
    within = (plans.numpy() > low - (high - low)) & (plans.numpy() < high + (high - low))
    assert within.all()
    assert len(plans[..., 1].unique()) > 50
    learned = model.learn(strokes("heart", 3, 1).astype(np.float64) + np.array([0.0, offset]), steps=1, form="paper")
    assert float((model.sample(learned, count=2).states[..., 1] - offset).abs().max()) < 50


@pytest.mark.parametrize(
    ("states", "column"),
    [
        (np.float32(5_820_000) + strokes("heart", 5, 0).astype(np.float32), "x"),  # steps are lost in the file
        (np.stack((RAMP, np.r_[np.arange(25) * 1e-9, RAMP[25:]]), axis=-1)[None].repeat(5, 0) + np.array([0, 1e4]), "y"),
    ],
)
def test_steps_that_float32_cannot_hold_are_refused_with_the_column(states: np.ndarray, column: str) -> None:
    demonstrations = Demonstrations.of(list(states), "a", state_names=("x", "y"))
    if states.dtype == np.float32:
        demonstrations = Demonstrations(**{**vars(demonstrations), "states": torch.from_numpy(states)})
    with pytest.raises(UserError, match=f"column '{column}': expected .* that float32 can hold"):
        check_precision(demonstrations)


def test_rounding_of_a_constant_column_is_no_fault() -> None:
    states = np.full((5, 40, 2), 0.75, np.float32) + np.random.default_rng(0).normal(0, 3e-7, (5, 40, 2)).astype(np.float32)
    check_precision(Demonstrations.of(list(states), "a"))


@pytest.mark.parametrize("value", [-9999.0, np.nan, np.inf, 0.0, 1e30])
def test_padding_of_any_value_is_replaced(value: float, capfd: pytest.CaptureFixture[str]) -> None:
    states, lengths = np.concatenate([strokes(kind, 6, 0) for kind in KINDS]), np.arange(12) + 25
    for row, length in zip(states, lengths, strict=True):
        row[length:] = value
    observed = np.where(np.isfinite(states), states, -9999.0)[..., :1]
    keys = {"observed/x": observed, "per_step": np.array(["x"])}
    np.savez("padded.npz", states=states, concepts=np.repeat(KINDS, 6), lengths=lengths, **keys)
    succeed("check", "padded.npz")
    assert "not finite" not in capfd.readouterr().out
    succeed(*FIT, "--data.demonstrations=padded.npz")
    model = FewShot.from_pretrained(Path("logs/own/fit/pretrained")).model
    assert float(model.normalization.low.min()) > -10
    assert float(model.normalization.high.max()) < 10
    assert model.initial_normalization is not None
    assert float(model.initial_normalization.low.min()) > -10


def test_padding_that_continues_a_demonstration_is_kept() -> None:
    path = torch.arange(20.0)[None, :, None]
    assert held(path, torch.tensor([10])) is path
    jumps = torch.where(torch.arange(20)[None, :, None] < 10, path, 0.0)
    assert held(jumps, torch.tensor([10]))[0, 10:, 0].tolist() == [9.0] * 10


def test_columns_are_put_in_order_by_name_and_converted_to_the_models_units() -> None:
    given = some()
    with pytest.warns(Note) as notes:
        found = aligned(given, ("y", "x"), ("mm", "ft"))
    assert torch.allclose(found.states[..., 0], given.states[..., 1] * 10)
    assert torch.allclose(found.states[..., 1], given.states[..., 0] / 0.3048)
    assert (found.state_names, found.state_units) == (("y", "x"), ("mm", "ft"))
    texts = [str(note.message) for note in notes]
    assert texts == [
        "columns x, y are put in the model's order y, x",
        "columns are converted to the model's units: y from cm to mm, x from m to ft",
    ]
    degrees = aligned(some(state_units=("deg", "ms")), ("x", "y"), ("rad", "s"))
    assert torch.allclose(degrees.states, given.states * torch.tensor([np.pi / 180, 1e-3]).float(), rtol=1e-6)
    for unit, turn in {
        "revolutions": 1,
        "turns": 1,
        "grad": 400,
        "mrad": 2000 * np.pi,
        "°": 360,
        "Degrees": 360,
        "rad": 2 * np.pi,
    }.items():
        with pytest.warns(Note, match="converted"):
            turns = aligned(some(state_units=(unit, "cm")), ("x", "y"), ("arcmin", "cm"))
        assert torch.allclose(turns.states[..., 0], given.states[..., 0] * (360 * 60 / turn), rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"state_names": ("x", "z")}, "key 'state_names': expected x, y, the model's, found x, z"),
        ({"state_names": ("x", "x")}, "key 'state_names'"),
        ({"state_units": ("m", "s")}, "key 'state_units': column 'y': expected 'cm', the model's unit, found 's'"),
        ({"state_units": ("furlong", "cm")}, "column 'x': expected 'm', the model's unit, found 'furlong'; convert the column"),
    ],
)
def test_other_names_and_units_are_refused(changes: dict[str, tuple[str, ...]], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        aligned(some(**changes), ("x", "y"), ("m", "cm"))
    assert aligned(some(state_names=("0", "1"), state_units=("", "")), ("x", "y"), ("m", "cm")).state_names == ("x", "y")


def test_names_and_units_are_those_of_the_model_in_every_command(capfd: pytest.CaptureFixture[str]) -> None:
    states = np.concatenate([strokes(kind, 6, 0) for kind in KINDS])
    named = {"state_names": np.array(["x", "y"]), "state_units": np.array(["m", "m"])}
    np.savez("train.npz", states=states, concepts=np.repeat(KINDS, 6), **named)
    succeed(*FIT, "--data.demonstrations=train.npz")
    new = strokes("heart", 3, 1)
    swapped = {"state_names": np.array(["y", "x"]), "state_units": np.array(["ft", "m"])}
    np.savez("five.npz", states=new, concepts="heart")
    np.savez("swapped.npz", states=new[..., ::-1] / [0.3048, 1.0], concepts="heart", **swapped)
    models = "logs/own/fit/pretrained"
    for name in ("five", "swapped"):
        succeed("invert", models, f"{name}.npz", "--steps=2", "--form=paper", f"--out={name}")
    said = capfd.readouterr().err
    assert "note: swapped.npz: columns y, x are put in the model's order x, y" in said
    assert "note: swapped.npz: columns are converted to the model's units: y from ft to m" in said
    learned = [FewShot.from_pretrained(models).load(f"{name}/heart.safetensors").embeddings for name in ("five", "swapped")]
    torch.testing.assert_close(*learned, rtol=1e-3, atol=1e-4)


def test_masked_values_are_missing() -> None:
    model = FewShot.from_pretrained("strokes")
    masked = np.ma.masked_array(strokes("heart", 3, 1), mask=False)
    model.demonstrations(masked)
    masked[1, 10, 0] = np.ma.masked
    with pytest.raises(UserError, match=r"states: expected every value, found a masked one at index \(1, 10, 0\)"):
        model.demonstrations(masked)
    with pytest.raises(UserError, match=r"masked one at index \(10, 0\)"):
        model.demonstrations(list(masked))


@pytest.mark.parametrize("axes", [(0, 2, 1), (1, 0, 2)])
def test_a_likely_exchange_of_axes_is_reported_by_fit_and_learn(axes: tuple[int, ...], capfd: pytest.CaptureFixture[str]) -> None:
    turned = strokes("heart", 12, 1).transpose(axes)
    np.savez("turned.npz", states=turned, concepts=np.array(["a", "b"] * (len(turned) // 2)))
    succeed(*FIT, "--data.demonstrations=turned.npz")
    assert "axes are likely exchanged: states (" in capfd.readouterr().err
    succeed(*FIT, "--data.demonstrations=turned.npz", "--data.check=false")
    assert "axes" not in capfd.readouterr().err
    if turned.shape[2] == 2:
        with pytest.warns(UserWarning, match="axes are likely exchanged"):
            FewShot.from_pretrained("strokes").learn(turned, steps=1, form="paper")


def test_faults_are_said_before_fit_in_two_lines(capfd: pytest.CaptureFixture[str]) -> None:
    states = np.concatenate([strokes(kind, 6, 0) for kind in KINDS])
    states[0, 20] += 50
    states[2] = states[1]
    states[8, 10:] = states[8, 10]
    np.savez("faulty.npz", states=states, concepts=np.repeat(KINDS, 6))
    succeed(*FIT, "--data.demonstrations=faulty.npz")
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("note: faulty.npz")]
    lines = [line for line in lines if "recognised is not shown" not in line]
    assert len(lines) == 2
    assert "python -m ftl_lightning check" in lines[1]


def test_exchanged_axes_of_a_model_are_refused_with_advice(capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("turned.npz", states=strokes("heart", 5, 1).transpose(0, 2, 1), concepts="heart")
    refused(capsys, ["invert", "strokes", "turned.npz"], "expected states of 2 columns (own), found 40; exchange axes 1 and 2")
