"""Range checks of user-given numbers."""

import math

from ftl_lightning.services.errors import UserError, shown

LARGEST = 1_000_000
"""Maximum of a user-given size or count."""
MOST_TOGETHER = 100_000
"""Maximum size of a batch, or number of runs learned together."""
LARGEST_STEP = 10**9
"""Maximum number of steps of a run."""
LARGEST_RATE = 1e30
"""Maximum learning rate, near the limit of float32."""
LARGEST_FACTOR = 1e6
"""Maximum of weights, temperatures and powers; larger values exhaust the precision of float32."""


def check_range(key: str, value: float, least: float = -math.inf, most: float = math.inf) -> None:
    """Refuse a number that is out of range or not finite.

    Args:
        key: name of the option.
        value: given value.
        least: minimum.
        most: maximum.

    Raises:
        UserError: with key, range and value.
    """
    if -math.inf < value < math.inf and least <= value <= most:
        return
    if math.isinf(most):
        expected = "a finite number" if math.isinf(least) else f"{least:g} or more"
    else:
        expected = f"a number from {least:g} to {most:g}"
    raise UserError(f"{key}: expected {expected}, found {shown(value)}")


def check_count(key: str, value: int, least: int, most: int = LARGEST) -> None:
    """Check a count; report the upper bound only when it is exceeded."""
    check_range(key, value, least)
    check_range(key, value, least, most)


def check_factor(key: str, value: float, least: float = -LARGEST_FACTOR, most: float = LARGEST_FACTOR) -> None:
    """Check a weight, a temperature or another factor."""
    check_range(key, value, -math.inf if least == -LARGEST_FACTOR else least)
    check_range(key, value, least, most)
