"""Kinds of columns: conversion to continuous numbers and back, what data show, and what is declared."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ftl_lightning.data.kinds import Columns, Paths, check_values, declared, resolved
from ftl_lightning.services.errors import UserError
from tests.conftest import CONF, refused, succeed
from tests.tiny import QUIET

NO_UNITS = ("",) * 20


def _paths(states: Tensor) -> Paths:
    return Paths(states.flatten(0, 1), torch.full((len(states),), states.shape[1]))


def kinds_of(states: Tensor, kinds: tuple[str, ...] = (), units: tuple[str, ...] = NO_UNITS) -> tuple[str, ...]:
    width = states.shape[2]
    return resolved(_paths(states), tuple("abcdefghijklmnopqrst"[:width]), units[:width], kinds or ("",) * width, "file")


def rotations(seed: int = 0, demos: int = 5, time: int = 30) -> Rotation:
    """Rotations about random axes, at even steps of 5 degrees from random places."""
    draw = np.random.default_rng(seed)
    axes = draw.normal(size=(demos, 1, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = np.deg2rad(5) * np.arange(time)[None, :, None] * axes
    starts = Rotation.random(demos, random_state=seed)
    whole = [(Rotation.from_rotvec(turn) * start).as_matrix() for turn, start in zip(turns, starts, strict=True)]
    return Rotation.from_matrix(np.concatenate(whole))


def quaternions(scalar_first: bool) -> Tensor:
    return torch.from_numpy(rotations().as_quat(scalar_first=scalar_first)).reshape(5, 30, 4)


@pytest.mark.parametrize("scalar_first", [True, False])
def test_quaternions_of_any_order_and_sign_come_back_without_a_change_of_sign(scalar_first: bool) -> None:
    whole = quaternions(scalar_first)
    flipped = whole * torch.from_numpy(np.random.default_rng(1).choice([-1.0, 1.0], size=(5, 30, 1)))
    columns = Columns(kinds_of(flipped))
    assert columns.width == 6
    encoded = columns.encode(flipped)
    assert float(encoded.diff(dim=1).abs().max()) < 0.12  # steps of 5 degrees
    back = columns.decode(encoded)
    assert float((back.norm(dim=-1) - 1).abs().max()) < 1e-6
    assert torch.allclose((back * whole).sum(dim=-1).abs(), torch.ones(5, 30).double(), atol=1e-6)
    assert float(((back[:, 1:] * back[:, :-1]).sum(dim=-1)).min()) > 0.99


@pytest.mark.parametrize("transposed", [False, True])
def test_rotation_matrices_are_found_and_samples_are_orthonormal(transposed: bool) -> None:
    matrices = torch.from_numpy(rotations().as_matrix())
    states = (matrices.transpose(1, 2) if transposed else matrices).reshape(5, 30, 9)
    columns = Columns(kinds_of(states))
    assert columns.width == 6
    assert torch.allclose(columns.decode(columns.encode(states)), states, atol=1e-9)
    noisy = columns.decode(columns.encode(states) + 0.1 * torch.randn(5, 30, 6, generator=torch.Generator().manual_seed(0)))
    found = noisy.unflatten(-1, (3, 3))
    assert torch.allclose(found @ found.transpose(-1, -2), torch.eye(3).double().expand(5, 30, 3, 3), atol=1e-6)
    assert torch.allclose(torch.linalg.det(found), torch.ones(5, 30).double(), atol=1e-6)
    six = Columns(kinds_of(states[..., :6], ("rotation",) * 6))
    assert torch.allclose(six.decode(six.encode(states[..., :6])), states[..., :6], atol=1e-9)


HEADING = torch.linspace(0, 7, 40)[None, :, None] + torch.tensor([0.0, 1.0, 2.0, 3.0, 4.5])[:, None, None]


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        ((HEADING + math.pi) % (2 * math.pi) - math.pi, [-math.pi, 2 * math.pi, 1]),
        (HEADING % (2 * math.pi), [0, 2 * math.pi, 1]),
        (torch.rad2deg(HEADING) % 360, [0, 360, 1]),
        ((torch.rad2deg(HEADING) + 180) % 360 - 180, [-180, 360, 1]),
    ],
)
def test_angles_that_wrap_are_found_and_come_back_in_their_range(states: Tensor, expected: list[float]) -> None:
    (kind,) = kinds_of(states)
    assert [float(number) for number in kind.split()[1:]] == pytest.approx(expected)
    columns = Columns((kind,))
    assert float(columns.encode(states).diff(dim=1).abs().max()) < 0.2
    assert torch.allclose(columns.decode(columns.encode(states)), states, atol=1e-3)


def test_an_angle_that_goes_on_is_declared_and_comes_back_without_jumps() -> None:
    assert kinds_of(HEADING) == ()
    columns = Columns(kinds_of(HEADING, ("angle",), ("rad",)))
    assert torch.allclose(columns.decode(columns.encode(HEADING)).diff(dim=1), HEADING.diff(dim=1), atol=1e-5)


def test_phases_and_switches_come_back_as_one_of_their_values() -> None:
    phase = torch.nn.functional.one_hot(torch.arange(40) // 10 % 3, 3).float().expand(5, 40, 3)
    gripper = (torch.arange(40) > 20).float()[None, :, None].expand(5, 40, 1)
    states = torch.cat((phase, gripper, HEADING), dim=-1)
    kinds = kinds_of(states)
    assert kinds == ("category 3", "category 3", "category 3", "binary 0 1", "linear")
    columns = Columns(kinds)
    noisy = columns.encode(states) + 0.3 * torch.rand(5, 40, 5, generator=torch.Generator().manual_seed(0)) - 0.15
    assert torch.equal(columns.decode(noisy)[..., :4], states[..., :4])


def test_other_columns_stay_linear() -> None:
    draw = torch.Generator().manual_seed(0)
    still = torch.tensor([1.0, 0, 0, 0]).expand(5, 30, 4)  # a unit vector that never moves is no rotation
    walks = torch.randn(5, 30, 6, generator=draw).cumsum(dim=1)
    assert kinds_of(torch.cat((still + 0.0 * walks[..., :4], walks), dim=-1)) == ()
    assert not Columns(())
    assert Columns(()).encode(walks) is walks


def test_declarations_of_the_file_and_of_the_configuration_are_joined_and_checked() -> None:
    names = ("x", "qw", "qx", "qy", "qz")
    given = declared(names, ("linear", "", "", "", ""), {"qw, qx, qy, qz": "quaternion"}, "data.kinds")
    assert given == ("linear", *("quaternion",) * 4)
    with pytest.raises(UserError, match=r"data.kinds: expected names among x, qw, qx, qy, qz, found 'y'"):
        declared(names, (), {"y": "angle"}, "data.kinds")
    with pytest.raises(
        UserError, match=r"expected one of linear, angle, quaternion, rotation, pose, binary, category, found 'round'"
    ):
        declared(names, (), {"x": "round"}, "data.kinds")
    walk = torch.randn(5, 30, 4, generator=torch.Generator().manual_seed(0))
    for kind, expected in (
        ("quaternion", "expected quaternions of norm 1"),
        ("binary", "expected two values"),
        ("category", "expected columns of 0 and 1"),
        ("rotation", "expected 9 columns of a rotation matrix"),
    ):
        with pytest.raises(UserError, match=expected):
            kinds_of(walk, (kind,) * 4)


def test_samples_of_rotations_are_rotations(capfd: pytest.CaptureFixture[str]) -> None:
    from ftl_lightning import FewShot

    parts = [quaternions(True).roll(number, dims=0) for number in range(4)]
    signs = np.random.default_rng(2).choice([-1.0, 1.0], size=(20, 30, 1))
    names = np.array(["qw", "qx", "qy", "qz"])
    np.savez("quaternions.npz", states=torch.cat(parts).numpy() * signs, concepts=np.repeat(["a", "b"], 10), state_names=names)
    succeed("fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=quaternions.npz", "--trainer.max_steps=3", *QUIET)
    assert "note: quaternions.npz: columns qw, qx, qy, qz: quaternion; data.kinds declares others" in capfd.readouterr().err
    model = FewShot.from_pretrained(Path("logs/own/fit/pretrained"))
    for plans in (model.sample(model["a"], count=3), model.sample(model.learn(parts[0].numpy(), steps=1, form="paper"), count=3)):
        assert float((plans.states.norm(dim=-1) - 1).abs().max()) < 1e-3
        assert float((plans.states[:, 1:] * plans.states[:, :-1]).sum(dim=-1).min()) > 0


def test_a_kind_that_the_data_contradict_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("walks.npz", states=np.random.default_rng(0).normal(size=(8, 10, 2)), concepts=np.repeat(["a", "b"], 4))
    own = ["fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=walks.npz"]
    refused(capsys, [*own, "--data.kinds={0: binary}"], "column '0': expected two values, found 80")


def fit_refused(capsys: pytest.CaptureFixture[str], expected: str, **arrays: object) -> None:
    np.savez("d.npz", concepts=np.repeat(["a", "b"], 10), **arrays)  # type: ignore[arg-type]
    refused(capsys, ["fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=d.npz"], expected)


def matrices() -> Tensor:
    """Rotation matrices ``(20, 30, 3, 3)``."""
    return torch.cat([torch.from_numpy(rotations(seed).as_matrix()).reshape(5, 30, 3, 3) for seed in range(4)])


@pytest.mark.parametrize("norm", [0.0, 1.5])
@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("declared", [False, True])
def test_an_invalid_quaternion_among_many_is_named(
    norm: float, named: bool, declared: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    states = np.concatenate([rotations(seed).as_quat().reshape(5, 30, 4) for seed in range(4)])
    states[13, 7] *= norm
    more = {"state_names": ["qx", "qy", "qz", "qw"]} if named else {}
    more |= {"state_kinds": ["quaternion"] * 4} if declared else {}
    name = more.get("state_names", ["0"])[0]
    fit_refused(capsys, f"column '{name}': expected quaternions of norm 1, found (", states=states, **more)
    fit_refused(capsys, ") in demonstration 14 at time 7", states=states, **more)
    succeed("check", "d.npz")
    found = capsys.readouterr().out
    assert found.count("error: column") == 1
    assert "in demonstration 4 at time 7" in found  # of its concept
    assert found.count(": quaternion") == 1  # of the other concept


def test_columns_that_are_declared_linear_are_no_quaternions(capsys: pytest.CaptureFixture[str]) -> None:
    states = torch.from_numpy(np.concatenate([rotations(seed).as_quat().reshape(5, 30, 4) for seed in range(4)]))
    states[13, 7] = 0
    assert kinds_of(states, ("linear",) * 4) == ("linear",) * 4
    np.savez("d.npz", states=states.numpy(), concepts=np.repeat(["a", "b"], 10), state_kinds=["linear"] * 4)
    succeed("check", "d.npz")
    assert "quaternion" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("states", "kind", "expected"),
    [
        (matrices().flatten(2), "rotation", "expected orthonormal rows with determinant 1"),
        (torch.eye(3).double()[torch.arange(600).reshape(20, 30) % 3], "category", "expected one-hot columns"),
        ((torch.arange(600.0).reshape(20, 30, 1) % 2), "binary", "expected 0 or 1"),
    ],
)
def test_an_invalid_value_of_another_kind_is_named(states: Tensor, kind: str, expected: str) -> None:
    broken = states.clone()
    broken[2, 5] = 0.5
    for given in [(kind,) * states.shape[2]] + [()] * (kind == "rotation"):
        with pytest.raises(UserError, match=rf"{expected}, found \(0.5.* in demonstration 3 at time 5"):
            kinds_of(broken, given)


def test_an_invalid_value_given_to_a_model_is_named() -> None:
    states = quaternions(True)
    kinds = kinds_of(states)
    check_values(_paths(states), ("w", "x", "y", "z"), kinds)
    states[1, 4] = 0
    expected = r"column 'w': expected quaternions of norm 1, as the model's, found \(0, 0, 0, 0\) in demonstration 2 at time 4"
    with pytest.raises(UserError, match=expected):
        check_values(_paths(states), ("w", "x", "y", "z"), kinds)


def poses(rows: int, transposed: bool) -> Tensor:
    """Homogeneous matrices ``(20, 30, 4 * rows)`` of rotations and positions."""
    places = torch.randn(20, 30, 3, 1, generator=torch.Generator().manual_seed(0)).double().cumsum(dim=1)
    last = torch.tensor([0.0, 0, 0, 1]).double().expand(20, 30, 1, 4)
    whole = torch.cat((torch.cat((matrices(), places), dim=-1), last), dim=-2)[..., :rows, :]
    return (whole.mT if transposed else whole).flatten(2)


@pytest.mark.parametrize(("rows", "transposed"), [(4, False), (4, True), (3, False), (3, True)])
@pytest.mark.parametrize("declared", [False, True])
def test_homogeneous_matrices_are_rotations_and_positions(rows: int, transposed: bool, declared: bool) -> None:
    states = poses(rows, transposed)
    if rows == 3 and transposed:  # nine columns of a rotation, and three of a position
        assert kinds_of(states) == ("rotation 9",) * 9 + ("linear",) * 3
        return
    size = 4 * rows
    columns = Columns(kinds_of(states, ("pose",) * size if declared else ()))
    assert columns.groups[0].texts == (f"pose {size} {int(transposed)}",) * size
    assert columns.width == len(columns.names(tuple(map(str, range(size))))) == 9
    assert torch.allclose(columns.decode(columns.encode(states)), states, atol=1e-9)
    noisy = columns.decode(columns.encode(states) + 0.3 * torch.randn(20, 30, 9, generator=torch.Generator().manual_seed(0)))
    found = noisy.unflatten(-1, (4, -1) if transposed else (-1, 4))
    found = found.mT if transposed else found
    assert torch.allclose(found[..., :3, :3] @ found[..., :3, :3].mT, torch.eye(3).double().expand(20, 30, 3, 3), atol=1e-6)
    if rows == 4:
        assert torch.equal(found[..., 3, :], torch.tensor([0.0, 0, 0, 1]).double().expand(20, 30, 4))


def test_poses_lie_anywhere_in_a_state_and_samples_are_poses(capfd: pytest.CaptureFixture[str]) -> None:
    from ftl_lightning import FewShot

    whole, more = poses(4, False), torch.arange(30.0).double()[None, :, None].expand(20, 30, 1)
    states = torch.cat((more, whole, more + 1, whole), dim=-1)
    assert [kind.split()[0] for kind in kinds_of(states[..., :19])] == ["linear", *["pose"] * 16, "linear", "linear"]
    np.savez("d.npz", states=states.numpy(), concepts=np.repeat(["a", "b"], 10))
    succeed("fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=d.npz", "--trainer.max_steps=3", *QUIET)
    assert capfd.readouterr().err.count(": pose; data.kinds declares others") == 2
    model = FewShot.from_pretrained(Path("logs/own/fit/pretrained"))
    for plans in (model.sample(model["a"], count=3), model.sample(model.learn(states[:5].numpy(), steps=1, form="paper"), count=3)):
        found = plans.states[..., 18:].unflatten(-1, (4, 4))
        assert torch.equal(found[..., 3, :], torch.tensor([0.0, 0, 0, 1]).expand(3, 30, 4))
        assert torch.allclose(torch.linalg.det(found[..., :3, :3]), torch.ones(3, 30), atol=1e-4)
    states[2, 5, 1:17] = 0
    with pytest.raises(UserError, match=r"column '1': expected homogeneous matrices .* in demonstration 3 at time 5"):
        model.learn(states[:5].numpy(), steps=1)


def test_columns_with_a_unit_are_no_rotations() -> None:
    whole = quaternions(True)
    assert kinds_of(whole, units=("",) * 4)[0].startswith("quaternion")
    assert set(kinds_of(whole, units=("m",) * 4)) <= {"", "linear"}


def test_matrices_that_do_not_turn_stay_linear() -> None:
    still = poses(4, False)
    still[..., [0, 1, 2, 4, 5, 6, 8, 9, 10]] = torch.eye(3).double().flatten()
    assert kinds_of(still) == ()


@pytest.mark.parametrize(
    ("unit", "turn"), [("revolutions", 1), ("turns", 1), ("grad", 400), ("mrad", 2000 * math.pi), ("°", 360), ("Deg", 360)]
)
def test_angles_of_other_units_wrap_at_their_turn(unit: str, turn: float) -> None:
    going = HEADING / (2 * math.pi) * turn
    for states, given in ((going % turn, ()), (going % turn, ("angle",)), (going, ("angle",)), (going, (f"angle {unit}",))):
        (kind,) = kinds_of(states, given, (unit,))
        assert float(kind.split()[2]) == pytest.approx(turn)
        columns = Columns((kind,))
        assert float(columns.encode(states).diff(dim=1).abs().max()) < 0.2
        assert torch.allclose(columns.decode(columns.encode(states)), states, atol=1e-3 * turn)
    assert kinds_of(going % turn, (), ("m",)) == ()


def test_angles_of_an_unknown_unit_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    expected = "column 'a': expected a unit of angles (rad, deg, mrad, turns, grad), found 'points'"
    states = HEADING.repeat(4, 1, 1).numpy()
    fit_refused(capsys, expected, states=states, state_names=["a"], state_units=["points"], state_kinds=["angle"])
    fit_refused(capsys, expected, states=states, state_names=["a"], state_kinds=["angle points"])
