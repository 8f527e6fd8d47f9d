"""Figures and films of traffic."""

import itertools

import pytest
import torch
from matplotlib.figure import Figure

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.rendering import film, render
from ftl_lightning.domains.driving.traffic import SHIPPED, TRAFFIC
from ftl_lightning.domains.execution import Rollout

EXIT = Demonstrations.load(SHIPPED / "exit.safetensors").rows([0])


def panels(figure: Figure) -> int:
    return sum(axes.axison for axes in figure.axes)


def test_a_figure_shows_at_most_eight_plans_and_says_what_the_colours_mean() -> None:
    shipped = Demonstrations.load(SHIPPED / "exit.safetensors").rows(range(10))
    starts = shipped.initial_states
    figure = render(shipped.states[:, :8], None, "exit", starts)
    assert panels(figure) == 8
    assert figure.get_suptitle() == "exit (8 of 10 shown)"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["controlled vehicle, its way", "other vehicles", "plan"]
    for axes in figure.axes[:8]:
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert max(abs(right - left), abs(top - bottom)) < 2 * min(abs(right - left), abs(top - bottom))  # no stamps, no strips
    few = render(shipped.states[:3, :8], [True, False, True], "exit", starts.take(slice(0, 3)))
    assert panels(few) == 3
    assert few.get_suptitle() == "exit"


def episode(seen: torch.Tensor, **info: bool) -> Rollout:
    """An episode from the shipped exit in which the controlled vehicle is seen in these states ``(time, 7)``."""
    observed = {name: values[:, :1].repeat(1, len(seen), 1) for name, values in EXIT.observed.items()}
    observed[TRAFFIC][0, :, :7] = seen
    return Rollout(EXIT.initial_states, observed, torch.zeros(1, dtype=torch.bool), [info])


@pytest.mark.slow
def test_pictures_of_an_episode_have_one_size_end_when_nothing_moves_and_tell_a_crash_and_an_arrival(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ftl_lightning.domains.driving.rendering.BETWEEN", 2)
    states = EXIT.states[0]
    moving = episode(states[[0, 1, 1, 1]])  # the vehicle moves once
    pictures = film(moving, torch.stack([states[:8]] * 3))
    assert len(pictures) == 2 + 1
    assert all((one != other).any() for one, other in itertools.pairwise(pictures))  # between decisions, too
    assert len({picture.shape for picture in pictures}) == 1
    monkeypatch.setattr("ftl_lightning.domains.driving.rendering.BETWEEN", 1)
    infos = ({"crashed": True}, {"arrived": True, "crashed": False}, {"arrived": False})
    films = [film(episode(states[:2], **info), states[None, :8]) for info in infos]
    for one, other in itertools.combinations(films, 2):
        assert (one[0] == other[0]).all()
        assert (one[-1] != other[-1]).any()
