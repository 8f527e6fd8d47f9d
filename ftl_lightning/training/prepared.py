"""Inputs for building a network."""

from dataclasses import dataclass, fields, replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.domain import Domain
from ftl_lightning.training.model_config import ModelConfig

C = TypeVar("C", bound=ModelConfig, covariant=True)
K = TypeVar("K", bound=ModelConfig)


@dataclass(frozen=True)
class Prepared(Generic[C]):
    """Inputs for building a network.

    Attributes:
        config: configuration.
        domain: domain of the model.
        normalization: normalisation of states.
        embeddings: concept embeddings ``(1 + training concepts, n)``, the empty concept first.
        observed: normalisation of the observed vectors; ``None`` without any.
    """

    config: C
    domain: Domain
    normalization: Normalization
    embeddings: Tensor
    observed: Normalization | None = None

    def configured(self, kind: type[K], **options: Any) -> "Prepared[K]":
        """Copy with the configuration of a method's network.

        Args:
            kind: class of the configuration.
            options: additional or replaced fields of the configuration.
        """
        known = {field.name: getattr(self.config, field.name) for field in fields(self.config)}
        return Prepared(kind(**known | options), self.domain, self.normalization, self.embeddings, self.observed)

    def embedded(self, embeddings: Tensor) -> "Prepared[C]":
        """Copy with other embeddings ``(1 + training concepts, n)``."""
        return replace(self, embeddings=embeddings)


def blank(config: K, domain: Domain) -> Prepared[K]:
    """Zeros, for a network whose weights and buffers are read afterwards."""
    states, vectors = torch.zeros(config.state_dim), torch.zeros(config.measured_dim)
    return Prepared(
        config,
        domain,
        Normalization(states, states),
        torch.zeros(1 + len(config.training_concepts), config.concept_dim),
        Normalization(vectors, vectors) if config.measured_dim else None,
    )
