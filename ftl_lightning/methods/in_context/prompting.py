"""Concepts of the in-context model: encoded demonstrations."""

from collections.abc import Callable

import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.concept import Concept
from ftl_lightning.methods.in_context.model import InContextModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.inversion import origin
from ftl_lightning.training.inversion_settings import InversionSettings


def prompt(
    model: ConceptModel,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    tell: Callable[[float], None] = lambda loss: None,
) -> dict[str, Concept]:
    """Encode demonstrations as concepts by name, without learning; ``settings``, ``steps`` and ``tell`` are ignored.

    Args:
        model: :class:`InContextModel`.
        demonstrations: demonstrations with concept texts.

    Raises:
        UserError: for a model of another method, or demonstrations with features observed only at the first time.
    """
    if not isinstance(model, InContextModel):
        raise UserError(f"model: expected one of in-context learning, found one of {model.method.name}")
    concepts = {}
    for name in dict.fromkeys(demonstrations.concepts):
        prompts = model.prompts(demonstrations.select(name))
        concepts[name] = Concept(prompts[:, None], torch.ones(len(prompts)), origin(model, demonstrations, name, "fixed", 0.0))
    return concepts
