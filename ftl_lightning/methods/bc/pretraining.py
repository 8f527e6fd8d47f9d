"""Pretraining of behaviour cloning."""

from typing import Any

import torch
from torch import Tensor

from ftl_lightning.methods.bases import check_window
from ftl_lightning.methods.bc.model import CloningConfig, CloningModel
from ftl_lightning.services.validation import check_range
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining


class CloningPretraining(Pretraining[CloningModel]):
    """Fits the policy to transitions of a domain's pairs of behaviour and concept.

    Args:
        hidden_dim, members: see :class:`CloningConfig`.
        plan_horizon: states in an unrolled plan; ``None`` for the domain's.
        stride: see :class:`~ftl_lightning.methods.bases.StepConfig`; ``data.horizon`` is ``stride + 1``, or 1.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    def __init__(
        self, hidden_dim: int = 512, members: int = 1, plan_horizon: int | None = None, stride: int = 1, **options: Any
    ) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        check_range("model.hidden_dim", hidden_dim, 1)
        if plan_horizon is not None:
            check_range("model.plan_horizon", plan_horizon, 1)
        self.stride = stride

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> CloningModel:
        sizes = {name: self.hparams[name] for name in ("hidden_dim", "members", "stride")}
        horizon = self.hparams["plan_horizon"] or data.domain.plans.horizon
        policy = prepared.configured(CloningConfig, horizon=horizon, **sizes)
        check_window(policy.config, data)
        return CloningModel(policy)

    def losses(self, model: CloningModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Squared error of transitions."""
        states, seen = batch.states, batch.observed
        return model.errors(states, seen, model.training_embeddings[batch.concepts])
