"""Lines drawn by hand, for generic behaviour of two columns."""

import numpy as np
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.hand_line import at_even_steps, reached, smoothed
from ftl_lightning.domains.recorder import Numbers, Recorder, Scene
from ftl_lightning.domains.vector_film import VectorFilm, still
from ftl_lightning.services.errors import UserError

MARGIN = 0.15
"""Margin of the window around the examples, relative to their extent."""
SHORTEST = 0.02
"""Minimum length of a line, relative to the window's width."""
PIXEL = 1 / 400
"""Approximate size of a screen pixel relative to the window's width; scale of smoothing."""
FRAME = "#dfe3e8"


def drawn_by_hand(examples: Demonstrations, horizon: int) -> Recorder | None:
    """Recorder of drawn lines; ``None`` if behaviour is not a line in a plane.

    Args:
        examples: demonstrations, which determine the window.
        horizon: states of a plan and of a drawn line.
    """
    if examples.states.shape[2] != 2 or horizon < 2 or examples.observed:
        return None
    covered = torch.cat([states[:length] for states, length in zip(examples.states, examples.lengths.tolist(), strict=True)])
    low, high = covered.amin(dim=0).double().numpy(), covered.amax(dim=0).double().numpy()
    middle, side = (low + high) / 2, max(float((high - low).max()), 1e-6)
    corners = middle + side / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    half = side * (0.5 + MARGIN)
    window = (float(middle[0]) - half, float(middle[1]) - half, 2 * half, 2 * half)
    seen = Scene(VectorFilm((still("line", corners, FRAME),), window, 1.0))

    def record(scene: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
        line, width = path[:, 0], scene.film.window[2]
        if (length := reached(line)[-1]) < SHORTEST * width:
            raise UserError(
                f"line: expected one longer than {SHORTEST:.0%} of the window, found {length / width:.1%}; draw it again"
            )
        # Even steps along the line, not in time: the speed of the hand is accidental, and states would accumulate at pauses.
        states = at_even_steps(smoothed(line, PIXEL * width), horizon)
        return Demonstrations(
            states=torch.from_numpy(states).float()[None],
            lengths=torch.tensor([horizon]),
            domain=examples.domain,
            state_names=examples.state_names,
            state_units=examples.state_units,
            concepts=("",),
            provenance={"generator": "by hand"},
        )

    return Recorder(
        "draw", "Draw one line of the kind that you mean; how fast you draw does not matter.", lambda task, seed: seen, record
    )
