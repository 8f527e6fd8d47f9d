"""How a model may see a drive: as it stands in files, or in steps."""

import itertools

import torch
from torch import Tensor

from ftl_lightning.domains.agent.scenes import STATE
from ftl_lightning.domains.domain import View


def _encode_steps(states: Tensor, initial_states: Tensor) -> Tensor:
    """How each state ``(sample, horizon, 13)`` differs from the one before; the first, from the present."""
    return torch.diff(states, dim=1, prepend=initial_states[:, None, :STATE])


def _decode_steps(steps: Tensor, initial_states: Tensor) -> Tensor:
    """The inverse."""
    # Not cumsum, which has no deterministic form on GPUs.
    return torch.stack(list(itertools.accumulate(steps.unbind(dim=1), initial=initial_states[:, :STATE]))[1:], dim=1)


VIEWS = {"steps": View(encode=_encode_steps, decode=_decode_steps, observe=lambda initial_states: initial_states)}
"""In ``steps`` methods that go from one state to the next need not copy the state, of which a step changes a hundredth."""
