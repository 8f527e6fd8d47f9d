"""Agreement between raters who assign categories."""

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence


def krippendorff_alpha(units: Iterable[Sequence[Hashable]]) -> float:
    """Krippendorff's alpha of categories without an order.

    ``1 - D_observed / D_expected``: 1 for full agreement, 0 for agreement by chance, negative for less. (K. Krippendorff,
    "Computing Krippendorff's Alpha-Reliability", 2011, part C and D.)

    Args:
        units: for each rated item, the categories given by raters, in any order; missing ratings are omitted, and items with fewer
            than two ratings do not count.

    Returns:
        alpha, or NaN if nothing varies, because agreement is then indistinguishable from habit.
    """
    paired = [Counter(unit) for unit in units if len(unit) > 1]
    totals = sum(paired, Counter())
    count = totals.total()
    # Pairs within a unit that differ, each unit with a weight that makes every value count once.
    observed = sum((u.total() ** 2 - sum(n * n for n in u.values())) / (u.total() - 1) for u in paired)
    expected = count**2 - sum(n * n for n in totals.values())
    return 1 - (count - 1) * observed / expected if expected else math.nan
