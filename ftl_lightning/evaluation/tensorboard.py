"""What TensorBoard gets besides curves and figures: the HPARAMS tab, tables, animations and the projector.

While fitting, a setting's mean is one point of a curve. A test is no curve: its means go to the HPARAMS tab and its numbers,
task by task, into a table. The HPARAMS tab takes them from charts of one point each, which stand behind all curves and pictures.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from numpy.typing import NDArray
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.summary import hparams, scalar
from torch.utils.tensorboard.writer import FileWriter

from ftl_lightning.board import RESULTS
from ftl_lightning.concepts.point import Part, Point
from ftl_lightning.evaluation.animation import captioned, gif
from ftl_lightning.evaluation.judged import LOST, WON
from ftl_lightning.evaluation.row import METHOD, Row
from ftl_lightning.evaluation.summary import plain, summary_table
from ftl_lightning.printing import line

HPARAMS = ".hparams"
"""Ending of the event file of a run that the HPARAMS tab shows. A file of its own, so that a later test can replace it: of several
settings of a run TensorBoard shows the first."""
COLUMNS = ("text", "set", "component", "part")
"""Of the projector's points."""
WITHOUT = "-"
"""Where a point has no component."""


def setting_means(values: Mapping[tuple[str, str], Mapping[str, float]]) -> dict[str, float]:
    """The mean over tasks of every metric and setting: ``'accuracy/new concept'``, the same names in every domain.

    Args:
        values: by setting and task, each by metric.
    """
    by_name: dict[str, list[float]] = {}
    for (setting, _), by_metric in values.items():
        for metric, value in by_metric.items():
            by_name.setdefault(f"{metric}/{setting}", []).append(value)
    return {name: sum(task_values) / len(task_values) for name, task_values in by_name.items()}


def own_rows(rows: Sequence[Row]) -> list[Row]:
    """The method's own numbers, without reference lines and comparisons with them.

    Args:
        rows: see :func:`ftl_lightning.evaluation.rows.rows`.
    """
    return [row for row in rows if row.role == METHOD and not row.metric.startswith((WON, LOST))]


@rank_zero_only
def log_test(logger: TensorBoardLogger, settings: Mapping[str, Any], rows: Sequence[Row], step: int) -> None:
    """Put a test's numbers into the HPARAMS tab and, as tables of settings and of tasks, into the TEXT tab.

    Args:
        logger: where to.
        settings: see :func:`ftl_lightning.evaluation.chosen.chosen`.
        rows: the test's, some of them the method's own.
        step: the trainer's.
    """
    measured = own_rows(rows)
    values: dict[tuple[str, str], dict[str, float]] = {}
    for row in measured:
        values.setdefault((row.setting, row.task), {})[row.metric] = row.value
    tasks = list(dict.fromkeys(row.task for row in measured))
    log_hparams(logger, settings, {f"{RESULTS}/{name}": value for name, value in setting_means(values).items()}, step)
    logger.experiment.add_text(f"{RESULTS}/settings", plain(summary_table(rows)), step)
    logger.experiment.add_text(f"{RESULTS}/tasks", plain(summary_table(rows, tasks)), step)


@rank_zero_only
def log_hparams(logger: TensorBoardLogger, settings: Mapping[str, Any], metrics: Mapping[str, float], step: int = 0) -> None:
    """Put one run into the HPARAMS tab, with its results as the run's metrics; it replaces what the run has there.

    No list of hyper-parameters and metrics is written: of several runs' lists TensorBoard takes any one for all of them, and of
    runs of other domains shows nothing. Without a list it collects what there is.

    Args:
        logger: whose run it is.
        settings: by name; what is neither a number nor a truth value becomes text.
        metrics: by name.
        step: the trainer's.
    """
    plain_values = {key: value if isinstance(value, bool | int | float) else str(value) for key, value in settings.items()}
    folder = Path(logger.log_dir)
    for earlier in folder.glob(f"events.out.tfevents.*{HPARAMS}"):
        earlier.unlink()
    _, start, end = hparams(plain_values, dict(metrics))
    with closing(FileWriter(str(folder), filename_suffix=HPARAMS)) as writer:
        for summary in (start, end):
            writer.add_summary(summary)
        for name, value in metrics.items():
            writer.add_summary(scalar(name, value), step)


def log_projector(logger: TensorBoardLogger, points: Sequence[Point], step: int) -> None:
    """Put concept embeddings into the projector, with the columns :data:`COLUMNS` to name and colour them by.

    Args:
        logger: where to.
        points: of one concept space.
        step: the trainer's.
    """
    if points:
        stacked = torch.stack([point.embedding.cpu() for point in points])
        table = [[line(point.text), point.set, *_numbered(point.part)] for point in points]
        logger.experiment.add_embedding(stacked, metadata=table, metadata_header=list(COLUMNS), global_step=step, tag="concepts")


def _numbered(part: Part | None) -> tuple[str, str]:
    return (WITHOUT, WITHOUT) if part is None else (str(part.component), part.name)


def log_animation(
    logger: TensorBoardLogger, tag: str, pictures: Sequence[NDArray[np.uint8]], step: int, caption: str = "", ending: str = ""
) -> None:
    """Put an animated GIF among the images.

    Args:
        logger: where to.
        tag: its name.
        pictures: ``(height, width, 3)`` each.
        step: the trainer's.
        caption, ending: drawn below every picture and below the last, see :func:`~ftl_lightning.evaluation.animation.captioned`.
    """
    shown = captioned(pictures, caption, ending)
    height, width, _ = shown[0].shape
    image = Summary.Image(encoded_image_string=gif(shown), height=height, width=width, colorspace=3)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)
