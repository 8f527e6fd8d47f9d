"""How a model sees traffic."""

import math

import pytest
import torch
from torch import Tensor

from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.domains.driving.motion import drive
from ftl_lightning.domains.driving.views import VIEWS
from ftl_lightning.errors import UserError


def vehicle(x: float, y: float, speed: float, heading: float) -> list[float]:
    cos, sin = math.cos(heading), math.sin(heading)
    return [1, x, y, speed * cos, speed * sin, cos, sin]


NEW, KNOWN = 4, 0
"""Numbers of a scenario that is not one of pretraining, and of one that is."""


def scene(turn: float = 0.0, x: float = 0.0, y: float = 0.0, number: int = NEW) -> Tensor:
    """A vehicle at 8 m/s and another 10 m ahead of it at 4 m/s, the whole turned and moved."""
    ahead = vehicle(x + 10 * math.cos(turn), y + 10 * math.sin(turn), 4, turn)
    return torch.tensor([vehicle(x, y, 8, turn) + ahead + [0.0] * 21 + [number, 99]])


def straight_on(turn: float = 0.0, x: float = 0.0, y: float = 0.0) -> Tensor:
    return torch.tensor([[vehicle(x + 8 * k * math.cos(turn), y + 8 * k * math.sin(turn), 8, turn) for k in range(8)]])


@pytest.mark.parametrize("name", VIEWS)
def test_decoding_undoes_encoding(name: str) -> None:
    view, start = VIEWS[name], scene(1.1, 30, -20)
    states = torch.randn(1, 8, 7)
    states[..., 5:] /= states[..., 5:].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(view.decode(view.encode(states, start), start), states, atol=1e-5, rtol=1e-5)


def test_from_the_vehicle_all_new_straight_roads_are_alike() -> None:
    view = VIEWS["steps"]
    seen, seen_turned = view.observe(scene()), view.observe(scene(2.0, 300, 40))
    torch.testing.assert_close(seen_turned, seen, atol=1e-4, rtol=1e-4)
    assert seen[0, :7].tolist() == [0, 0, 0, 0, 8, 0, 0]
    assert seen[0, 7:14].tolist() == pytest.approx([1, 10 * 20 / 30, 0, 4 - 8, 0, 1, 0], abs=1e-5)  # 10 m away, 4 m/s slower
    assert (seen[0, 14:] == 0).all()  # who is not there is nowhere, wherever the vehicle is
    assert (seen_turned[0, 14:] == 0).all()


def test_on_a_known_road_a_vehicle_knows_its_place() -> None:
    view = VIEWS["steps"]
    seen = view.observe(scene(math.pi / 2, 80, -20, KNOWN))
    assert seen[0, :7].tolist() == pytest.approx([80, -20, 80 * 20 / 100, -10, 8, 0, 1], abs=1e-5)
    assert torch.equal(seen[0, 7:], view.observe(scene(math.pi / 2, 80, -20))[0, 7:])


def test_half_of_the_time_the_place_on_a_known_road_is_hidden_and_the_present_perturbed() -> None:
    view, start, states = VIEWS["steps"], scene(number=KNOWN), straight_on()
    assert view.perturb is not None
    kept, seen = view.perturb(states, start, torch.tensor([[0.5, 1.0]]))
    assert torch.equal(kept, states)
    assert torch.equal(seen, start)
    other, seen = view.perturb(states, start, torch.tensor([[0.5, -1.0]]))
    assert other[0, 0].tolist() == pytest.approx(vehicle(0, 0, 8 + 0.5 * 4, 0))
    assert view.observe(seen)[0, :7].tolist() == pytest.approx([0, 0, 0, 0, 10, 0, 0])
    torch.testing.assert_close(view.decode(view.encode(other, seen), seen), other)


def test_a_perturbed_present_has_another_speed_and_the_way_back_from_it() -> None:
    view, start, states = VIEWS["steps"], scene(), straight_on()
    assert view.perturb is not None
    other, seen = view.perturb(states, start, torch.tensor([[0.5, 1.0]]))
    assert seen[0, 1:7].tolist() == pytest.approx(vehicle(0, 0, 8 + 0.5 * 4, 0)[1:])
    assert torch.equal(seen[0, 7:], start[0, 7:])
    assert torch.equal(other[0, 0, 1:], seen[0, 1:7])
    assert torch.equal(other[0, 1:], states[0, 1:])
    assert view.encode(other, seen)[0, 1, 3] == -2  # brakes by what it was too fast
    stopped, _ = view.perturb(states, start, torch.tensor([[-9.0, 1.0]]))
    assert stopped[0, 0, 3:5].tolist() == [0, 0]


def test_in_steps_every_state_of_a_straight_drive_is_the_same() -> None:
    seen = VIEWS["steps"].encode(straight_on(2.0, 300, 40), scene(2.0, 300, 40))[0]
    torch.testing.assert_close(seen, torch.tensor([1.0, 0, 0, 0, 0, 1, 0]).expand(8, -1), atol=1e-4, rtol=1e-4)


def test_in_steps_a_heading_is_of_length_one_whatever_the_model_said() -> None:
    view, start = VIEWS["steps"], scene()
    seen = view.encode(straight_on(), start)
    seen[..., 5:] *= 3
    assert not torch.allclose(seen, view.encode(straight_on(), start))
    torch.testing.assert_close(view.decode(seen, start), straight_on(), atol=1e-4, rtol=1e-4)


def test_no_model_sees_which_new_road_it_is_or_the_seed() -> None:
    start = scene()
    other = start.clone()
    other[:, -2:] = torch.tensor([5, 0])
    for view in VIEWS.values():
        assert view.observe(start).shape == (1, 35)
        assert torch.equal(view.observe(start), view.observe(other))
        with pytest.raises(UserError, match="expected 37 numbers each, found 35"):
            view.observe(start[:, :35])


def test_a_drive_is_the_same_on_any_road() -> None:
    """Ten metres on an arc that turns by 90 degrees, or straight on, at 8 m/s."""
    for turn in (0.0, math.pi / 2):
        for road in (0.0, 2.0):
            chord, way = (10 * math.sin(turn / 2) / (turn / 2) if turn else 10.0), road + turn / 2
            before = torch.tensor(vehicle(5, 7, 3, road))
            after = torch.tensor(vehicle(5 + chord * math.cos(way), 7 + chord * math.sin(way), 8, road + turn))
            assert drive(before, after).tolist() == pytest.approx([chord, 0, 8, 0], abs=1e-5)


def test_a_plan_is_followed_by_its_drives() -> None:
    act = VIEWS["steps"].act
    assert act is not None
    plans = straight_on(2.0)
    for step in (0, 3, 20):  # its last once it is at its end
        assert act(plans, step, scene(2.0))[0].tolist() == pytest.approx([8, 0, 8, 0], abs=1e-4)


def test_entities_are_the_other_vehicles() -> None:
    assert [columns[0] for columns in DOMAIN.entities] == [7, 14, 21, 28]
    assert {len(columns) for columns in DOMAIN.entities} == {7}
