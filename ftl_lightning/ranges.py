"""Numbers that a user gives, in their ranges."""

import math

from ftl_lightning.errors import UserError, shown

LARGEST = 1_000_000
"""Of a whole number that a user gives: a size or a number of things."""


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
