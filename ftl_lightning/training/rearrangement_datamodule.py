"""Pretraining data of object rearrangement."""

from ftl_lightning.training.data import PretrainingData


class ObjectRearrangementData(PretrainingData):
    """Scenes of the twelve training concepts, generated from the seed in each run (half a second).

    920 samples of each concept give the paper's ~11,000 scenes.

    Configurations and committed results use this class: ``PretrainingData(domain=...)`` would change the configuration hash, as its
    settings name the domain.
    """

    own_domain = "object_rearrangement"
