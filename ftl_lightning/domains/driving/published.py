"""The paper's numbers for driving, comparable with our results for one-step look-ahead.

Its success rate counts any vehicle past the roundabout, crashed or not.
"""

from ftl_lightning.domains.comparison import Published
from ftl_lightning.domains.driving.tasks import NEW

SUCCESS, CRASH = "closed loop success (step veto)", "closed loop crash (step veto)"


def _omega() -> list[Published]:
    """Table 'Classifier-free guidance weight choice effect'."""
    rows = (("1.2", 0.18, 0.38), ("1.4", 0.14, 0.40), ("1.6", 0.04, 0.48), ("1.8", 0.10, 0.40), ("learned", 0.24, 0.32))
    return [
        Published(NEW, value, omega=omega, metric=metric)
        for omega, success, crash in rows
        for metric, value in ((SUCCESS, success), (CRASH, crash))
    ]


def _baselines() -> list[Published]:
    """Baselines in the same table."""
    rows = (("BC", 0.04, 0.64), ("CVAE", 0.24, 0.48), ("in-context", 0.0, 0.16))
    return [
        Published(NEW, value, metric=metric, method=method)
        for method, success, crash in rows
        for metric, value in ((SUCCESS, success), (CRASH, crash))
    ]


PUBLISHED = (*_omega(), *_baselines(), Published(NEW, 0.14, components=1, metric=SUCCESS))
"""All rows, with K = 1 of the table 'Ablation on the number of learned concepts'."""
