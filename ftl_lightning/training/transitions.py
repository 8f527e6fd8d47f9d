"""Base of one-step methods: predict the next state, and unroll it into a plan."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.features import READ, Observed
from ftl_lightning.domains.domain import Domain
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_config import ModelConfig

if TYPE_CHECKING:  # it needs Lightning, models do not
    from ftl_lightning.training.data import PretrainingData


@dataclass(frozen=True, kw_only=True)
class StepConfig(ModelConfig):
    """Configuration of one-step methods; ``horizon`` is that of the unrolled plans.

    Attributes:
        stride: states from the given to the predicted state; plans are linear between them.
    """

    stride: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stride < 1:
            raise UserError(f"model.stride: expected 1 or more, found {self.stride}")
        if self.horizon > 1 and (self.horizon, self.stride) != (2, 1) and not self.state_columns:
            raise UserError(
                f"model.plan_horizon: expected 2 states, and stride 1 (what domain {self.domain} observes holds no state from "
                f"which a longer plan could be unrolled), found {self.horizon} and {self.stride}"
            )

    @property
    def window(self) -> int:
        """Number of states that a transition spans."""
        return 1 if self.horizon == 1 else 1 + self.stride

    @property
    def moments(self) -> int:
        """Number of states in a transition: present and next, or a single state in a domain without time."""
        return min(self.horizon, 2)


def check_present(domain: Domain) -> None:
    """Refuse domains without observations.

    Raises:
        UserError: with the domain.
    """
    if not domain.observed:
        raise UserError(f"domain: expected one with observed features, found {domain.name}: there is no present to go on from")


def check_present_or_moment(domain: Domain) -> None:
    """Refuse domains without observations, unless plans are single states.

    Raises:
        UserError: with the domain.
    """
    if domain.plans.horizon > 1:
        check_present(domain)


def check_window(config: StepConfig, data: "PretrainingData") -> None:
    """Refuse windows that are not a transition.

    Raises:
        UserError: with the key.
    """
    if data.horizon != config.window:
        raise UserError(f"data.horizon: expected {config.window} (states that a transition spans), found {data.horizon}")


def unroll(model: ConceptModel, config: StepConfig, predict: Callable[[Tensor | None], Tensor], observed: Observed) -> Tensor:
    """Unroll transitions to plans ``(batch, horizon, state)`` in the domain's units.

    Args:
        model: one-step model.
        config: its configuration.
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
