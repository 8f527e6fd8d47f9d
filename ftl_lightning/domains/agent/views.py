"""Views of a drive: states as in files, or differences between states (``steps``)."""

import itertools

import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.domains.agent.scenes import FEATURE, OBSERVED, STATE
from ftl_lightning.domains.domain import View


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """Difference of each state ``(sample, horizon, 13)`` from the preceding state; the first from the present."""
    return torch.diff(states, dim=1, prepend=observed[OBSERVED][:, None, :STATE])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """Inverse of :func:`_encode_steps`."""
    # Not cumsum, which has no deterministic form on GPUs.
    return torch.stack(list(itertools.accumulate(steps.unbind(dim=1), initial=observed[OBSERVED][:, :STATE]))[1:], dim=1)


VIEWS = {"steps": View({OBSERVED: FEATURE}, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps)}
"""With ``steps``, autoregressive methods need not copy the state, which changes by about 1% per step."""
