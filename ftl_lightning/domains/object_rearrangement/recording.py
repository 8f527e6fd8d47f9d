"""Scenes arranged by hand."""

import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.object_rearrangement.domain import CENTRES, NAME, PLANS
from ftl_lightning.domains.object_rearrangement.generation import plain_scene
from ftl_lightning.domains.object_rearrangement.relations import EXTENT, SHAPES
from ftl_lightning.domains.object_rearrangement.rendering import vector_film
from ftl_lightning.domains.recorder import Numbers, Piece, Scene


def scene(task: str, seed: int) -> Scene:
    """Three shapes of new sizes without any training relation.

    Args:
        task: unused.
        seed: seed of sizes, angles and places.
    """
    state = plain_scene(seed)
    places = state[list(CENTRES)].reshape(len(SHAPES), 2).tolist()
    pieces = tuple(Piece(shape, (x, y), (number,)) for number, (shape, (x, y)) in enumerate(zip(SHAPES, places, strict=True)))
    return Scene(vector_film(state[None], None), pieces, state=state)


def record(seen: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
    """Scene ``(1, 1, 21)`` with the shapes at their final places, centres clipped to [0, :data:`EXTENT`].

    Args:
        seen: initial scene.
        path: ``(step, 3, 2)`` in length units; only the last step counts.
        seconds: unused.
    """
    assert seen.state is not None  # set by `scene`
    state = seen.state.clone()
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
