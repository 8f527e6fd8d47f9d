"""Parts of a Gymnasium observation: the states of a demonstration, and observed features.

In a dictionary, the part ``'observation'`` or the only vector holds the states, and other vectors are observed features. Needs the
package ``gymnasium``, which every environment brings.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from ftl_lightning.services.errors import UserError, short

PART = "observation"
"""Part with the states in observations of several parts, as in Gymnasium's environments with goals."""


def states_part(space: gymnasium.Space[Any], part: str = "") -> str:
    """Key of the states in an observation.

    Args:
        space: observation space.
        part: requested key; empty for :data:`PART` or the only vector.

    Returns:
        A key; empty if an observation is itself a vector.

    Raises:
        UserError: if the part is no vector or ambiguous.
    """
    if not isinstance(space, gymnasium.spaces.Dict):
        vectors = [""] if _is_vector(space) else []
        expected = "observations that are vectors (a Box of numbers)"
    else:
        vectors = [key for key, box in space.spaces.items() if _is_vector(box)]
        keys = ", ".join(vectors) or "none"
        expected = f"observations with one vector or {PART!r}, or the key of the states, one of {keys}"
    if not part and (PART in vectors or len(vectors) == 1):
        return PART if PART in vectors else vectors[0]
    if not part or part not in vectors:
        raise UserError(f"expected {expected}, found {repr(part) if part else type(space).__name__}")
    return part


def feature_parts(
    space: gymnasium.Space[Any], states: str, observed: Sequence[str] | None = None, *, images: bool = False
) -> tuple[str, ...]:
    """Keys of the observed features in an observation.

    Args:
        space: observation space.
        states: key of the states, which is excluded unless requested.
        observed: requested keys; ``None`` for all other vectors.
        images: whether to include images (uint8).

    Raises:
        UserError: for a key without such a part.
    """
    parts = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {}
    known = [key for key, box in parts.items() if _is_vector(box) or (images and isinstance(box, Box))]
    if observed is None:
        return tuple(key for key in known if key != states)
    for key in observed:
        if key not in known:
            raise UserError(f"observed: expected some of {', '.join(known) or 'none'}, found {short(key)!r}")
    return tuple(observed)


def _is_vector(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and space.dtype != np.uint8  # the type of images
