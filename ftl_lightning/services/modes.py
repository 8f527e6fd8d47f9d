"""Modes of torch that a caller may have changed, and on which no number here may depend."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def single_precision() -> Iterator[None]:
    """Make float32 the default dtype within the block."""
    before = torch.get_default_dtype()
    if before == torch.float32:
        yield
        return
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def usual_modes() -> Iterator[None]:
    """Compute within the block in float32, with gradients and without autocast, also within ``no_grad`` or inference mode.

    Tensors made within the block are no inference tensors, which gradients could not pass.
    """
    with ExitStack() as modes:
        modes.enter_context(single_precision())
        modes.enter_context(torch.inference_mode(False))
        modes.enter_context(torch.enable_grad())
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                modes.enter_context(torch.autocast(device, enabled=False))
        yield
