"""Navigation: an agent drives to the object of the concept's colour or shape, out of two (paper, section 5.1; after AGENT)."""

from ftl_lightning.domains.agent.domain import DOMAIN

__all__ = ["DOMAIN"]
