"""Base classes of baselines: composition by addition, and transitions that are unrolled into plans."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.features import READ, Observed
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.settings import Loss
from ftl_lightning.services.errors import require
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.method import class_path
from ftl_lightning.training.model_config import ModelConfig

if TYPE_CHECKING:  # it needs Lightning, models do not
    from ftl_lightning.training.data import PretrainingData


class AdditiveModel(ConceptModel):
    """A model conditioned on the weighted sum of a composition's parts (paper, 'Implementation Details')."""

    invertible = True

    @abstractmethod
    def errors(self, states: Tensor, observed: Observed, concepts: Tensor) -> Tensor:
        """Squared error of behaviour ``(batch,)``.

        Args:
            states: ``(batch, window, state)`` in the domain's units.
            observed: features ``(batch, *shape)`` by name.
            concepts: ``(batch, n)``.
        """

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
        runs, each = len(composition.weights), added(composition)
        errors = self.errors(states, observed, each.repeat_interleave(len(states) // runs, dim=0))
        require(errors.shape == (len(states),), f"{class_path(type(self))}.errors", f"errors ({len(states)},)", tuple(errors.shape))
        return errors.unflatten(0, (runs, -1))


def added(composition: Composition) -> Tensor:
    """Weighted sums ``(row, n)`` of the concepts of a composition ``(row, K, 1, n)``.

    Raises:
        UserError: for a concept restricted to some columns: a sum acts on all columns.
    """
    require(composition.columns is None, "compose", "concepts without '@' for a model that adds them up", "groups of columns")
    rows = zip(composition.weights, composition.embeddings, strict=True)
    return torch.stack([weights @ embeddings.flatten(1) for weights, embeddings in rows])


@dataclass(frozen=True, kw_only=True)
class StepConfig(ModelConfig):
    """Configuration of one-step methods; ``horizon`` is that of the unrolled plans.

    Attributes:
        stride: states from the given to the predicted state; plans are linear between them.
    """

    stride: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.stride >= 1, "model.stride", "1 or more", self.stride)
        reason = f"(what domain {self.domain} observes holds no state from which a longer plan could be unrolled)"
        unrolls = self.horizon == 1 or (self.horizon, self.stride) == (2, 1) or self.state_columns
        lengths = f"{self.horizon} and {self.stride}"
        require(unrolls, "model.plan_horizon", f"2 states, and stride 1 {reason}", lengths)

    @property
    def window(self) -> int:
        """Number of states that a transition spans."""
        return 1 if self.horizon == 1 else 1 + self.stride

    @property
    def moments(self) -> int:
        """Number of states in a transition: present and next, or a single state in a domain without time."""
        return min(self.horizon, 2)


def check_window(config: StepConfig, data: "PretrainingData") -> None:
    """Refuse windows that are not a transition; ``UserError`` with the key."""
    require(data.horizon == config.window, "data.horizon", f"{config.window} (states that a transition spans)", data.horizon)


def unroll(model: ConceptModel, config: StepConfig, predict: Callable[[Tensor | None], Tensor], observed: Observed) -> Tensor:
    """Unroll transitions to plans ``(batch, horizon, state)`` in the domain's units.

    Args:
        predict: ``observed vectors as the model sees them (batch, m) or None -> transitions (batch, moments, state)``, normalised.
        observed: features ``(batch, *shape)`` by name, in the domain's units.
    """
    if (read := model.of_images(observed)) is not None:
        observed = {**observed, READ: read}  # the start alone has images
    first = model.decode(predict(model.vector(observed)), observed)
    if config.horizon == 1 or (config.horizon, config.stride) == (2, 1):
        return first
    ((name, columns),) = [(name, feature.state) for name, feature in model.domain.observed.items() if feature.state]
    present = {feature: values.clone() for feature, values in observed.items()}
    states = [observed[name][:, columns], first[:, -1]]
    while len(states) < 1 + -(-(config.horizon - 1) // config.stride):
        present[name][:, columns] = states[-1]
        states.append(model.decode(predict(model.vector(present)), present)[:, -1])
    coarse = torch.stack(states, dim=1)
    at = torch.arange(config.horizon, device=coarse.device) / config.stride
    before = at.long().clamp(max=len(states) - 2)
    return torch.lerp(coarse[:, before], coarse[:, before + 1], (at - before)[:, None])
