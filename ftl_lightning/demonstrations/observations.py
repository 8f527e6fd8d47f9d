"""Which parts of a Gymnasium observation are the states of a demonstration, and which are observed features.

Where an observation is a dictionary, its part ``'observation'`` is the states, or its only vector, and its other vectors are
observed features. Needs the package ``gymnasium``, which every environment brings.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from ftl_lightning.errors import UserError, short

PART = "observation"
"""Part of an observation that holds the states where it has several, as in Gymnasium's environments with goals."""


def states_part(space: gymnasium.Space[Any], part: str = "") -> str:
    """Which part of an observation holds the states.

    Args:
        space: of the observations.
        part: the key that is asked for; empty for :data:`PART` or the only vector.

    Returns:
        A key; empty where an observation is a vector itself.

    Raises:
        UserError: where that is no vector, or not clear.
    """
    if not isinstance(space, gymnasium.spaces.Dict):
        vectors = [""] if _is_vector(space) else []
        expected = "observations that are vectors (a Box of numbers)"
    else:
        vectors = [key for key, own in space.spaces.items() if _is_vector(own)]
        told = ", ".join(vectors) or "none"
        expected = f"observations with one vector or {PART!r}, or the key of the states, one of {told}"
    if not part and (PART in vectors or len(vectors) == 1):
        return PART if PART in vectors else vectors[0]
    if not part or part not in vectors:
        raise UserError(f"expected {expected}, found {repr(part) if part else type(space).__name__}")
    return part


def feature_parts(
    space: gymnasium.Space[Any], states: str, observed: Sequence[str] | None = None, *, images: bool = False
) -> tuple[str, ...]:
    """Keys of an observation's parts that are observed features.

    Args:
        space: of the observations.
        states: the part that holds the states, which is none unless it is asked for.
        observed: keys that are asked for; ``None`` for every other vector.
        images: whether images (uint8) count as vectors do.

    Raises:
        UserError: for a key that no such part has.
    """
    parts = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {}
    known = [key for key, one in parts.items() if _is_vector(one) or (images and isinstance(one, Box))]
    if observed is None:
        return tuple(key for key in known if key != states)
    for key in observed:
        if key not in known:
            raise UserError(f"observed: expected some of {', '.join(known) or 'none'}, found {short(key)!r}")
    return tuple(observed)


def _is_vector(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and space.dtype != np.uint8  # which images are
