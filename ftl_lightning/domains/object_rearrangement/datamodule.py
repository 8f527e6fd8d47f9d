"""Pretraining data of object rearrangement."""

from ftl_lightning.domains.data import PretrainingData


class ObjectRearrangementData(PretrainingData):
    """Scenes of the twelve training concepts, drawn from the seed for each run (half a second).

    920 samples of each concept give the paper's ~11,000 scenes.

    Its settings name no domain. Those of ``PretrainingData(domain=...)`` do, so that the results file would know the same run by
    another hash: configurations and committed rows go by this class.
    """

    own_domain = "object_rearrangement"
