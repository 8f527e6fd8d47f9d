"""Standing poses made by rule, for those who have no recordings: where a shipped model's behaviour starts."""

import torch
from torch import Tensor

from ftl_lightning.domains.mocap.skeleton import COLUMNS

_RIGHT_SIDE = (
    (0.09, 0.0, 0.0),
    (0.09, 0.02, -0.40),
    (0.09, -0.03, -0.83),
    (0.18, 0.01, 0.51),
    (0.21, -0.04, 0.22),
    (0.22, 0.03, 0.05),
)
"""Hip, knee, ankle, shoulder, elbow, wrist in metres, of an adult of middle size."""
_MIDDLE = ((0.0, 0.02, 0.55), (0.0, 0.07, 0.73))


def standing_poses(count: int, draw: torch.Generator) -> Tensor:
    """Poses ``(count, 42)`` of people of different sizes who stand with their arms down."""
    right = torch.tensor(_RIGHT_SIDE)
    left = right * torch.tensor((-1.0, 1.0, 1.0))
    body = torch.cat((right[:3], left[:3], right[3:], left[3:], torch.tensor(_MIDDLE)))
    size = 1 + 0.05 * (2 * torch.rand(count, 1, 1, generator=draw) - 1)
    return (body * size).reshape(count, len(COLUMNS))
