"""Forward process, samplers and the denoisers that a configuration can name."""

from ftl_lightning.diffusion.mlp import MLPDenoiser

__all__ = ["MLPDenoiser"]
