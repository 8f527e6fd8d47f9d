"""How a model sees traffic."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.domains.driving.traffic import SCENARIO, TRAFFIC, initial_states
from ftl_lightning.domains.driving.views import VIEWS, drive


def vehicle(x: float, y: float, speed: float, heading: float) -> list[float]:
    cos, sin = math.cos(heading), math.sin(heading)
    return [1, x, y, speed * cos, speed * sin, cos, sin]


VIEW = VIEWS["steps"]
assert VIEW.perturb is not None
assert VIEW.act is not None
perturb, act = VIEW.perturb, VIEW.act
NEW, KNOWN = 4, 0
"""Numbers of a scenario that is not one of pretraining, and of one that is."""


def scene(turn: float = 0.0, x: float = 0.0, y: float = 0.0, number: int = NEW) -> dict[str, Tensor]:
    """What is observed of a vehicle at 8 m/s and another 10 m ahead of it at 4 m/s, the whole turned and moved."""
    ahead = vehicle(x + 10 * math.cos(turn), y + 10 * math.sin(turn), 4, turn)
    traffic = torch.tensor([vehicle(x, y, 8, turn) + ahead + [0.0] * 21])
    return {TRAFFIC: traffic, SCENARIO: torch.tensor([[float(number)]])}


def straight_on(turn: float = 0.0, x: float = 0.0, y: float = 0.0) -> Tensor:
    """The plan of who goes on like that."""
    return torch.tensor([[vehicle(x + 8 * k * math.cos(turn), y + 8 * k * math.sin(turn), 8, turn) for k in range(8)]])


def seen_in(observed: Observed, view: View = VIEW) -> Tensor:
    """The vectors that a model with this view reads."""
    return view.observe(observed)[TRAFFIC]


def same(one: Observed, other: Observed) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


ANY = torch.Generator()
"""A generator that is asked for nothing: :func:`drawn` stands in for what draws."""


def drawn(*values: float) -> Callable[..., Tensor]:
    """A source of noise ``(1, 2)`` that draws these values."""

    def randn(shape: tuple[int, int], **_: object) -> Tensor:
        assert shape == (1, len(values))
        return torch.tensor([values])

    return randn


def test_without_a_generator_every_road_is_unknown_and_nothing_else_changes() -> None:
    start, states = scene(2.0, 80, -20, KNOWN), straight_on(2.0, 80, -20)
    other, hidden = perturb(states, start, None)
    torch.testing.assert_close(other, states)
    assert seen_in(start)[0, 0] != 0
    assert seen_in(hidden)[0, :4].tolist() == [0, 0, 0, 0]
    torch.testing.assert_close(seen_in(hidden)[0, 4:5], seen_in(start)[0, 4:5])


@pytest.mark.parametrize("name", VIEWS)
def test_decoding_undoes_encoding(name: str) -> None:
    view, start = VIEWS[name], scene(1.1, 30, -20)
    states = torch.randn(1, 8, 7)
    states[..., 5:] /= states[..., 5:].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(view.decode(view.encode(states, start), start), states, atol=1e-5, rtol=1e-5)


def test_from_the_vehicle_all_new_straight_roads_are_alike_and_on_a_known_one_it_knows_its_place() -> None:
    seen, seen_turned = seen_in(scene()), seen_in(scene(2.0, 300, 40))
    torch.testing.assert_close(seen_turned, seen, atol=1e-4, rtol=1e-4)
    assert seen[0, :7].tolist() == [0, 0, 0, 0, 8, 0, 0]
    assert seen[0, 7:14].tolist() == pytest.approx([1, 10 * 20 / 30, 0, 4 - 8, 0, 1, 0], abs=1e-5)  # 10 m away, 4 m/s slower
    assert (seen[0, 14:] == 0).all()  # who is not there is nowhere, wherever the vehicle is
    assert (seen_turned[0, 14:] == 0).all()
    seen = seen_in(scene(math.pi / 2, 80, -20, KNOWN))
    assert seen[0, :7].tolist() == pytest.approx([80, -20, 80 * 20 / 100, -10, 8, 0, 1], abs=1e-5)
    assert torch.equal(seen[0, 7:], seen_in(scene(math.pi / 2, 80, -20))[0, 7:])


def test_half_of_the_time_the_place_on_a_known_road_is_hidden_and_the_present_perturbed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start, states = scene(number=KNOWN), straight_on()
    monkeypatch.setattr(torch, "randn", drawn(0.5, 1.0))
    kept, seen = perturb(states, start, ANY)
    assert torch.equal(kept, states)
    assert same(seen, start)
    monkeypatch.setattr(torch, "randn", drawn(0.5, -1.0))
    other, seen = perturb(states, start, ANY)
    assert other[0, 0].tolist() == pytest.approx(vehicle(0, 0, 8 + 0.5 * 4, 0))
    assert seen_in(seen)[0, :7].tolist() == pytest.approx([0, 0, 0, 0, 10, 0, 0])
    torch.testing.assert_close(VIEW.decode(VIEW.encode(other, seen), seen), other)


def test_a_perturbed_present_has_another_speed_and_the_way_back_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    start, states = scene(), straight_on()
    monkeypatch.setattr(torch, "randn", drawn(0.5, 1.0))
    other, seen = perturb(states, start, ANY)
    assert seen[TRAFFIC][0, 1:7].tolist() == pytest.approx(vehicle(0, 0, 8 + 0.5 * 4, 0)[1:])
    assert torch.equal(seen[TRAFFIC][0, 7:], start[TRAFFIC][0, 7:])
    assert torch.equal(seen[SCENARIO], start[SCENARIO])
    assert torch.equal(other[0, 0, 1:], seen[TRAFFIC][0, 1:7])
    assert torch.equal(other[0, 1:], states[0, 1:])
    assert VIEW.encode(other, seen)[0, 1, 3] == -2  # brakes by what it was too fast
    monkeypatch.setattr(torch, "randn", drawn(-9.0, 1.0))
    stopped, _ = perturb(states, start, ANY)
    assert stopped[0, 0, 3:5].tolist() == [0, 0]


def test_in_steps_every_state_of_a_straight_drive_is_the_same_and_a_heading_is_of_length_one() -> None:
    seen = VIEW.encode(straight_on(2.0, 300, 40), scene(2.0, 300, 40))[0]
    torch.testing.assert_close(seen, torch.tensor([1.0, 0, 0, 0, 0, 1, 0]).expand(8, -1), atol=1e-4, rtol=1e-4)
    start = scene()
    seen = VIEW.encode(straight_on(), start)
    seen[..., 5:] *= 3  # whatever the model said
    assert not torch.allclose(seen, VIEW.encode(straight_on(), start))
    torch.testing.assert_close(VIEW.decode(seen, start), straight_on(), atol=1e-4, rtol=1e-4)


def test_no_model_sees_which_new_road_it_is_or_the_seed_and_entities_are_the_other_vehicles() -> None:
    start, other = scene(), scene(number=5)
    for name, view in VIEWS.items():
        width = 40 if name == "standing" else 35
        assert {name: feature.shape for name, feature in view.features.items()} == {TRAFFIC: (width,)}
        assert seen_in(start, view).shape == (1, width)
        assert torch.equal(seen_in(start, view), seen_in(other, view))
    # The seed is part of a scene, of which nothing but what is observed reaches a model.
    assert sum(feature.size for feature in DOMAIN.observed.values()) == 36
    for number in (0, 99):
        drawn_from = initial_states(torch.cat((start[TRAFFIC], torch.tensor([[NEW, number]])), dim=1))
        assert same(drawn_from.observed, start)
    entities = DOMAIN.observed[TRAFFIC].entities
    assert [columns[0] for columns in entities] == [7, 14, 21, 28]
    assert {len(columns) for columns in entities} == {7}
    assert DOMAIN.observed[SCENARIO].entities == ()


def test_a_drive_is_the_same_on_any_road_and_a_plan_is_followed_by_its_drives() -> None:
    for turn in (0.0, math.pi / 2):  # ten metres straight on, or on an arc of 90 degrees, at 8 m/s
        for road in (0.0, 2.0):
            chord, way = (10 * math.sin(turn / 2) / (turn / 2) if turn else 10.0), road + turn / 2
            before = torch.tensor(vehicle(5, 7, 3, road))
            after = torch.tensor(vehicle(5 + chord * math.cos(way), 7 + chord * math.sin(way), 8, road + turn))
            assert drive(before, after).tolist() == pytest.approx([chord, 0, 8, 0], abs=1e-5)
    plans = straight_on(2.0)
    for step in (0, 3, 20):  # its last once it is at its end
        assert act(plans, step, scene(2.0))[0].tolist() == pytest.approx([8, 0, 8, 0], abs=1e-4)


def test_standing_vehicles_are_resolved_and_absent_ones_are_not_seen() -> None:
    start, view = scene(2.0, 80, -20, KNOWN), VIEWS["standing"]
    torch.testing.assert_close(seen_in(start, view)[:, :-5], seen_in(start))
    torch.testing.assert_close(seen_in(start, view)[0, -5:], torch.tensor([math.exp(-8), math.exp(-4), 0, 0, 0]))
    assert view.features[TRAFFIC].entities[0][-1] == len(seen_in(start)[0]) + 1
