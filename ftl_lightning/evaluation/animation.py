"""Animated GIFs of episodes, at a speed at which they can be followed."""

import io
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ftl_lightning.printing import line

SECONDS = 4.0
"""An animation takes, if its frames allow it."""
FRAME_SECONDS = (0.05, 0.8)
"""The shortest and the longest that a frame is shown; browsers slow down what is shorter than 0.02 s."""
END_SECONDS = 1.5
"""The last frame stays, before the animation starts again."""
COLOURS = 64
"""Of a picture: more make files larger, but small things keep theirs in large pictures."""
FONT_SIZE = 14
MARGIN = 6
INK, PAPER = (32, 32, 32), (255, 255, 255)


def frame_milliseconds(count: int, seconds: float | None = None) -> int:
    """How long each of some frames is shown, in the format's steps of 10 ms.

    Args:
        count: of frames.
        seconds: that all of them take together; ``None`` for about :data:`SECONDS`, within the bounds of :data:`FRAME_SECONDS`.
    """
    low, high = FRAME_SECONDS
    each = min(max(SECONDS / count, low), high) if seconds is None else seconds / count
    return max(10 * round(100 * each), 20)


def gif(
    pictures: Sequence[NDArray[np.uint8]], seconds: float | None = None, pause: float = END_SECONDS, colours: int = COLOURS
) -> bytes:
    """An endless animation.

    Args:
        pictures: ``(height, width, 3)`` each, of one size.
        seconds: that all pictures take together; ``None`` for a speed at which their number can be followed.
        pause: seconds that the last picture stays longer.
        colours: of each picture, up to 256.
    """
    first, *rest = (Image.fromarray(picture).quantize(colours) for picture in pictures)
    each = frame_milliseconds(len(pictures), seconds)
    last = each + 10 * round(100 * pause)
    content = io.BytesIO()
    durations = [*[each] * len(rest), last]
    first.save(content, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)
    return content.getvalue()


def captioned(pictures: Sequence[NDArray[np.uint8]], text: str, ending: str = "") -> list[NDArray[np.uint8]]:
    """Pictures ``(height, width, 3)`` with a caption below each; long lines are broken where the picture ends.

    Args:
        pictures: of one size.
        text: below each.
        ending: below that of the last, such as an outcome, which nobody knows before; empty for nothing.
    """
    if not pictures or not (text or ending):
        return list(pictures)
    font = ImageFont.load_default(FONT_SIZE)
    width = pictures[0].shape[1]
    letters = max(1, int((width - 2 * MARGIN) / font.getlength("n")))
    told, ends = (
        [part for one in words.splitlines() for part in textwrap.wrap(line(one), letters) or [""]] for words in (text, ending)
    )
    spacing = round(1.35 * FONT_SIZE)

    def strip(lines: Sequence[str]) -> NDArray[np.uint8]:
        drawn = Image.new("RGB", (width, spacing * (len(told) + len(ends)) + 2 * MARGIN), PAPER)
        draw = ImageDraw.Draw(drawn)
        for number, part in enumerate(lines):
            draw.text((MARGIN, MARGIN + number * spacing), part, fill=INK, font=font)
        return np.asarray(drawn, dtype=np.uint8)

    below, last = strip(told), strip([*told, *ends])
    return [*(np.concatenate((picture, below)) for picture in pictures[:-1]), np.concatenate((pictures[-1], last))]


def side_by_side(films: Mapping[str, Sequence[NDArray[np.uint8]]]) -> list[NDArray[np.uint8]]:
    """Films beside one another, each above its name.

    Args:
        films: frames ``(height, width, 3)`` by name, such as the demonstration, ours and the baselines. Shorter films keep
            their last frame, lower ones stand at the top.

    Returns:
        Frames ``(height, width, 3)``, as many as the longest film has.
    """
    rows = [captioned(film, name) for name, film in films.items() if len(film)]
    height = max((row[0].shape[0] for row in rows), default=0)
    length = max(map(len, rows), default=0)
    pictures = []
    for time in range(length):
        parts = []
        for row in rows:
            picture = row[min(time, len(row) - 1)]
            below = np.full((height - picture.shape[0], picture.shape[1], 3), PAPER, dtype=np.uint8)
            parts.append(np.concatenate((picture, below)))
        pictures.append(np.concatenate(parts, axis=1))
    return pictures


def outcome_text(outcomes: Mapping[str, Tensor], episode: int = 0) -> str:
    """How an episode ended, in words.

    Args:
        outcomes: a domain's judgement of episodes, by name ``(episode,)``; of bool, or numbers.
        episode: which one.
    """
    return ", ".join(f"{name}: {_end(values[episode])}" for name, values in outcomes.items())


def _end(value: Tensor) -> str:
    if value.dtype == torch.bool:
        return "yes" if value else "no"
    return f"{value.item():.2f}"
