"""Check that a learned concept fits a model."""

from pathlib import Path

from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.training.concept_model import ConceptModel


def check_concept(model: ConceptModel, concept: Concept, path: str | Path) -> None:
    """Refuse a learned concept of another model.

    Args:
        model: the model.
        concept: the learned concept.
        path: file of the concept.

    Raises:
        UserError: if encoder, domain, pretrained model or sizes differ.
    """
    of_model = {"encoder": model.config.encoder, "domain": model.config.domain, "pretrained": model.hash}
    for key, expected in of_model.items():
        if (value := getattr(concept.origin, key)) != expected:
            raise UserError(
                f"{path}: key {key!r}: expected {expected!r} (the pretrained model's), found {short(value)!r}; learn it again"
            )
    with about(path):
        check_sizes(model, concept)


def check_sizes(model: ConceptModel, concept: Concept) -> None:
    """Refuse a concept whose sizes do not fit a model.

    Raises:
        UserError: with the key.
    """
    if (width := concept.embeddings.shape[2]) != model.config.concept_dim:
        raise UserError(f"key 'embeddings': expected {model.config.concept_dim} numbers each, found {width}")
    if concept.knots > 1 and not model.over_time:
        raise UserError(f"key 'embeddings': expected 1 knot for this model, found {concept.knots}")
    if concept.adapter is not None:
        model.check_adapter(concept.adapter)
