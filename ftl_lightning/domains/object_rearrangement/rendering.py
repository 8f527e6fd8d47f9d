"""Pictures of scenes with a green frame if the task holds, else red (as in the paper's figures), and scenes arranged by hand."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, RegularPolygon
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.films import VectorFilm, regular, still
from ftl_lightning.domains.object_rearrangement.domain import CENTRES, NAME, PLANS
from ftl_lightning.domains.object_rearrangement.scenes import EXTENT, PER_SHAPE, SHAPES, plain_scene
from ftl_lightning.domains.pictures import framed
from ftl_lightning.domains.recorder import Numbers, Piece, Scene

COLOURS = {"circle": "#e4704a", "triangle": "#4c9f70", "square": "#4a78c8"}
CORNERS = {"triangle": 3, "square": 4}
MAX_COLUMNS = 8
MARGIN = 1.0  # the largest radius


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None = None) -> Figure:
    """Draw a grid of scenes ``(scene, 1, 21)``; frames are green where the task holds, red where not, grey for ``None``."""
    figure = framed(len(states), right, title, MAX_COLUMNS, (1.5, 1.5))
    for axes, state in zip(figure.axes, states[:, 0], strict=False):
        for shape, (x, y, radius, angle, *_) in zip(SHAPES, state.unflatten(0, (len(SHAPES), PER_SHAPE)).tolist(), strict=True):
            size = max(radius, 0.0)
            if shape in CORNERS:
                patch: Patch = RegularPolygon((x, y), CORNERS[shape], radius=size, orientation=angle, color=COLOURS[shape])
            else:
                patch = Circle((x, y), size, color=COLOURS[shape])
            axes.add_patch(patch)
        axes.set(xlim=(-MARGIN, EXTENT + MARGIN), ylim=(-MARGIN, EXTENT + MARGIN), xticks=[], yticks=[])
    return figure


def vector_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Still film of a scene ``(1, 21)``."""
    shapes = []
    for shape, (x, y, radius, angle, *_) in zip(SHAPES, states[0].unflatten(0, (len(SHAPES), PER_SHAPE)).tolist(), strict=True):
        size = max(radius, 0.0)
        if shape in CORNERS:
            turned = math.pi / 2 + angle  # like matplotlib, whose polygons begin at the top
            shapes.append(still("area", regular(CORNERS[shape], size, turned) + np.array((x, y)), COLOURS[shape]))
        else:
            shapes.append(still("dots", [(x, y)], COLOURS[shape], size))
    return VectorFilm(shapes, (-MARGIN, -MARGIN, EXTENT + 2 * MARGIN, EXTENT + 2 * MARGIN), 1.0)


def scene(task: str, seed: int) -> Scene:
    """Three shapes of new sizes without any training relation, for any task."""
    state = plain_scene(seed)
    places = state[list(CENTRES)].reshape(len(SHAPES), 2).tolist()
    pieces = tuple(Piece(shape, (x, y), (number,)) for number, (shape, (x, y)) in enumerate(zip(SHAPES, places, strict=True)))
    return Scene(vector_film(state[None], None), pieces, state=state)


def record(initial: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
    """Scene ``(1, 1, 21)`` with the shapes at the last places of a path ``(step, 3, 2)``, centres clipped to [0,
    :data:`EXTENT`].
    """
    assert initial.state is not None  # set by `scene`
    state = initial.state.clone()
    state[list(CENTRES)] = torch.from_numpy(path[-1]).float().clamp(0, EXTENT).flatten()
    return Demonstrations(
        states=state[None, None],
        lengths=torch.ones(1, dtype=torch.int64),
        domain=NAME,
        state_names=PLANS.columns,
        state_units=PLANS.units,
        concepts=("",),
        provenance={"generator": "by hand"},
    )
