"""A learned concept and its file."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

from torch import Tensor

from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import load_tensors, save_tensors

KIND = "concept"


@dataclass(frozen=True)
class Origin:
    """Where a concept comes from.

    Attributes:
        name: the task it was learned from.
        domain: name of the domain.
        encoder: identity of the text encoder behind the model's concept space.
        pretrained: hash of the pretrained model.
        demonstrations: hash of the demonstrations.
        count: number of demonstrations.
        weights: ``'fixed'`` or ``'learned'``.
        loss: composed denoising loss on the demonstrations at the end of learning.
    """

    name: str
    domain: str
    encoder: str
    pretrained: str
    demonstrations: str
    count: int
    weights: str
    loss: float


@dataclass(frozen=True)
class Concept:
    """K embeddings and their guidance weights.

    Attributes:
        embeddings: ``(K, n)`` float32 in the concept space of the pretrained model.
        weights: ``(K,)`` float32, omega.
        origin: where it comes from.
    """

    embeddings: Tensor
    weights: Tensor
    origin: Origin

    def numbered(self) -> list[tuple[int, tuple[float, Tensor]]]:
        """Weight and embedding ``(n,)`` of each component, numbered from 1."""
        return list(enumerate(zip(self.weights.tolist(), self.embeddings, strict=True), start=1))

    def save(self, path: str | Path) -> None:
        """Write a safetensors file with a JSON header."""
        tensors = {"embeddings": self.embeddings, "weights": self.weights}
        save_tensors(path, KIND, tensors, {**asdict(self.origin), "components": len(self.weights)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a concept.

        Raises:
            UserError: for a file that is missing, damaged or not a concept.
        """
        tensors, header = load_tensors(path, KIND)
        missing = [field.name for field in fields(Origin) if field.name not in header]
        missing += [name for name in ("embeddings", "weights") if name not in tensors]
        if missing:
            raise UserError(f"{path}: expected the keys of a concept, found none of {', '.join(missing)}")
        origin = Origin(**{field.name: header[field.name] for field in fields(Origin)})
        return cls(tensors["embeddings"], tensors["weights"], origin)


def load_concepts(paths: Iterable[str | Path]) -> list[Concept]:
    """Read several concepts.

    Raises:
        UserError: as :meth:`Concept.load`.
    """
    return [Concept.load(path) for path in paths]
