"""Pretraining data of object rearrangement."""

from ftl_lightning.domains.data import PretrainingData


class ObjectRearrangementData(PretrainingData):
    """Scenes of the twelve training concepts, drawn from the seed for each run (half a second).

    920 samples of each concept give the paper's ~11,000 scenes.
    """

    own_domain = "object_rearrangement"
