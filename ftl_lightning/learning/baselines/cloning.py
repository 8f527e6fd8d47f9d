"""Goal-conditioned behaviour cloning (paper, 'Baselines' and 'Implementation Details'): the next state from state and concept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.composition import Composition, batched
from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.data import Batch, PretrainingData
from ftl_lightning.domains.domain import Domain
from ftl_lightning.learning.baselines.additive import AdditiveModel, added
from ftl_lightning.learning.baselines.transitions import StepConfig, expect_window, unroll
from ftl_lightning.learning.concept_model import ConceptModel, TextConceptModel
from ftl_lightning.learning.pretraining import Pretraining
from ftl_lightning.ranges import expect_range


@dataclass(frozen=True, kw_only=True)
class CloningConfig(StepConfig):
    """What the cloning network needs to be built.

    Attributes:
        hidden_dim: width of the hidden layer.
        members: networks that differ in their initial weights. Each is deterministic; samples take turns among them (the paper
            averages over seeds), and episodes are driven by the first.
    """

    hidden_dim: int = 512
    members: int = 1


class ParallelMLP(nn.Module):
    """Networks of one hidden layer (ReLU), side by side in one batch.

    Args:
        members: how many.
        inputs, hidden, outputs: their sizes.
    """

    def __init__(self, members: int, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        layers = [[nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)] for _ in range(members)]
        self.weights = nn.ParameterList(torch.stack([one[depth].weight.detach().T for one in layers]) for depth in range(2))
        self.biases = nn.ParameterList(torch.stack([one[depth].bias.detach()[None] for one in layers]) for depth in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """``(member or 1, batch, inputs)`` to ``(member, batch, outputs)``."""
        hidden = torch.relu(x @ self.weights[0] + self.biases[0])
        return hidden @ self.weights[1] + self.biases[1]


class CloningModel(AdditiveModel, TextConceptModel):
    """A deterministic policy of the concept and, where there is one, the state; composing adds concepts.

    Args:
        config, domain, normalization, embeddings, initial_normalization: see :class:`TextConceptModel`.
    """

    kind = "bc"
    name = "BC"
    Config = CloningConfig
    config: CloningConfig

    def __init__(
        self,
        config: CloningConfig,
        domain: Domain,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        super().__init__(config, domain, normalization, embeddings, initial_normalization)
        expect_range("model.members", config.members, 1, 1000)
        inputs = config.concept_dim + config.vector_dim
        self.network = ParallelMLP(config.members, inputs, config.hidden_dim, config.moments * config.state_dim)

    @property
    def window(self) -> int:
        return self.config.window

    def predict(self, vector: Tensor | None, concepts: Tensor) -> Tensor:
        """Transitions ``(member, batch, moments, state)``, normalised.

        Args:
            vector: ``(member or 1, batch, m)`` or ``None``.
            concepts: ``(member or 1, batch, n)``.
        """
        out: Tensor = self.network(concepts if vector is None else torch.cat((vector, concepts), dim=-1))
        return out.unflatten(-1, (self.config.moments, self.config.state_dim))

    def errors(self, states: Tensor, observed: Observed, concepts: Tensor) -> Tensor:
        """Squared error of transitions ``(batch,)``, the negative log-likelihood of a normal distribution but for constants.

        Args:
            states: ``(batch, window, state)`` in the domain's units.
            observed: features ``(batch, *shape)`` by name.
            concepts: ``(batch, n)``.
        """
        vector = self.vector(observed)
        predicted = self.predict(None if vector is None else vector[None], concepts[None])
        target = self.encode(states[:, :: self.config.stride], observed)
        return (predicted - target).square().mean(dim=(0, 2, 3))

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Deterministic but for the modes of concepts: ``sampling`` does not matter."""
        together, own = batched(compositions, count, generators)
        condition = added(together)[own]
        member = torch.arange(len(condition), device=self.device) % count % self.config.members
        rows = torch.arange(len(condition), device=self.device)

        def predict(vector: Tensor | None) -> Tensor:
            return self.predict(None if vector is None else vector[None], condition[None])[member, rows]

        return unroll(self, predict, observed or {}).unflatten(0, (len(compositions), count))


class CloningPretraining(Pretraining):
    """Fits the policy to transitions of a domain's pairs of behaviour and concept.

    Args:
        hidden_dim, members: see :class:`CloningConfig`.
        plan_horizon: states in a plan that is unrolled; ``None`` for the domain's.
        stride: see :class:`~ftl_lightning.learning.baselines.transitions.StepConfig`; ``data.horizon`` is one more, or 1.
        options: see :class:`~ftl_lightning.learning.pretraining.Pretraining`.
    """

    method = "BC"

    def __init__(
        self, hidden_dim: int = 512, members: int = 1, plan_horizon: int | None = None, stride: int = 1, **options: Any
    ) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        expect_range("model.hidden_dim", hidden_dim, 1)
        if plan_horizon is not None:
            expect_range("model.plan_horizon", plan_horizon, 1)
        self.stride = stride

    def build(
        self,
        shared: Mapping[str, Any],
        data: PretrainingData,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None,
    ) -> CloningModel:
        own = {name: self.hparams[name] for name in ("hidden_dim", "members", "stride")}
        config = CloningConfig(**dict(shared) | own | {"horizon": self.hparams["plan_horizon"] or data.domain.plans.horizon})
        expect_window(config, data)
        return CloningModel(config, data.domain, normalization, embeddings, initial_normalization)

    def losses(self, model: ConceptModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Squared error of what follows."""
        assert isinstance(model, CloningModel)
        states, seen = model.perturbed(batch.states, batch.observed, draw)
        return model.errors(states, seen, model.training_embeddings[batch.concepts])
