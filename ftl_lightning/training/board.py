"""TensorBoard log of a run, with curves of learning first and single numbers last."""

from collections.abc import Mapping

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

PICTURES, FILMS, ROLLOUTS = "pictures", "plans in motion", "rollouts"
"""Groups of pictures of plans, films of plans and films of episodes. TensorBoard sorts groups by name; these follow ``accuracy``,
``loss`` and ``optimizer``."""
RESULTS = "test results"
"""Group of test results, a single point each."""


def tag(name: str) -> str:
    """Tag of a logged number: ``'train/loss'`` becomes ``'loss/train'``, ``'val/accuracy/SETTING'`` ``'accuracy/SETTING'``.

    TensorBoard groups tags by the first word. Grouping by metric puts a metric's curves side by side, and test results, which are
    not curves, last in :data:`RESULTS`.

    Args:
        name: name in callbacks: stage, metric and optionally setting; other names are unchanged.
    """
    stage, _, measured = name.partition("/")
    if stage == "test" and measured:
        return f"{RESULTS}/{measured}"
    if stage in ("train", "val") and measured:
        return measured if "/" in measured else f"{measured}/{stage}"
    return name


class Board(TensorBoardLogger):
    """Lightning's logger with the tags of :func:`tag` and without the epoch."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log a point of each metric."""
        super().log_metrics({tag(name): value for name, value in metrics.items() if name != "epoch"}, step)
