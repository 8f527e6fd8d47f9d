"""Pretraining data of driving."""

from ftl_lightning.training.data import PretrainingData


class DrivingData(PretrainingData):
    """Shipped expert episodes of the four training scenarios, at most 100 each.

    Configurations and committed results use this class: ``PretrainingData(domain=...)`` would change the configuration hash, as its
    settings name the domain.
    """

    own_domain = "driving"
