"""Pretraining data of driving."""

from ftl_lightning.domains.data import PretrainingData


class DrivingData(PretrainingData):
    """The expert's episodes of the four training scenarios that ship; at most 100 of each."""

    own_domain = "driving"
