"""Pictures and films of behaviour of which nothing but its columns is known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from ftl_lightning.domains.pictures import MAX_COLUMNS, film, line_drawings


def plans(count: int, time: int, columns: int) -> torch.Tensor:
    return torch.randn((count, time, columns), generator=torch.Generator().manual_seed(0)).cumsum(dim=1)


def drawn(states: torch.Tensor, right: list[bool] | None = None) -> Figure:
    names = [f"column {number}" for number in range(states.shape[2])]
    return line_drawings(names).picture(states, right, "a title", None)


@pytest.mark.parametrize("columns", [2, 3])
def test_behaviour_in_space_is_a_path_from_a_marked_start(columns: int) -> None:
    states = plans(3, 20, columns)
    figure = drawn(states)
    assert figure.get_suptitle() == "a title"
    assert len(figure.axes) == 3
    for axes, plan in zip(figure.axes, states, strict=True):
        assert axes.name == ("3d" if columns == 3 else "rectilinear")
        path, start = axes.lines
        lines = path.get_data_3d() if columns == 3 else path.get_data()  # type: ignore[attr-defined]
        np.testing.assert_allclose(np.stack(lines, axis=1), plan)
        begun = start.get_data_3d() if columns == 3 else start.get_data()  # type: ignore[attr-defined]
        np.testing.assert_allclose(np.stack(begun, axis=1), plan[:1])
    assert len({axes.get_xlim() for axes in figure.axes}) == 1  # all on one scale


@pytest.mark.parametrize(("units", "name"), [(("m", "m", "m/s"), "rectilinear"), (("m",) * 3, "3d"), (("m", "s", "s"), "3d")])
def test_of_a_path_with_a_speed_the_path_is_drawn(units: tuple[str, ...], name: str) -> None:
    states = plans(2, 20, 3)
    show = line_drawings(("x", "y", "speed"), units)
    figure = show.picture(states, None, "a title", None)
    assert {axes.name for axes in figure.axes} == {name}
    if name == "rectilinear":
        np.testing.assert_allclose(np.stack(figure.axes[0].lines[0].get_data(), axis=1), states[0, :, :2])
        assert show.film is not None
        np.testing.assert_array_equal(show.film(states[0])[-1], film(states[0, :, :2])[-1])


@pytest.mark.parametrize("columns", [1, 4, 20])
def test_other_behaviour_is_a_line_over_time_for_each_column(columns: int) -> None:
    states = plans(2, 20, columns)
    figure = drawn(states)
    for axes, plan in zip(figure.axes, states, strict=True):
        assert len(axes.lines) == columns
        np.testing.assert_allclose(np.stack([line.get_ydata() for line in axes.lines], axis=1), plan)  # type: ignore[arg-type]
    legend = figure.axes[0].get_legend()
    assert (legend is not None) == (columns <= MAX_COLUMNS)
    if legend is not None:
        assert [text.get_text() for text in legend.get_texts()] == [f"column {number}" for number in range(columns)]


@pytest.mark.parametrize("states", [plans(2, 10, 2), plans(2, 10, 5)], ids=["path", "lines"])
def test_right_ones_are_framed_green_and_wrong_ones_red(states: torch.Tensor) -> None:
    for right, colours in (([True] * 2, {(46, 158, 70)}), ([False, True], {(46, 158, 70), (208, 58, 58)}), (None, set())):
        drawn(states, right).savefig("f.png", dpi=100)
        pixels = np.asarray(Image.open("f.png").convert("RGB")).reshape(-1, 3).astype(int)
        for colour in ((46, 158, 70), (208, 58, 58)):
            assert ((np.abs(pixels - colour).sum(axis=1) < 12).sum() > 200) == (colour in colours)


def test_many_plans_stand_in_rows_and_single_states_and_behaviour_that_stands_still_are_drawn_too() -> None:
    figure = drawn(plans(MAX_COLUMNS + 3, 5, 2))
    assert len(figure.axes) == 2 * MAX_COLUMNS
    assert sum(axes.axison for axes in figure.axes) == MAX_COLUMNS + 3
    for columns in (2, 3, 5):
        assert all(len(axes.lines) == columns for axes in drawn(plans(2, 1, columns)).axes)
        drawn(torch.zeros(2, 10, columns)).savefig("f.png")
        assert Path("f.png").stat().st_size > 500


@pytest.mark.parametrize("columns", [2, 3])
@pytest.mark.parametrize(("time", "frames"), [(1, 1), (5, 5), (18, 6)])
def test_a_film_shows_the_path_as_it_is_drawn(columns: int, time: int, frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftl_lightning.domains.pictures.MAX_FRAMES", 6)
    found = film(plans(1, time, columns)[0])
    assert len(found) == frames
    assert {one.shape for one in found} == {found[0].shape}
    assert found[0].dtype == np.uint8
    # Colour grows frame by frame: the drawn part of the path is blue on grey.
    blue = [int((one[..., 2].astype(int) - one[..., 0] > 60).sum()) for one in found]
    assert blue == sorted(blue) or min(np.diff(blue)) > -40  # a line's ends are smoothed
    assert time == 1 or blue[-1] > blue[0] + 50
