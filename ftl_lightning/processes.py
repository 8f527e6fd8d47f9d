"""One batch over several processes: each has its rows, and of all that is random, the rows' part of what one process would draw.

Process r of n has rows r, r + n, r + 2n and so on, so that it does not matter whether rows were repeated before. Outside of
:func:`rows_of` there is one process.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from torch import Tensor, distributed, nn
from torch.nn import functional


@dataclass
class _Rows:
    """Whose rows are computed: of process ``rank`` of ``world``."""

    rank: int = 0
    world: int = 1


_ROWS = _Rows()
"""Not a context variable, which networks that are compiled cannot read."""


@contextmanager
def rows_of(rank: int, world: int) -> Iterator[None]:
    """Within the block, what is drawn and averaged is that of the batch of all processes.

    Args:
        rank: of this process.
        world: processes.
    """
    before = _ROWS.rank, _ROWS.world
    _ROWS.rank, _ROWS.world = rank, world
    try:
        yield
    finally:
        _ROWS.rank, _ROWS.world = before


def drawn(count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """Random numbers of some rows of a batch ``(count, ...)``.

    Args:
        count: of this process's rows.
        draw: called with the number of all processes' rows; what it returns has as many.
    """
    if _ROWS.world == 1:
        return draw(count)
    return draw(count * _ROWS.world)[_ROWS.rank :: _ROWS.world]


def mean(value: Tensor) -> Tensor:
    """The mean over all processes of each one's number, without a gradient; with one process the number itself."""
    if _ROWS.world == 1:
        return value
    total = value.detach().clone()
    distributed.all_reduce(total)
    return total / _ROWS.world


class Dropout(nn.Dropout):
    """Dropout whose mask is that of the batch of all processes."""

    def forward(self, input: Tensor) -> Tensor:
        """``(batch, ...)`` to the same shape."""
        if _ROWS.world == 1 or not self.training:
            return super().forward(input)
        return input * drawn(len(input), lambda count: functional.dropout(input.new_ones(count, *input.shape[1:]), self.p))
