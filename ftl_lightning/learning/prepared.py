"""What a network is built for."""

from dataclasses import dataclass, fields, replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.domains.domain import Domain
from ftl_lightning.learning.model_config import ModelConfig

C = TypeVar("C", bound=ModelConfig, covariant=True)
K = TypeVar("K", bound=ModelConfig)


@dataclass(frozen=True)
class Prepared(Generic[C]):
    """What a network is built for.

    Attributes:
        config: sizes and names.
        domain: whose behaviour it learns.
        normalization: of states.
        embeddings: of concepts ``(1 + training concepts, n)``, the empty one first.
        observed: normalisation of the observed vectors, one after another; ``None`` where there are none.
    """

    config: C
    domain: Domain
    normalization: Normalization
    embeddings: Tensor
    observed: Normalization | None = None

    def configured(self, kind: type[K], **options: Any) -> "Prepared[K]":
        """The same for a method's network.

        Args:
            kind: of its configuration.
            options: what the configuration says beside or in place of what every model's does.
        """
        known = {field.name: getattr(self.config, field.name) for field in fields(self.config)}
        return Prepared(kind(**known | options), self.domain, self.normalization, self.embeddings, self.observed)

    def embedded(self, embeddings: Tensor) -> "Prepared[C]":
        """The same with other embeddings ``(1 + training concepts, n)``."""
        return replace(self, embeddings=embeddings)


def blank(config: K, domain: Domain) -> Prepared[K]:
    """For a network whose weights and buffers are read afterwards: zeros."""
    states, vectors = torch.zeros(config.state_dim), torch.zeros(config.measured_dim)
    return Prepared(
        config,
        domain,
        Normalization(states, states),
        torch.zeros(1 + len(config.training_concepts), config.concept_dim),
        Normalization(vectors, vectors) if config.measured_dim else None,
    )
