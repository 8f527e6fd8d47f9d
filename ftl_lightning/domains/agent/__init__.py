"""Navigation: an agent drives to that of two objects which has the concept's colour or shape (paper, section 4.2; after AGENT)."""

from ftl_lightning.domains.agent.domain import DOMAIN

__all__ = ["DOMAIN"]
