"""Pretraining data of driving."""

from ftl_lightning.demonstrations.datamodule import PretrainingData
from ftl_lightning.domains.driving.domain import DOMAIN


class DrivingData(PretrainingData):
    """The expert's episodes of the four training scenarios.

    Args:
        samples_per_concept: episodes of each.
        validation_per_concept: other episodes of each, for the validation loss.
        seed: decides the order they are seen in.
        batch_size: windows a step.
        steps_per_epoch: an epoch is a unit of reporting: so many batches, drawn with replacement.
        encoder: ``'table'``, ``'minilm'``, or the name or path of a language model.
        revision: of a Hugging Face model.
        horizon: states in a plan; ``None`` for the paper's 8.
    """

    def __init__(
        self,
        samples_per_concept: int = 100,
        validation_per_concept: int = 10,
        seed: int = 0,
        batch_size: int = 128,
        steps_per_epoch: int = 500,
        encoder: str = "table",
        revision: str = "main",
        horizon: int | None = None,
    ) -> None:
        super().__init__(
            DOMAIN, samples_per_concept, validation_per_concept, seed, batch_size, steps_per_epoch, encoder, revision, horizon
        )
        self.save_hyperparameters()
