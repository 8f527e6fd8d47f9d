"""Meta-World as a domain of ftl-lightning."""

from ftl_metaworld.domain import FOLDS, ML10, ML45

ML45_1, ML45_2, ML45_3, ML45_4, ML45_5, ML45_6, ML45_7, ML45_8, ML45_9 = FOLDS
__all__ = ["ML10", "ML45", "ML45_1", "ML45_2", "ML45_3", "ML45_4", "ML45_5", "ML45_6", "ML45_7", "ML45_8", "ML45_9"]
