"""Pretraining data of object rearrangement."""

from ftl_lightning.demonstrations.container import Demonstrations
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
        super().__init__(DOMAIN, seed, batch_size, steps_per_epoch, encoder, revision)
        self.save_hyperparameters()
        self.samples_per_concept = samples_per_concept
        self.validation_per_concept = validation_per_concept

    def training_set(self) -> Demonstrations:
        """Scenes for training."""
        return DOMAIN.training_set(self.samples_per_concept, self.seed)

    def validation_set(self) -> Demonstrations:
        """Other scenes, from a seed that no training run uses."""
        return DOMAIN.training_set(self.validation_per_concept, VALIDATION_SEED + self.seed)


VALIDATION_SEED = 1_000_000
"""Added to the seed of held-out scenes."""
