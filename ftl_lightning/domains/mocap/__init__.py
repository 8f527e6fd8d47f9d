"""Human motion: recordings of the CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu)."""

from ftl_lightning.domains.mocap.domain import DOMAIN, ROOTED

__all__ = ["DOMAIN", "ROOTED"]
