import itertools

import torch
from matplotlib.figure import Figure

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.driving.rendering import BETWEEN, film, render
from ftl_lightning.domains.driving.shipped import SHIPPED
from ftl_lightning.domains.driving.traffic import TRAFFIC
from ftl_lightning.domains.rollout import Rollout


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


def test_an_episodes_pictures_have_one_size_and_end_when_nothing_moves() -> None:
    shipped = Demonstrations.load(SHIPPED / "exit.safetensors").rows([0])
    states = shipped.states[0]
    observed = {name: values[:, :1].repeat(1, 6, 1) for name, values in shipped.observed.items()}
    observed[TRAFFIC][0, :4, :7] = states[:4]  # the vehicle moves three times
    observed[TRAFFIC][0, 4:, :7] = states[3]
    episode = Rollout(shipped.initial_states, observed, torch.zeros(1, dtype=torch.bool), [{}])
    pictures = film(episode, torch.stack([states[:8]] * 5))
    assert len(pictures) == 3 * BETWEEN + 1
    assert all((one != other).any() for one, other in itertools.pairwise(pictures))  # between decisions, too
    assert len({picture.shape for picture in pictures}) == 1


def test_a_crash_and_an_arrival_are_captioned() -> None:
    shipped = Demonstrations.load(SHIPPED / "exit.safetensors").rows([0])
    states = shipped.states[0]
    observed = {name: values[:, :1].repeat(1, 3, 1) for name, values in shipped.observed.items()}
    observed[TRAFFIC][0, :, :7] = states[:3]
    films = []
    for told in ({"crashed": True}, {"arrived": True, "crashed": False}, {"arrived": False}):
        episode = Rollout(shipped.initial_states, observed, torch.zeros(1, dtype=torch.bool), [told])
        films.append(film(episode, torch.stack([states[:8]] * 2)))
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (films[one][0] == films[other][0]).all()
        assert (films[one][-1] != films[other][-1]).any()
