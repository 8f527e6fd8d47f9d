"""Pretraining data of navigation."""

from ftl_lightning.demonstrations.datamodule import PretrainingData
from ftl_lightning.domains.agent.domain import DOMAIN


class AgentData(PretrainingData):
    """The expert's drives of the four training concepts, kept in a cache once they are made (a minute).

    Args:
        samples_per_concept: drives of each training concept; 225 gives the paper's ~900.
        validation_per_concept: other drives of each, for the validation loss.
        seed: decides the drives and the order they are seen in.
        batch_size: windows a step.
        steps_per_epoch: an epoch is a unit of reporting: so many batches, drawn with replacement.
        encoder: ``'table'``, ``'minilm'``, or the name or path of a language model.
        revision: of a Hugging Face model.
        horizon: states in a plan; ``None`` for the paper's 128.
        early: windows start early in a drive: with 3 half of them in its first eighth. ``None`` for 3 where they reach over a whole
            drive, and 1 where they are shorter.
    """

    def __init__(
        self,
        samples_per_concept: int = 225,
        validation_per_concept: int = 15,
        seed: int = 0,
        batch_size: int = 64,
        steps_per_epoch: int = 500,
        encoder: str = "table",
        revision: str = "main",
        horizon: int | None = None,
        early: float | None = None,
    ) -> None:
        super().__init__(
            DOMAIN,
            samples_per_concept,
            validation_per_concept,
            seed,
            batch_size,
            steps_per_epoch,
            encoder,
            revision,
            horizon,
            early,
        )
        self.save_hyperparameters()
