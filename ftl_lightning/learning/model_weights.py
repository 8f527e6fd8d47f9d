"""What is asked of a model's weights that are read from a file, before a network is made for them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from ftl_lightning.errors import UserError, short
from ftl_lightning.learning.model_config import CONFIG

WEIGHTS = "model.safetensors"
"""In a model's folder."""
MOST_PARAMETERS = 10_000
"""Of tensors that are learned in a model that is read from files."""
SPARE = 4
"""So many times the numbers of a file may be made while a network is built: layers that are stacked afterwards are made twice."""


@contextmanager
def at_most(numbers: int) -> Iterator[None]:
    """Build a network of about so many numbers; larger ones are not built to their end.

    Raises:
        UserError: for a network that is larger, or that cannot be built.
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
    except Exception as error:  # torch and the networks raise many kinds for sizes that do not go together
        raise UserError(f"expected sizes that make a network, found others ({short(str(error), 100)})") from error
    finally:
        handle.remove()


def expect_weights(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse tensors that are not those of a model, or hold numbers that are none.

    Raises:
        UserError: naming the first one.
    """
    for name in [*expected, *found]:
        if name not in found or name not in expected:
            told = "expected it, found nothing" if name not in found else "expected nothing, found it"
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: {told}")
        own, like = found[name], expected[name]
        if own.shape != like.shape or own.is_floating_point() != like.is_floating_point():
            kinds = [f"{str(one.dtype).removeprefix('torch.')} {tuple(one.shape)}" for one in (like, own)]
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: expected {kinds[0]}, found {kinds[1]}")
        if own.is_floating_point() and own.numel() and not torch.stack(own.aminmax()).isfinite().all():
            raise UserError(f"key {short(name)!r}: expected finite numbers, found others; take another copy of both files")
