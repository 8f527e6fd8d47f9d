"""Whether a learned concept belongs to a model."""

from pathlib import Path

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.errors import UserError, about, short
from ftl_lightning.learning.concept_model import ConceptModel


def expect_concept(model: ConceptModel, concept: Concept, path: str | Path) -> None:
    """Refuse a learned concept that belongs to another model.

    Args:
        model: that it is to be used with.
        concept: that was read.
        path: from where.

    Raises:
        UserError: if encoder, domain or pretrained model differ, or its sizes are not those of the model.
    """
    of_model = {"encoder": model.config.encoder, "domain": model.config.domain, "pretrained": model.hash}
    for key, expected in of_model.items():
        if (found := getattr(concept.origin, key)) != expected:
            raise UserError(
                f"{path}: key {key!r}: expected {expected!r} (the pretrained model's), found {short(found)!r}; learn it again"
            )
    with about(path):
        expect_sizes(model, concept)


def expect_sizes(model: ConceptModel, concept: Concept) -> None:
    """Refuse a concept whose sizes are not those of a model.

    Raises:
        UserError: naming the key.
    """
    if (width := concept.embeddings.shape[2]) != model.config.concept_dim:
        raise UserError(f"key 'embeddings': expected {model.config.concept_dim} numbers each, found {width}")
    if concept.knots > 1 and not model.over_time:
        raise UserError(f"key 'embeddings': expected 1 knot for this model, found {concept.knots}")
    if concept.adapter is not None:
        model.expect_adapter(concept.adapter)
