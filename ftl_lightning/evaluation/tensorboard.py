"""What TensorBoard gets besides scalars and figures: the HPARAMS tab and the projector."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
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


FRAME_SECONDS = 0.1


def log_animation(logger: TensorBoardLogger, tag: str, pictures: Sequence[NDArray[np.uint8]], step: int) -> None:
    """Put an animated GIF among the images.

    Args:
        logger: where to.
        tag: its name.
        pictures: ``(height, width, 3)`` each.
        step: the trainer's.
    """
    height, width, _ = pictures[0].shape
    image = Summary.Image(encoded_image_string=gif(pictures), height=height, width=width, colorspace=3)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def gif(pictures: Sequence[NDArray[np.uint8]]) -> bytes:
    """An endless animation of pictures ``(height, width, 3)``."""
    first, *rest = (Image.fromarray(picture).quantize(64) for picture in pictures)
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=rest, duration=round(1000 * FRAME_SECONDS), loop=0)
    return content.getvalue()
