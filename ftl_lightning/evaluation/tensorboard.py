"""TensorBoard output besides curves and figures: HPARAMS tab, tables, animations, projector.

While fitting, a setting's mean is a point of a curve. In a test the means go to the HPARAMS tab and the values per task into a
table. The HPARAMS tab reads the means from charts with a single point, which come after all curves and pictures.
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

from ftl_lightning.evaluation.animation import captioned, gif
from ftl_lightning.evaluation.judged import LOST, WON
from ftl_lightning.evaluation.results import METHOD, Row
from ftl_lightning.evaluation.summary import plain, summary_table
from ftl_lightning.igm.point import Part, Point
from ftl_lightning.services.printing import line
from ftl_lightning.training.board import RESULTS

HPARAMS = ".hparams"
"""Suffix of the event file for the HPARAMS tab. The file is separate so that a later test can replace it: TensorBoard shows only
the first settings of a run."""
COLUMNS = ("text", "set", "component", "part")
"""Metadata columns of the projector."""
WITHOUT = "-"
"""Placeholder for a point without a component."""


def setting_means(values: Mapping[tuple[str, str], Mapping[str, float]]) -> dict[str, float]:
    """Mean over tasks of every metric and setting, such as ``'accuracy/new concept'``; names are the same in every domain.

    Args:
        values: values by metric, by setting and task.
    """
    by_name: dict[str, list[float]] = {}
    for (setting, _), by_metric in values.items():
        for metric, value in by_metric.items():
            by_name.setdefault(f"{metric}/{setting}", []).append(value)
    return {name: sum(task_values) / len(task_values) for name, task_values in by_name.items()}


def own_rows(rows: Sequence[Row]) -> list[Row]:
    """Rows of the method without reference lines and paired comparisons.

    Args:
        rows: see :func:`ftl_lightning.evaluation.results.rows`.
    """
    return [row for row in rows if row.role == METHOD and not row.metric.startswith((WON, LOST))]


@rank_zero_only
def log_test(logger: TensorBoardLogger, settings: Mapping[str, Any], rows: Sequence[Row], step: int) -> None:
    """Log the results of a test to the HPARAMS tab and, as tables of settings and tasks, to the TEXT tab.

    Args:
        logger: output.
        settings: see :func:`ftl_lightning.evaluation.summary.hparams_of`.
        rows: rows of the method and of reference lines.
        step: global step.
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
    """Log a run with its results to the HPARAMS tab, replacing an earlier entry of the run.

    No list of hyper-parameters and metrics is written: TensorBoard would apply an arbitrary run's list to all runs and hide the
    metrics of other domains. Without a list it collects all names.

    Args:
        logger: logger of the run.
        settings: values by name; anything but numbers and booleans becomes text.
        metrics: values by name.
        step: global step.
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
    """Log concept embeddings to the projector, with :data:`COLUMNS` for labels and colours.

    Args:
        logger: output.
        points: points of the same concept space.
        step: global step.
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
    """Log an animated GIF as an image.

    Args:
        logger: output.
        tag: name of the image.
        pictures: ``(height, width, 3)`` each.
        step: global step.
        caption, ending: text below every picture and below the last, see :func:`~ftl_lightning.evaluation.animation.captioned`.
    """
    shown = captioned(pictures, caption, ending)
    height, width, _ = shown[0].shape
    image = Summary.Image(encoded_image_string=gif(shown), height=height, width=width, colorspace=3)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)
