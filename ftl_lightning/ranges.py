"""Numbers that a user gives, in their ranges."""

import math

from ftl_lightning.errors import UserError, shown

LARGEST = 1_000_000
"""Of a whole number that a user gives: a size or a number of things."""
MOST_TOGETHER = 100_000
"""Things that a network works on in one batch, or that are learned together."""
LARGEST_STEP = 10**9
"""Of the steps of a run."""
LARGEST_RATE = 1e30
"""Of a rate of learning: float32 ends soon after."""
LARGEST_FACTOR = 1e6
"""Of weights, temperatures and powers: more says no more, and float32 runs out of digits."""


def expect_range(key: str, value: float, least: float = -math.inf, most: float = math.inf) -> None:
    """Refuse a number that is out of its range or not finite.

    Args:
        key: option that names it.
        value: what was found.
        least: the smallest number of the range.
        most: the largest.

    Raises:
        UserError: naming key, range and what was found.
    """
    if -math.inf < value < math.inf and least <= value <= most:
        return
    if math.isinf(most):
        expected = "a finite number" if math.isinf(least) else f"{least:g} or more"
    else:
        expected = f"a number from {least:g} to {most:g}"
    raise UserError(f"{key}: expected {expected}, found {shown(value)}")


def expect_count(key: str, value: int, least: int, most: int = LARGEST) -> None:
    """The same of a number of things, whose largest is told to those alone who ask for more."""
    expect_range(key, value, least)
    expect_range(key, value, least, most)


def expect_factor(key: str, value: float, least: float = -LARGEST_FACTOR, most: float = LARGEST_FACTOR) -> None:
    """The same of a weight, a temperature or another factor."""
    expect_range(key, value, -math.inf if least == -LARGEST_FACTOR else least)
    expect_range(key, value, least, most)
