"""What TensorBoard gets besides scalars and figures: the HPARAMS tab and the projector."""

from collections.abc import Mapping
from typing import Any

import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard.summary import hparams


def log_hparams(logger: TensorBoardLogger, configuration: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
    """Put one run into the HPARAMS tab, with its results as the run's metrics."""
    plain = {key: value if isinstance(value, bool | int | float) else str(value) for key, value in configuration.items()}
    writer = logger.experiment.file_writer
    for summary in hparams(plain, dict(metrics)):
        writer.add_summary(summary)


def log_projector(logger: TensorBoardLogger, embeddings: Mapping[str, torch.Tensor], step: int) -> None:
    """Put concept embeddings with their names into the projector.

    Args:
        embeddings: by name, each ``(n,)``.
        step: the trainer's.
    """
    if embeddings:
        stacked = torch.stack([embedding.cpu() for embedding in embeddings.values()])
        logger.experiment.add_embedding(stacked, metadata=list(embeddings), global_step=step, tag="concepts")
