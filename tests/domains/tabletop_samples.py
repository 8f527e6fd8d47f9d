"""Demonstrations of the table-top that need no simulator."""

from typing import Any

import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.tabletop.interface import IMAGE, PLACES, POSE, STATE_NAMES, STATE_UNITS
from ftl_lightning.domains.tabletop.source import Expert
from ftl_lightning.services.randomness import generator, task_key


def made_up(self: Expert, task: str, count: int, seed: int, **_: bool) -> Demonstrations:
    """Demonstrations in which everything is anywhere, in place of the simulator's."""
    draw = generator("cpu", seed, task_key(task))
    anywhere = torch.rand(count, 6, 5, 4, generator=draw) * torch.tensor([1, 0.4, 0.4, 0.1]) + torch.tensor([0, 0.3, -0.2, 0])
    anywhere[..., 0] = (anywhere[..., 0] > 0.3).float()
    pose = torch.zeros(count, 6, 8)
    pose[..., :3] = anywhere[:, :, 0, 1:]
    image = torch.randint(256, (count, 6, 3, 64, 64), generator=draw, dtype=torch.uint8)
    observed = {IMAGE: image, POSE: pose, PLACES: anywhere}
    kinds: dict[str, Any] = {
        "domain": self.domain,
        "state_names": STATE_NAMES,
        "state_units": STATE_UNITS,
        "per_step": tuple(observed),
    }
    return Demonstrations(
        states=pose[..., [0, 1, 2, 7]], lengths=torch.full((count,), 6), concepts=(task,) * count, observed=observed, **kinds
    )
