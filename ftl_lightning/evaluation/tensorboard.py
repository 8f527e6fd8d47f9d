"""TensorBoard output of an evaluation besides curves: figures, animations, tables, HPARAMS tab, projector.

While fitting, a setting's mean is a point of a curve. In a test the means go to the HPARAMS tab and the values per task into a
table. The HPARAMS tab reads the means from charts with a single point, which come after all curves and pictures.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from numpy.typing import NDArray
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.summary import hparams, scalar
from torch.utils.tensorboard.writer import FileWriter

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.generation import TaskResult, share
from ftl_lightning.evaluation.pictures import captioned, gif, outcome_text
from ftl_lightning.evaluation.results import Row
from ftl_lightning.evaluation.summary import own_rows, plain, summary_table
from ftl_lightning.igm.concept import Part, Point
from ftl_lightning.services.text import line
from ftl_lightning.training.board import FILMS, PICTURES, RESULTS, ROLLOUTS
from ftl_lightning.training.quality import drawn

if TYPE_CHECKING:  # slow import
    from matplotlib.figure import Figure

HPARAMS = ".hparams"
"""Suffix of the event file for the HPARAMS tab. The file is separate so that a later test can replace it: TensorBoard shows only
the first settings of a run."""
COLUMNS = ("text", "set", "component", "part")
"""Metadata columns of the projector; '-' for a point without a component."""


def draw(
    logger: TensorBoardLogger, judged: Sequence[TaskResult], domain: Domain, figures: int, step: int, filmed: bool = True
) -> None:
    """Log a figure of each task's plans and, if ``filmed``, films of the first plan and the first episode.

    A figure has as many samples, and at most as many demonstrations, as ``figures``, 1 or more.
    """
    for behaviour in judged:
        name = f"{behaviour.task.setting}/{behaviour.task.name}"
        logger.experiment.add_figure(f"{PICTURES}/{name}", picture(behaviour, domain, figures), step)
        if not filmed:
            continue
        if (film := domain.show.film) is not None:
            log_animation(logger, f"{FILMS}/{name}", captioned(film(behaviour.states[0]), title(behaviour)), step)
        if domain.closed_loop and domain.closed_loop.film and behaviour.rollout is not None and behaviour.followed is not None:
            frames = domain.closed_loop.film(behaviour.rollout.take(0, 1), behaviour.followed)
            ended = captioned(frames, behaviour.task.goal, outcome_text(behaviour.outcomes))
            log_animation(logger, f"{ROLLOUTS}/{name}", ended, step)


def title(behaviour: TaskResult) -> str:
    """Name of the task and share of right plans, if judged."""
    return behaviour.task.name if behaviour.right is None else f"{behaviour.task.name}: {share(behaviour.right):.2f} right"


def picture(behaviour: TaskResult, domain: Domain, figures: int) -> "Figure":
    """Draw plans, framed green if right and red if wrong, below the demonstrations; at most ``figures`` of each."""
    shown = slice(0, figures)
    starts = None if behaviour.starts is None else behaviour.starts.take(shown)
    right = None if behaviour.right is None else behaviour.right[shown].tolist()
    return drawn(domain, behaviour.states[shown], starts, right, title(behaviour), behaviour.demonstrations)


def log_animation(logger: TensorBoardLogger, tag: str, frames: Sequence[NDArray[np.uint8]], step: int) -> None:
    """Log frames ``(height, width, 3)`` as an animated image."""
    height, width, _ = frames[0].shape
    image = Summary.Image(encoded_image_string=gif(frames), height=height, width=width, colorspace=3)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def setting_means(values: Iterable[tuple[str, str, float]]) -> dict[str, float]:
    """Mean of ``(setting, metric, value)`` over tasks, such as ``'accuracy/new concept'``; names are the same in every domain."""
    by_name: dict[str, list[float]] = {}
    for setting, metric, value in values:
        by_name.setdefault(f"{metric}/{setting}", []).append(value)
    return {name: sum(task_values) / len(task_values) for name, task_values in by_name.items()}


@rank_zero_only
def log_test(logger: TensorBoardLogger, settings: Mapping[str, Any], rows: Sequence[Row], step: int) -> None:
    """Log the results of a test to the HPARAMS tab and, as tables of settings and tasks, to the TEXT tab.

    ``settings`` are those of :func:`ftl_lightning.evaluation.summary.hparams_of`; ``rows`` include references.
    """
    measured = own_rows(rows)
    means = setting_means((row.setting, row.metric, row.value) for row in measured)
    _log_hparams(logger, settings, {f"{RESULTS}/{name}": value for name, value in means.items()}, step)
    tasks = list(dict.fromkeys(row.task for row in measured))
    logger.experiment.add_text(f"{RESULTS}/settings", plain(summary_table(rows)), step)
    logger.experiment.add_text(f"{RESULTS}/tasks", plain(summary_table(rows, tasks)), step)


def _log_hparams(logger: TensorBoardLogger, settings: Mapping[str, Any], metrics: Mapping[str, float], step: int) -> None:
    """Log a run with its results to the HPARAMS tab, replacing an earlier entry of the run.

    No list of hyper-parameters and metrics is written: TensorBoard would apply an arbitrary run's list to all runs and hide the
    metrics of other domains. Without a list it collects all names.
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
    """Log points of a concept space to the projector, with :data:`COLUMNS` for labels and colours."""

    def labels(part: Part | None) -> tuple[str, str]:
        return ("-", "-") if part is None else (str(part.component), part.name)

    if points:
        embeddings = torch.stack([point.embedding.cpu() for point in points])
        table = [[line(point.text), point.set, *labels(point.part)] for point in points]
        with redirect_stdout(None):  # it prints a warning where a former run wrote one
            logger.experiment.add_embedding(
                embeddings, metadata=table, metadata_header=list(COLUMNS), global_step=step, tag="concepts"
            )
