"""Behaviour cloning with the network of our model: whole plans by regression, the baseline with the same means."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from ftl_lightning.services.errors import require
from ftl_lightning.training.model_config import Prepared


def _hide(module: nn.Module, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
    """Inputs of a denoiser's network with zeros in place of the noisy plan."""
    noisy: Tensor = inputs[0]
    return torch.zeros_like(noisy), *inputs[1:]


class RegressionModel(GenerativeModel):
    """Our network without the noisy plan: with a single diffusion step the loss is the squared error of the plan, and a sample is
    the plan that the network predicts from concept and observation.

    Raises:
        UserError: at construction, for more than one diffusion step, or a network that does not predict the plan.
    """

    kind = "regression"

    def __init__(self, prepared: Prepared[DiffusionConfig]) -> None:
        super().__init__(prepared)
        config = prepared.config
        require(config.diffusion_steps == 1, "model.diffusion_steps", "1 for a regression", config.diffusion_steps)
        known = config.prediction in ("clean", "displacement", "cosines")
        require(known, "model.prediction", "clean, displacement or cosines for a regression", config.prediction)
        self.denoiser.net.register_forward_pre_hook(_hide)  # type: ignore[union-attr]

    @property
    def max_steps(self) -> None:
        """``None``: the settings of samplers are ignored."""

    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Sample plans, deterministic up to the concepts' modes; ``sampling`` is ignored."""
        return super().sample(compositions, count, Sampling("ddpm", 1, 0.0), generators, observed)


class RegressionPretraining(PretrainingModule):
    """Fits the regression to a domain's pairs of behaviour and concept; options as of
    :class:`~ftl_lightning.methods.ftl_igm.pretraining.PretrainingModule`.
    """

    network = RegressionModel
