import io

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from ftl_lightning.evaluation.pictures import captioned, frame_milliseconds, gif, outcome_text


def pictures(count: int) -> list[NDArray[np.uint8]]:
    return [np.full((30, 120, 3), 5 * number, dtype=np.uint8) for number in range(count)]


def durations(content: bytes) -> list[int]:
    return [frame.info["duration"] for frame in ImageSequence.Iterator(Image.open(io.BytesIO(content)))]


@pytest.mark.parametrize("count", [3, 9, 40])
def test_an_animation_can_be_followed_whatever_its_number_of_frames(count: int) -> None:
    found = durations(gif(pictures(count)))
    assert len(found) == count
    assert Image.open(io.BytesIO(gif(pictures(count)))).info["loop"] == 0
    assert len(set(found[:-1])) == 1
    assert 3000 <= sum(found) <= 6000
    assert found[-1] == found[0] + 1500  # it rests at the end


def test_speed_and_pause_can_be_chosen() -> None:
    assert durations(gif(pictures(4), seconds=2, pause=0.5)) == [500, 500, 500, 1000]
    assert durations(gif(pictures(1), seconds=2, pause=0))[0] in (0, 2000)  # a single picture moves nothing
    assert frame_milliseconds(1000, seconds=1) == 20  # browsers slow down what is shorter
    assert frame_milliseconds(2) == 800


def test_a_caption_stands_below_every_picture_and_breaks_its_lines() -> None:
    plain = pictures(2)
    short, long = (captioned(plain, text) for text in ("goal", "a goal that is told in many more words than fit"))
    for one, other in zip(short, plain, strict=True):
        assert np.array_equal(one[:30], other)
        assert one.shape[1] == 120
        assert (one[30:] < 128).any()  # ink
    assert len(long[0]) > len(short[0]) > 30
    edge = long[0][30:, -4:]
    assert (edge == 255).all()  # nothing runs out of the picture
    assert captioned(plain, "")[0].shape == plain[0].shape


def test_how_it_ended_is_told_in_words_and_stands_below_the_last_picture_alone() -> None:
    plain = pictures(3)
    first, second, last = captioned(plain, "goal", "success: yes")
    assert first.shape == second.shape == last.shape
    alone = captioned(plain, "goal")[0]
    assert np.array_equal(first[: len(alone) - 6], alone[:-6])
    assert (first[len(alone) - 6 :] == 255).all()
    assert np.array_equal(first[30:], second[30:])
    assert (last[len(alone) - 6 :] < 128).any()
    outcomes = {"success": torch.tensor([True, False]), "return": torch.tensor([1.0, 2.345])}
    assert outcome_text(outcomes) == "success: yes, return: 1.00"
    assert outcome_text(outcomes, 1) == "success: no, return: 2.35"
    assert outcome_text({}) == ""
