"""Run time of isolated products and convolutions by tensor shape.

There is no formula, as libraries choose routines by shape: a convolution over four states of a window can take three times as long
as over sixteen. Each shape is measured once outside of its step. Before a call its inputs are evicted from the processor's caches
as far as the other weights of the step would evict them; memory is allocated in advance, as in a step.
"""

import ctypes
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Options of ``mallopt``."""
LEAST, MOST, LONG = 3, 12, 0.03
"""Repeats of a call; between the two, as many as so many seconds hold."""


@dataclass(frozen=True)
class Layout:
    """Of a tensor among arguments."""

    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype

    def made(self) -> Tensor:
        """Random numbers that lie in memory like that."""
        return torch.empty_strided(self.shape, self.strides, dtype=self.dtype).normal_()


@dataclass(frozen=True)
class Call:
    """Of an operator: its name with the overload, such as ``'aten.mm.default'``, arguments, and options by name."""

    name: str
    arguments: tuple[Any, ...]
    options: tuple[tuple[str, Any], ...]


def call(function: Any, arguments: tuple[Any, ...], options: Mapping[str, Any]) -> Call:
    """A call with layouts for its tensors."""
    return Call(str(function), _laid_out(arguments), tuple((name, _laid_out(value)) for name, value in options.items()))


def _laid_out(value: Any) -> Any:
    if isinstance(value, Tensor):
        return Layout(tuple(value.shape), tuple(value.stride()), value.dtype)
    return tuple(map(_laid_out, value)) if isinstance(value, list | tuple) else value


def _made(value: Any) -> Any:
    if isinstance(value, Layout):
        return value.made()
    return [_made(one) for one in value] if isinstance(value, tuple) else value


def keep_memory() -> None:
    """Do not give memory back to the system, which would hand out fresh pages again for every large result of a call alone."""
    for option in (TRIM_THRESHOLD, MMAP_THRESHOLD):
        ctypes.CDLL(None).mallopt(option, 2**31 - 1)


@cache
def seconds(one: Call, between: int) -> float:
    """Processor time of a call with random numbers, the least of some.

    Args:
        one: the call.
        between: bytes that are read between two calls, as many as the weights of the step have.
    """
    others = torch.zeros(between // 4)
    space, name, overload = one.name.split(".")
    function = getattr(getattr(getattr(torch.ops, space), name), overload)
    arguments, options = [_made(value) for value in one.arguments], {name: _made(value) for name, value in one.options}
    function(*arguments, **options)
    found: list[float] = []
    while len(found) < LEAST or (len(found) < MOST and sum(found) < LONG):
        others.sum()
        start = time.process_time()
        function(*arguments, **options)
        found.append(time.process_time() - start)
    return min(found)
