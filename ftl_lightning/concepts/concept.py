"""A learned concept and its file."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

from torch import Tensor

from ftl_lightning.concepts.composition import Composition, Modes
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import FORMAT, load_tensors, save_tensors

KIND = "concept"
VERSION = 2
"""Of the file's form, where a concept has modes. Form 1 has none; a concept without modes is still written in it."""
AXES = "mode component n"
"""What the dimensions of the modes' embeddings are. A file names them, so that a later form may add one, such as time."""


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
        modes: several sets of embeddings, which samples are generated from where the concept stands alone; ``None`` for the paper's
            form. Composing uses ``embeddings``.
    """

    embeddings: Tensor
    weights: Tensor
    origin: Origin
    modes: Modes | None = None

    @property
    def composition(self) -> Composition:
        """What it is generated from, alone or composed with others."""
        return Composition(self.embeddings, self.weights, modes=self.modes)

    def parts(self) -> dict[str, tuple[float, Tensor]]:
        """Weight and embedding ``(n,)`` of every component, and of those of every mode, by names such as 'mode 2, component 1'."""
        sets = {"": (self.weights, self.embeddings)}
        if self.modes is not None:
            each = zip(self.modes.weights, self.modes.embeddings, strict=True)
            sets |= {f"mode {number}, ": own for number, own in enumerate(each, start=1)}
        return {
            f"{name}component {number}": (weight, embedding)
            for name, (weights, embeddings) in sets.items()
            for number, (weight, embedding) in enumerate(zip(weights.tolist(), embeddings, strict=True), start=1)
        }

    def save(self, path: str | Path) -> None:
        """Write a safetensors file with a JSON header."""
        tensors = {"embeddings": self.embeddings, "weights": self.weights}
        header = {**asdict(self.origin), "components": len(self.weights)}
        if self.modes is None:
            save_tensors(path, KIND, tensors, header)
        else:
            tensors |= {"mode_embeddings": self.modes.embeddings, "mode_weights": self.modes.weights}
            header |= {"axes": AXES, "mixed": self.modes.mixed}
            save_tensors(path, KIND, tensors, header, VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a concept.

        Raises:
            UserError: for a file that is missing, damaged or not a concept.
        """
        tensors, header = load_tensors(path, KIND, (FORMAT, VERSION))
        several = header["format"] == VERSION
        keys = [*(field.name for field in fields(Origin)), *(("axes", "mixed") if several else ())]
        names = ["embeddings", "weights", *(("mode_embeddings", "mode_weights") if several else ())]
        missing = [key for key in keys if key not in header] + [name for name in names if name not in tensors]
        if missing:
            raise UserError(f"{path}: expected the keys of a concept, found none of {', '.join(missing)}")
        if several and header["axes"] != AXES:
            raise UserError(f"{path}: key 'axes': expected {AXES!r}, found {header['axes']!r}; a newer version may read it")
        modes = Modes(tensors["mode_embeddings"], tensors["mode_weights"], header["mixed"]) if several else None
        origin = Origin(**{field.name: header[field.name] for field in fields(Origin)})
        return cls(tensors["embeddings"], tensors["weights"], origin, modes)


def load_concepts(paths: Iterable[str | Path]) -> list[Concept]:
    """Read several concepts.

    Raises:
        UserError: as :meth:`Concept.load`.
    """
    return [Concept.load(path) for path in paths]
