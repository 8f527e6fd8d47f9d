"""Actions of demonstrations: in files, as columns, and by an inverse model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.data.actions import action_columns, follows_present, inverse_model
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import UserError
from tests.data.test_references import TIME, reaches

RNG = np.random.default_rng(0)
PATHS = [RNG.normal(size=(length, 2)).cumsum(axis=0).astype(np.float32) for length in (6, 4)]
DONE = [np.diff(path, axis=0) for path in PATHS]


@pytest.fixture
def acted() -> Demonstrations:
    return Demonstrations.of(PATHS, ["left", "right"], actions=DONE, action_names=("x", "action y"))


def test_the_last_action_of_each_demonstration_is_repeated(acted: Demonstrations) -> None:
    assert acted.actions is not None
    assert acted.actions.shape == (2, 6, 2)
    for row, done in enumerate(DONE):
        length = len(done) + 1
        assert torch.equal(acted.actions[row, : length - 1], torch.from_numpy(done))
        assert torch.equal(acted.actions[row, length - 1 :], torch.from_numpy(done[-1:]).expand(7 - length, -1))
    assert acted.rows([1]).actions.shape == (1, 6, 2)  # type: ignore[union-attr]


def test_observed_features_may_be_arrays_or_lists() -> None:
    seen = {"goal": np.zeros((2, 3)), "list": [[1, 2], [3, 4]], "picture": np.zeros((2, 3, 4, 4), np.uint8)}
    shown = Demonstrations.of(PATHS, "left", observed=seen).observed
    kinds = {"goal": torch.float32, "list": torch.float32, "picture": torch.uint8}
    assert {name: values.dtype for name, values in shown.items()} == kinds
    with pytest.raises(UserError, match="observed 'goal': expected an array of numbers, found"):
        Demonstrations.of(PATHS, "left", observed={"goal": ["here", "there"]})


def test_actions_of_single_numbers_need_no_column(tmp_path: Path) -> None:
    numbers = [np.arange(len(path) - 1) % 2 for path in PATHS]
    acted = Demonstrations.of(PATHS, "left", actions=numbers)
    assert acted.actions is not None
    assert acted.actions.shape == (2, 6, 1)
    np.savez(tmp_path / "flat.npz", states=acted.states, lengths=acted.lengths, actions=acted.actions[..., 0])
    assert torch.equal(Demonstrations.load(tmp_path / "flat.npz").actions, acted.actions)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["acted.npz", "acted.safetensors", "lerobot:acted", "minari:acted/test-v0"])
def test_every_format_that_is_written_keeps_actions(
    acted: Demonstrations, name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if ":" in name:
        pytest.importorskip(name.split(":", maxsplit=1)[0] if "minari" in name else "pyarrow", reason="an extra is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    acted.save(name)
    read = Demonstrations.load(name.split(":")[-1])
    assert torch.equal(read.actions, acted.actions)  # type: ignore[arg-type]
    assert read.action_names == acted.action_names
    assert torch.equal(read.states, acted.states)


def test_columns_of_a_table_that_begin_with_action_are_actions(acted: Demonstrations) -> None:
    lines = ["demonstration,x,Action_x,y,action_y"]
    lines += [f"{row},{s[0]},{a[0]},{s[1]},{a[1]}" for row in (0, 1) for s, a in zip(PATHS[row], acted.actions[row], strict=False)]  # type: ignore[index]
    Path("acted.csv").write_text("\n".join(lines), "utf-8")
    read = Demonstrations.load("acted.csv")
    assert (read.state_names, read.action_names) == (("x", "y"), ("Action_x", "action_y"))
    assert torch.allclose(read.actions, acted.actions, atol=1e-6)  # type: ignore[arg-type]


def test_joined_actions_are_columns_that_are_known_by_their_names(acted: Demonstrations) -> None:
    joined = acted.joined
    assert joined.state_names == ("0", "1", "action x", "action y")
    assert action_columns(joined.state_names) == (2, 3)
    assert joined.actions is None
    assert joined.joined is joined


@pytest.mark.parametrize(
    ("shape", "expected"), [((2, 5, 0), "key 'actions'"), ((3, 6, 1), "key 'actions'"), ((2, 4, 1), "key 'actions'")]
)
def test_actions_of_other_shapes_are_refused(acted: Demonstrations, shape: tuple[int, ...], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        replace(acted, actions=torch.zeros(shape), action_names=())


def swings(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """States of pendulums at any phase, and actions that depend on the state alone."""
    phase, time = torch.rand(count, 1) * 6.28, torch.arange(40) * 0.3
    states = torch.stack(((phase + time).sin(), (phase + time).cos()), dim=2)
    return states, states[..., :1] * states[..., 1:]


def test_an_inverse_model_knows_what_led_from_a_state_to_the_next() -> None:
    steps = torch.randn(12, 30, 2, generator=torch.Generator().manual_seed(0))
    states = torch.cat((torch.zeros(12, 1, 2), (steps * torch.tensor([1.0, 3.0])).cumsum(dim=1)), dim=1)
    actions = torch.cat((steps, steps[:, -1:]), dim=1)
    model = inverse_model(states, actions, torch.full((12,), 31))
    assert model.error < 0.01
    found = model(torch.tensor([[0.0, 0.0, 0.5, 1.5]]))
    assert found[0].tolist() == pytest.approx([0.5, 0.5], abs=0.05)
    noise = inverse_model(states, torch.randn(actions.shape), torch.full((12,), 31))
    assert noise.error > 0.9


def test_actions_follow_the_present_state_or_time() -> None:
    torch.manual_seed(0)
    states, actions = swings(12)
    lengths, nothing = torch.full((12,), 40), torch.zeros(12, 40, 0)
    assert follows_present(states, actions, lengths, ("swing",) * 12, nothing)
    timed = torch.linspace(0, 6, 40).sin()[None, :, None].expand(12, -1, -1) + 0 * states[..., :1]
    assert not follows_present(0.1 * torch.randn(12, 40, 2), timed, lengths, ("swing",) * 12, nothing)


def test_goals_in_one_vector_are_places_those_not_followed_too() -> None:
    from ftl_lightning.data.demonstrations import concatenate
    from ftl_lightning.data.places import places

    rng = np.random.default_rng(5)
    parts = [reaches("thing", 20, 1), reaches("goal", 20, 2)]
    for number, part in enumerate(parts):
        other = torch.tensor(rng.uniform(-1, 1, (20, 2)), dtype=torch.float32)
        seen = part.observed
        goals = torch.cat((seen["thing"], seen["goal"], other), dim=1)
        parts[number] = replace(part, observed={"start": seen["start"], "goals": goals})
    assert places(concatenate(parts), TIME) == {"start": (0, 1), **{f"goals[{n}:{n + 2}]": (0, 1) for n in (0, 2, 4)}}
    apart = [
        replace(part, observed={**part.observed, "third": part.observed["goals"][:, 4:], "goals": part.observed["goals"][:, :4]})
        for part in parts
    ]
    assert "third" in places(concatenate(apart), TIME)
    far = [replace(part, observed={**part.observed, "third": 5 + part.observed["third"]}) for part in apart]
    assert "third" not in places(concatenate(far), TIME)
