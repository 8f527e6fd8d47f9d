"""Pretraining data of object rearrangement."""

from ftl_lightning.demonstrations.datamodule import PretrainingData
from ftl_lightning.domains.object_rearrangement.domain import DOMAIN


class ObjectRearrangementData(PretrainingData):
    """Scenes of the twelve training concepts, drawn anew from the seed (half a second).

    Args:
        samples_per_concept: scenes of each training concept; 920 gives the paper's ~11,000.
        validation_per_concept: other scenes of each, for the validation loss.
        seed: decides the scenes and the order they are seen in.
        batch_size: scenes a step.
        steps_per_epoch: an epoch is a unit of reporting: so many batches, drawn with replacement.
        encoder: ``'table'``, ``'minilm'``, or the name or path of a language model.
        revision: of a Hugging Face model.
    """

    def __init__(
        self,
        samples_per_concept: int = 920,
        validation_per_concept: int = 40,
        seed: int = 0,
        batch_size: int = 512,
        steps_per_epoch: int = 500,
        encoder: str = "table",
        revision: str = "main",
    ) -> None:
        super().__init__(DOMAIN, samples_per_concept, validation_per_concept, seed, batch_size, steps_per_epoch, encoder, revision)
        self.save_hyperparameters()
