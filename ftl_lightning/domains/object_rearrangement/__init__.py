"""Object rearrangement: concepts are spatial relations of three shapes on a table (paper, section 5.1)."""

from ftl_lightning.domains.object_rearrangement.domain import DOMAIN

__all__ = ["DOMAIN"]
