"""Embeddings of training concepts and learned components in a plane."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.training.concept_model import ConceptModel


@dataclass(frozen=True)
class Place:
    """An embedding in the plane.

    Attributes:
        concept: name of the concept; component: ``'k1'`` for the first, empty for a training concept.
        x, y: coordinates.
    """

    concept: str
    component: str
    x: float
    y: float

    @property
    def name(self) -> str:
        """Concept, with component in brackets."""
        return f"{self.concept} [{self.component}]" if self.component else self.concept


def concept_places(model: ConceptModel, concepts: Sequence[Concept], seed: int = 0) -> list[Place]:
    """t-SNE of training concepts and learned components (paper, figure 'tsne'; van der Maaten & Hinton, 2008), in this order.

    Args:
        model: the pretrained model.
        concepts: concepts learned with it.
        seed: seed of t-SNE.

    Raises:
        UserError: if scikit-learn is missing.
    """
    check_extra("notebooks", "concept_map")
    from sklearn.manifold import TSNE

    learned = [
        (concept.origin.name, name.replace("component ", ""), part.embedding)
        for concept in concepts
        for name, part in concept.parts().items()
        if part.mode is None  # modes would be five times as many near-copies
    ]
    embeddings = torch.cat((model.training_embeddings.cpu(), *(embedding[None] for *_, embedding in learned)))
    perplexity = min(10.0, (len(embeddings) - 1) / 3)
    points = TSNE(perplexity=perplexity, init="pca", random_state=seed).fit_transform(embeddings.numpy())
    names = [*((name, "") for name in model.config.training_concepts), *((name, part) for name, part, _ in learned)]
    return [Place(*name, float(x), float(y)) for name, (x, y) in zip(names, points, strict=True)]
