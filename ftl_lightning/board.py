"""The TensorBoard log of a run, in an order that tells its story: what is learned first, single numbers last."""

from collections.abc import Mapping

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

PICTURES, FILMS, ROLLOUTS = "pictures", "plans in motion", "rollouts"
"""Groups of pictures of plans, films of plans and films of episodes. TensorBoard shows groups by their names' order; these stand
behind ``accuracy``, ``loss`` and ``optimizer``."""
RESULTS = "test results"
"""Group of a test's numbers, which are one point each."""


def tag(name: str) -> str:
    """Where a logged number stands: ``'train/loss'`` in ``'loss/train'``, ``'val/accuracy/SETTING'`` in ``'accuracy/SETTING'``.

    TensorBoard makes a group of each first word. Sorted by what is measured, a quantity's curves stand side by side, and numbers of
    a test, which are no curves, behind all of them in :data:`RESULTS`.

    Args:
        name: as callbacks know it: stage, metric and maybe setting; other names stay as they are.
    """
    stage, _, measured = name.partition("/")
    if stage == "test" and measured:
        return f"{RESULTS}/{measured}"
    if stage in ("train", "val") and measured:
        return measured if "/" in measured else f"{measured}/{stage}"
    return name


class Board(TensorBoardLogger):
    """Lightning's logger, with tags as :func:`tag` says. The number of the epoch is left out: steps tell the time."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add a point to each number's chart."""
        super().log_metrics({tag(name): value for name, value in metrics.items() if name != "epoch"}, step)
