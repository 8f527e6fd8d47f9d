"""Pretraining data of navigation."""

from ftl_lightning.training.data import PretrainingData


class AgentData(PretrainingData):
    """Cached expert drives of the four training concepts (generated in a minute).

    225 samples of each concept give the paper's ~900 drives.

    Configurations and committed results use this class: ``PretrainingData(domain=...)`` would change the configuration hash, as its
    settings name the domain.
    """

    own_domain = "agent"
