"""What TensorBoard gets besides curves and figures: the HPARAMS tab, tables, animations and the projector.

While fitting, a setting's mean is one point of a curve. A test is no curve: its means go to the HPARAMS tab and its numbers,
task by task, into a table, so that the curves of the loss are not lost among charts of a single dot.
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

HPARAMS = "hparams"
"""Name of the run within a run that the HPARAMS tab shows. There is nothing else in it: the tab shows every scalar of a run."""


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


@rank_zero_only
def log_test(logger: TensorBoardLogger, configuration: Mapping[str, Any], rows: Sequence[Row], step: int) -> None:
    """Put a test's numbers into the HPARAMS tab and, as tables of settings and of tasks, into the TEXT tab.

    Args:
        logger: where to.
        configuration: see :func:`ftl_lightning.evaluation.rows.configuration`.
        rows: the test's, see :func:`ftl_lightning.evaluation.rows.rows`.
        step: the trainer's.
    """
    measured = [row for row in rows if row.role == METHOD and not row.metric.startswith((WON, LOST))]
    if not measured:
        return
    values: dict[tuple[str, str], dict[str, float]] = {}
    for row in measured:
        values.setdefault((row.setting, row.task), {})[row.metric] = row.value
    tasks = list(dict.fromkeys(row.task for row in measured))
    first = measured[0]
    subject = {key: getattr(first, key) for key in ("domain", "method", "form", "variant")} | {"tasks": ", ".join(tasks)}
    log_hparams(logger, subject | dict(configuration), setting_means(values), step)
    logger.experiment.add_text("results/settings", plain(summary_table(rows)), step)
    logger.experiment.add_text("results/tasks", plain(summary_table(rows, tasks)), step)


@rank_zero_only
def log_hparams(logger: TensorBoardLogger, configuration: Mapping[str, Any], metrics: Mapping[str, float], step: int = 0) -> None:
    """Put one run into the HPARAMS tab, with its results as the run's metrics; it replaces what the run has there.

    No list of hyper-parameters and metrics is written: of several runs' lists TensorBoard takes any one for all of them, and of
    runs of other domains shows nothing. Without a list it collects what there is.

    Args:
        logger: whose run it is.
        configuration: by name; what is neither a number nor a truth value becomes text.
        metrics: by name.
        step: the trainer's.
    """
    plain_values = {key: value if isinstance(value, bool | int | float) else str(value) for key, value in configuration.items()}
    folder = Path(logger.log_dir) / HPARAMS
    for earlier in folder.glob("events.out.tfevents.*"):
        earlier.unlink()
    _, start, end = hparams(plain_values, dict(metrics))
    with closing(FileWriter(str(folder))) as writer:
        for summary in (start, end):
            writer.add_summary(summary)
        for name, value in metrics.items():
            writer.add_summary(scalar(name, value), step)


def log_projector(logger: TensorBoardLogger, embeddings: Mapping[str, torch.Tensor], step: int) -> None:
    """Put concept embeddings with their names into the projector.

    Args:
        logger: where to.
        embeddings: by name, each ``(n,)``.
        step: the trainer's.
    """
    if embeddings:
        stacked = torch.stack([embedding.cpu() for embedding in embeddings.values()])
        logger.experiment.add_embedding(stacked, metadata=list(embeddings), global_step=step, tag="concepts")


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
