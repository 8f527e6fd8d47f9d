"""Evaluation and pictures of plans, for the Python API."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def judging_domain(model: ConceptModel, examples: Sequence[Demonstrations]) -> Domain:
    """A model's domain; for a user's data, including demonstrations of learned concepts."""
    if model.examples is None:
        return model.domain
    config = model.config
    return own_domain(concatenate(examples), config.training_concepts, config.horizon, config.metrics)


def judged(domain: Domain, plans: Demonstrations, goal: str) -> dict[str, float]:
    """Evaluate plans by the domain's metrics: success rates or means by name.

    Raises:
        UserError: for a goal that the domain cannot judge, or a domain without metrics.
    """
    if not domain.metrics:
        raise UserError(f"evaluate: expected a domain that judges plans, found {domain.name}; execute them")
    domain.check_goal(goal)
    measured = domain.measure(goal, plans.states, plans.initial_states)
    return {name: float(values.float().mean()) for name, values in measured.items()}


def picture(domain: Domain, plans: Demonstrations, goal: str = "") -> "Figure":
    """Draw plans; with a goal, right plans are framed green and wrong plans red.

    Raises:
        UserError: for a goal that the domain cannot judge.
    """
    starts, right = plans.initial_states, None
    if goal:
        domain.check_goal(goal)
        measured = domain.measure(goal, plans.states, starts).values()
        right = next((values.tolist() for values in measured if values.dtype == torch.bool and values.dim()), None)
    return domain.show.picture(plans.states, right, goal or "samples", starts if domain.observed else None)
