"""Human motion: recordings of the CMU Graphics Lab Motion Capture Database, 14 joints at 30 frames a second (paper, section 4.4)."""

from ftl_lightning.domains.mocap.domain import DOMAIN

__all__ = ["DOMAIN"]
