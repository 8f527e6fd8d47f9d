"""A path with a missing part is told from a whole one, at any place, size and pace."""

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
from ftl_lightning.apps.play.mixing import judge_of, judged
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.outline import Outline
from ftl_lightning.few_shot.learner import FewShot


def drawn(kind: str, count: int, seed: int) -> Demonstrations:
    return Demonstrations.of(list(strokes(kind, count, seed)), kind)


def straight(states: torch.Tensor, first: int, last: int) -> torch.Tensor:
    """Paths with a straight line in place of a part."""
    share = torch.linspace(0, 1, last - first)[None, :, None]
    cut = states.clone()
    cut[:, first:last] = states[:, first, None] * (1 - share) + states[:, last - 1, None] * share
    return cut


@pytest.fixture(scope="module")
def outline() -> Outline:
    return Outline(concatenate([drawn(kind, 10, 7) for kind in TRAINING]), 40)


@pytest.mark.parametrize("kind", ["heart", "spiral", "figure eight", "wave"])
def test_a_missing_part_is_seen_and_fresh_paths_are_whole(outline: Outline, kind: str) -> None:
    five, fresh = drawn(kind, 5, 1), drawn(kind, 50, 9).states
    for states in (fresh, 3 * fresh + 50):  # place and size are not parts
        whole = outline.whole(states, {}, five)
        assert whole is not None
        assert whole.float().mean() >= 0.75
    at = torch.linspace(0, 1, 40) ** 1.1 * 39  # another pace
    low = at.long().clamp(max=38)
    share = (at - low)[None, :, None]
    for states, least in ((fresh[:, low] * (1 - share) + fresh[:, low + 1] * share, 0.5), (five.states, 1.0)):
        whole = outline.whole(states, {}, five)
        assert whole is not None
        assert whole.float().mean() >= least
    broken = fresh.clone()
    broken[:, 3, 0] = torch.nan
    end = fresh.clone()
    end[:, 26:] = fresh[:, 26, None]
    for states in (straight(fresh, 24, 40), end, fresh + 0.3 * torch.randn(fresh.shape, generator=torch.Generator()), broken):
        whole = outline.whole(states, {}, five)
        assert whole is not None
        assert whole.float().mean() <= 0.3


def test_a_missing_part_and_what_stands_in_its_place_are_found(outline: Outline) -> None:
    fresh, five = drawn("heart", 30, 9).states, drawn("heart", 5, 1)
    cut = 3 * straight(fresh, 20, 34) + 50
    whole = outline.whole(cut, {}, five)
    assert whole is not None
    middle, missing = cut[:, 27], 3 * fresh[:, 27] + 50  # of the line, and of the part that it replaces
    apart = (middle - missing).norm(dim=1)
    faults, near = outline.faults(cut, {}, five), []
    for row in (~whole).nonzero().flatten().tolist():
        points = torch.cat(faults[row])
        near.append(min((points - place).norm(dim=1).min() for place in (middle[row], missing[row])) < apart[row])
    assert len(near) >= 20
    assert sum(near) >= 0.8 * len(near)
    assert outline.faults(five.states, {}, five) == [[]] * 5


def test_where_places_are_observed_a_path_is_compared_there() -> None:
    def walks(count: int, seed: int, share: float, text: str) -> Demonstrations:
        draw = np.random.default_rng(seed)
        place = draw.uniform(-1, 1, (count, 2))
        paths = share * place[:, None] * np.linspace(0, 1, 12)[None, :, None] + 0.02 * draw.standard_normal((count, 12, 2))
        return Demonstrations.of(list(paths), text, observed={"place": torch.from_numpy(place).float()})

    outline = Outline(concatenate([walks(8, number, share, f"{share}") for number, share in enumerate((-0.5, 0.2, 1.0, 1.4))]), 12)
    five, fresh = walks(5, 20, 0.6, "new"), walks(60, 21, 0.6, "new")
    whole = outline.whole(fresh.states, fresh.observed, five)
    assert whole is not None
    assert whole.float().mean() > 0.8
    elsewhere = {"place": fresh.observed["place"].roll(1, dims=0)}
    wrong = outline.whole(fresh.states, elsewhere, five)
    assert wrong is not None
    assert wrong.float().mean() < 0.3
    first = {"place": fresh.observed["place"][:1]}
    (missing,) = outline.faults(fresh.states[:1] - elsewhere["place"][:1, None], first, five)
    lost = torch.cat(missing)
    assert (lost - 0.6 * fresh.observed["place"][0]).norm(dim=1).min() < 0.1  # at the place that is observed


def test_a_single_demonstration_or_state_is_no_reason_to_fail(outline: Outline) -> None:
    assert outline.whole(drawn("heart", 3, 0).states, {}, drawn("heart", 1, 1)) is None
    assert Outline(drawn("heart", 2, 0), 40).whole(drawn("heart", 3, 0).states, {}, drawn("heart", 2, 1)) is None
    draw = np.random.default_rng(0)
    points = [Demonstrations.of(list(draw.normal(size=(6, 1, 3)) + 5 * number), f"{number}") for number in range(3)]
    single = Outline(concatenate(points[:2]), 1)
    near, far = (single.whole(points[number].states, {}, points[1]) for number in (1, 2))
    assert near is not None
    assert far is not None
    assert near.all()
    assert not far.any()


def test_the_page_of_play_gives_no_tick_to_a_figure_without_a_part() -> None:
    model = FewShot.from_pretrained("strokes")
    five, fresh = drawn("heart", 5, 1), drawn("heart", 20, 9)
    known = model.demonstrations(five.states.numpy(), name="heart")
    plans = [model.demonstrations(states.numpy(), name="heart") for states in (fresh.states, straight(fresh.states, 24, 40))]
    judge = judge_of(model, [known])
    (shown, words), (cut, none) = (judged(model.model, judge, some, "heart") for some in plans)
    assert sum(film["right"] for film in shown) >= 14
    assert "% of 20 samples alike (nearest shape, parts: heart)" in words
    assert sum(film["right"] for film in cut) <= 1
    assert none.startswith(("0%", "5%"))
    assert judged(model.model, judge, plans[0], "")[1] == ""
