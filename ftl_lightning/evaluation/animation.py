"""Animated GIFs of episodes at a readable speed."""

import io
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ftl_lightning.services.text import line

SECONDS = 4.0
"""Default duration of an animation."""
FRAME_SECONDS = (0.05, 0.8)
"""Minimum and maximum duration of a frame; browsers slow down frames below 0.02 s."""
END_SECONDS = 1.5
"""Additional duration of the last frame."""
COLOURS = 64
"""Default number of colours per picture: more colours preserve small objects but make larger files."""
FONT_SIZE = 14
MARGIN = 6
INK, PAPER = (32, 32, 32), (255, 255, 255)


def frame_milliseconds(count: int, seconds: float | None = None) -> int:
    """Duration of a frame, in the format's steps of 10 ms.

    Args:
        count: number of frames.
        seconds: total duration; ``None`` for about :data:`SECONDS`, within the bounds of :data:`FRAME_SECONDS`.
    """
    low, high = FRAME_SECONDS
    each = min(max(SECONDS / count, low), high) if seconds is None else seconds / count
    return max(10 * round(100 * each), 20)


def gif(
    pictures: Sequence[NDArray[np.uint8]], seconds: float | None = None, pause: float = END_SECONDS, colours: int = COLOURS
) -> bytes:
    """Encode an endless animation.

    Args:
        pictures: ``(height, width, 3)`` each, of equal size.
        seconds: total duration; ``None`` for a readable speed.
        pause: additional seconds of the last picture.
        colours: number of colours per picture, up to 256.
    """
    first, *rest = (Image.fromarray(picture).quantize(colours) for picture in pictures)
    each = frame_milliseconds(len(pictures), seconds)
    last = each + 10 * round(100 * pause)
    content = io.BytesIO()
    durations = [*[each] * len(rest), last]
    first.save(content, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)
    return content.getvalue()


def captioned(pictures: Sequence[NDArray[np.uint8]], text: str, ending: str = "") -> list[NDArray[np.uint8]]:
    """Add a caption below each picture ``(height, width, 3)``; long lines are wrapped.

    Args:
        pictures: pictures of equal size.
        text: caption of every picture.
        ending: additional caption of the last picture, such as the outcome; may be empty.
    """
    if not pictures or not (text or ending):
        return list(pictures)
    font = ImageFont.load_default(FONT_SIZE)
    width = pictures[0].shape[1]
    letters = max(1, int((width - 2 * MARGIN) / font.getlength("n")))
    always, ends = (
        [part for row in words.splitlines() for part in textwrap.wrap(line(row), letters) or [""]] for words in (text, ending)
    )
    spacing = round(1.35 * FONT_SIZE)

    def strip(lines: Sequence[str]) -> NDArray[np.uint8]:
        drawn = Image.new("RGB", (width, spacing * (len(always) + len(ends)) + 2 * MARGIN), PAPER)
        draw = ImageDraw.Draw(drawn)
        for number, part in enumerate(lines):
            draw.text((MARGIN, MARGIN + number * spacing), part, fill=INK, font=font)
        return np.asarray(drawn, dtype=np.uint8)

    below, last = strip(always), strip([*always, *ends])
    return [*(np.concatenate((picture, below)) for picture in pictures[:-1]), np.concatenate((pictures[-1], last))]


def side_by_side(films: Mapping[str, Sequence[NDArray[np.uint8]]]) -> list[NDArray[np.uint8]]:
    """Combine films side by side, each above its name.

    Args:
        films: frames ``(height, width, 3)`` by name, such as the demonstration, our method and the baselines. Shorter films repeat
            the last frame; films of smaller height are aligned at the top.

    Returns:
        Frames ``(height, width, 3)`` for the length of the longest film.
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
    """Outcome of an episode as text.

    Args:
        outcomes: outcomes by name ``(episode,)``, boolean or numeric.
        episode: number of the episode.
    """
    return ", ".join(f"{name}: {_end(values[episode])}" for name, values in outcomes.items())


def _end(value: Tensor) -> str:
    if value.dtype == torch.bool:
        return "yes" if value else "no"
    return f"{value.item():.2f}"
