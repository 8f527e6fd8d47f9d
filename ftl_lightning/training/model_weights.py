"""Checks of a model's weights from a file, before the network is built."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from ftl_lightning.services.errors import UserError, short
from ftl_lightning.training.model_config import CONFIG

WEIGHTS = "model.safetensors"
"""File name in a model's folder."""
MOST_PARAMETERS = 10_000
"""Maximum number of parameter tensors in a model from a file."""
SPARE = 4
"""Maximum ratio of built numbers to numbers in the file: layers that are stacked afterwards are built twice."""


@contextmanager
def at_most(numbers: int) -> Iterator[None]:
    """Build a network of about ``numbers`` numbers; abort for larger networks.

    Raises:
        UserError: for a network that is larger or cannot be built.
    """
    tensors, left = 0, SPARE * numbers

    def count(module: nn.Module, name: str, parameter: Tensor | None) -> None:
        nonlocal tensors, left
        if parameter is not None:
            tensors, left = tensors + 1, left - parameter.numel()
        if tensors > MOST_PARAMETERS or left < 0:
            raise UserError(f"expected the sizes of the {numbers} numbers in {WEIGHTS}, found those of a larger network")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # torch and the networks raise many kinds for inconsistent sizes
        raise UserError(f"expected sizes that make a network, found others ({short(str(error), 100)})") from error
    finally:
        handle.remove()


def check_weights(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse tensors that do not fit a model or are not finite.

    Raises:
        UserError: with the first such tensor.
    """
    for name in [*expected, *found]:
        if name not in found or name not in expected:
            message = "expected it, found nothing" if name not in found else "expected nothing, found it"
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: {message}")
        tensor, like = found[name], expected[name]
        if tensor.shape != like.shape or tensor.is_floating_point() != like.is_floating_point():
            kinds = [f"{str(each.dtype).removeprefix('torch.')} {tuple(each.shape)}" for each in (like, tensor)]
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: expected {kinds[0]}, found {kinds[1]}")
        if tensor.is_floating_point() and tensor.numel() and not torch.stack(tensor.aminmax()).isfinite().all():
            raise UserError(f"key {short(name)!r}: expected finite numbers, found others; take another copy of both files")
