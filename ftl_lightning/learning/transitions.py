"""What one-step methods have in common: they learn what follows a state, and unroll it into a plan."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import READ, Observed
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.model_config import ModelConfig

if TYPE_CHECKING:  # it comes with Lightning, which models do without
    from ftl_lightning.domains.data import PretrainingData


@dataclass(frozen=True, kw_only=True)
class StepConfig(ModelConfig):
    """What one-step methods need beside what every model does; their ``horizon`` is that of the plans they unroll.

    Attributes:
        stride: states of a demonstration from the one that is given to the one that is predicted; between them plans are straight.
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
        """States of a demonstration that a transition spans."""
        return 1 if self.horizon == 1 else 1 + self.stride

    @property
    def moments(self) -> int:
        """States of a transition: the present and the next, or the only one of a domain without time."""
        return min(self.horizon, 2)


def expect_present(domain: Domain) -> None:
    """Refuse domains of which nothing is observed.

    Raises:
        UserError: naming the domain.
    """
    if not domain.observed:
        raise UserError(f"domain: expected one with observed features, found {domain.name}: there is no present to go on from")


def expect_present_or_moment(domain: Domain) -> None:
    """Refuse domains of which nothing is observed, unless plans are single states, which need no present.

    Raises:
        UserError: naming the domain.
    """
    if domain.plans.horizon > 1:
        expect_present(domain)


def expect_window(config: StepConfig, data: "PretrainingData") -> None:
    """Refuse windows that do not hold a transition.

    Raises:
        UserError: naming the key.
    """
    if data.horizon != config.window:
        raise UserError(f"data.horizon: expected {config.window} (states that a transition spans), found {data.horizon}")


def unroll(model: ConceptModel, config: StepConfig, predict: Callable[[Tensor | None], Tensor], observed: Observed) -> Tensor:
    """Plans ``(batch, horizon, state)`` in the domain's units.

    Args:
        model: whose transitions they are.
        config: the model's.
        predict: ``observed vectors as the model sees them (batch, m) or None -> transitions (batch, moments, state)``, normalised.
        observed: features ``(batch, *shape)`` by name, in the domain's units.
    """
    if (read := model.of_images(observed)) is not None:
        observed = {**observed, READ: read}  # of the start: what follows is imagined, and no picture shows it
    first = model.decode(predict(model.vector(observed)), observed)
    if config.horizon == 1 or (config.horizon, config.stride) == (2, 1):
        return first
    ((name, columns),) = [(name, feature.state) for name, feature in model.domain.observed.items() if feature.state]
    present = {other: values.clone() for other, values in observed.items()}
    states = [observed[name][:, columns], first[:, -1]]
    while len(states) < 1 + -(-(config.horizon - 1) // config.stride):
        present[name][:, columns] = states[-1]
        states.append(model.decode(predict(model.vector(present)), present)[:, -1])
    coarse = torch.stack(states, dim=1)
    at = torch.arange(config.horizon, device=coarse.device) / config.stride
    before = at.long().clamp(max=len(states) - 2)
    return torch.lerp(coarse[:, before], coarse[:, before + 1], (at - before)[:, None])
