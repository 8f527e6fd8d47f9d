"""Scenes arranged by hand."""

import torch

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.object_rearrangement.domain import CENTRES, NAME, PLANS
from ftl_lightning.domains.object_rearrangement.generation import plain_scene
from ftl_lightning.domains.object_rearrangement.relations import EXTENT, SHAPES
from ftl_lightning.domains.object_rearrangement.rendering import vector_film
from ftl_lightning.domains.recorder import Numbers, Piece, Scene


def scene(task: str, seed: int) -> Scene:
    """Three shapes of new sizes, which show no relation of training yet.

    Args:
        task: does not matter.
        seed: of sizes, angles and places.
    """
    state = plain_scene(seed)
    places = state[list(CENTRES)].reshape(len(SHAPES), 2).tolist()
    pieces = tuple(Piece(shape, (x, y), (number,)) for number, (shape, (x, y)) in enumerate(zip(SHAPES, places, strict=True)))
    return Scene(vector_film(state[None], None), pieces, state=state)


def record(seen: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
    """One scene ``(1, 1, 21)`` with the shapes where they were put, their centres kept in [0, :data:`EXTENT`].

    Args:
        seen: the scene before.
        path: ``(step, 3, 2)`` in length units, of which the last step counts.
        seconds: do not matter.
    """
    assert seen.state is not None  # of every scene of this domain
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
