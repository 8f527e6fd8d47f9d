"""Table-top manipulation: a Panda picks, places and pushes a green circle, seen by a camera (paper, section 'Table-Top')."""

from ftl_lightning.domains.tabletop.domain import DOMAIN, WIDE

__all__ = ["DOMAIN", "WIDE"]
