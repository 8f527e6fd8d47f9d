"""Pretraining data of navigation."""

from ftl_lightning.domains.data import PretrainingData


class AgentData(PretrainingData):
    """The expert's drives of the four training concepts, kept in a cache once they are made (a minute).

    225 samples of each concept give the paper's ~900 drives.

    Its settings name no domain. Those of ``PretrainingData(domain=...)`` do, so that the results file would know the same run by
    another hash: configurations and committed rows go by this class.
    """

    own_domain = "agent"
