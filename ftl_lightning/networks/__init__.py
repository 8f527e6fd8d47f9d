"""Denoisers by their names in configurations, encoders of conditions and images, and text encoders."""

from ftl_lightning.networks.mlp import MLPDenoiser
from ftl_lightning.networks.temporal_unet import TemporalUNet

__all__ = ["MLPDenoiser", "TemporalUNet"]

PAPER_SIZE: dict[str, dict[str, int]] = {
    "MLPDenoiser": {"hidden_dim": 1024, "depth": 4, "condition_dim": 768, "time_dim": 128},
    "TemporalUNet": {"width": 128},
}
"""Arguments of each denoiser for the paper's full size."""
