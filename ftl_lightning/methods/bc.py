"""Goal-conditioned behaviour cloning (paper, 'Baselines' and 'Implementation Details'): next state from state and concept."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.bases import AdditiveModel, StepConfig, added, unroll
from ftl_lightning.services.validation import check_range
from ftl_lightning.training.concept_model import TextConceptModel
from ftl_lightning.training.model_config import Prepared


@dataclass(frozen=True, kw_only=True)
class CloningConfig(StepConfig):
    """Configuration of the cloning network.

    Attributes:
        hidden_dim: width of the hidden layer.
        members: number of networks with different initial weights. Each is deterministic; samples cycle through them (the paper
            averages over seeds), and episodes use the first.
    """

    hidden_dim: int = 512
    members: int = 1


class ParallelMLP(nn.Module):
    """Batched MLPs with a single hidden layer (ReLU).

    Args:
        members: number of MLPs.
        inputs, hidden, outputs: layer sizes.
    """

    def __init__(self, members: int, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        layers = [[nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)] for _ in range(members)]
        self.weights = nn.ParameterList(torch.stack([mlp[depth].weight.detach().T for mlp in layers]) for depth in range(2))
        self.biases = nn.ParameterList(torch.stack([mlp[depth].bias.detach()[None] for mlp in layers]) for depth in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """``(member or 1, batch, inputs)`` to ``(member, batch, outputs)``."""
        hidden = torch.relu(x @ self.weights[0] + self.biases[0])
        return hidden @ self.weights[1] + self.biases[1]


class CloningModel(AdditiveModel, TextConceptModel):
    """Deterministic policy of the concept and, if observed, the state; composing adds concepts."""

    kind = "bc"
    Config = CloningConfig
    config: CloningConfig

    def __init__(self, prepared: Prepared[CloningConfig]) -> None:
        super().__init__(prepared)
        config = prepared.config
        check_range("model.members", config.members, 1, 1000)
        inputs = config.concept_dim + config.vector_dim
        self.network = ParallelMLP(config.members, inputs, config.hidden_dim, config.moments * config.state_dim)

    @property
    def window(self) -> int:
        return self.config.window

    def predict(self, vector: Tensor | None, concepts: Tensor) -> Tensor:
        """Predict normalised transitions ``(member, batch, moments, state)`` from inputs ``(member or 1, batch, ...)``."""
        out: Tensor = self.network(concepts if vector is None else torch.cat((vector, concepts), dim=-1))
        return out.unflatten(-1, (self.config.moments, self.config.state_dim))

    def errors(self, states: Tensor, observed: Observed, concepts: Tensor) -> Tensor:
        """Squared error of transitions ``(batch,)``, the Gaussian negative log-likelihood up to constants."""
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
        """Sample plans, deterministic up to the concepts' modes; ``sampling`` is ignored."""
        together, row = batched(compositions, count, generators)
        condition = added(together)[row]
        member = torch.arange(len(condition), device=self.device) % count % self.config.members
        rows = torch.arange(len(condition), device=self.device)

        def predict(vector: Tensor | None) -> Tensor:
            return self.predict(None if vector is None else vector[None], condition[None])[member, rows]

        return unroll(self, self.config, predict, observed or {}).unflatten(0, (len(compositions), count))
