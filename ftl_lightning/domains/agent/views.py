"""Views of a drive: states as in files, or changes from one state to the next (``steps``)."""

import itertools

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.domains.agent.scenes import FEATURE, OBSERVED, STATE
from ftl_lightning.domains.domain import View


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """How each state ``(sample, horizon, 13)`` differs from the one before; the first, from the present."""
    return torch.diff(states, dim=1, prepend=observed[OBSERVED][:, None, :STATE])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """The inverse."""
    # Not cumsum, which has no deterministic form on GPUs.
    return torch.stack(list(itertools.accumulate(steps.unbind(dim=1), initial=observed[OBSERVED][:, :STATE]))[1:], dim=1)


VIEWS = {"steps": View({OBSERVED: FEATURE}, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps)}
"""With ``steps``, methods that predict one state after another need not copy the state, of which a step changes a hundredth."""
