"""Pretraining data of driving."""

from ftl_lightning.domains.data import PretrainingData


class DrivingData(PretrainingData):
    """The expert's episodes of the four training scenarios that ship; at most 100 of each.

    Its settings name no domain. Those of ``PretrainingData(domain=...)`` do, so that the results file would know the same run by
    another hash: configurations and committed rows go by this class.
    """

    own_domain = "driving"
