"""Adaptation by a method's learner alone, without training steps."""

from ftl_lightning.igm.concept import Concept
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.inversion_settings import InversionSettings
from ftl_lightning.training.learner import Learner


class LearnerAdaptation(Adaptation):
    """Learn concepts by the method's learner; nothing is trained.

    Args:
        pretrained: folder of the pretrained model.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed of the evaluation's rows and of the learner.
    """

    def __init__(self, pretrained: str, output: str | None = None, seed: int = 0) -> None:
        super().__init__(pretrained, 1.0, output)
        self.save_hyperparameters()

    def learned(self) -> dict[str, Concept]:
        learn: Learner = self.model.method.learn()
        return learn(self.model, self.demonstrations, InversionSettings(seed=self.hparams["seed"]), 0)
