"""Few-shot task learning through inverse generative modelling (Netanyahu et al., 2024) on PyTorch Lightning."""

__version__ = "0.1.0"
