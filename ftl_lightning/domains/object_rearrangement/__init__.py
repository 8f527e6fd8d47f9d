"""Object rearrangement: three shapes on a table whose spatial relations are the concepts (paper, section 4.1)."""

from ftl_lightning.domains.object_rearrangement.domain import DOMAIN

__all__ = ["DOMAIN"]
