"""A learned concept and its file."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.concepts.adapter import LowRank
from ftl_lightning.concepts.composition import Composition, space_of
from ftl_lightning.concepts.modes import STRETCH, Modes
from ftl_lightning.concepts.point import Part
from ftl_lightning.errors import UserError, about, short, shown
from ftl_lightning.ranges import LARGEST_FACTOR, expect_factor, expect_range
from ftl_lightning.representation import Shown, counted, numbers
from ftl_lightning.schema import expect_type, from_mapping
from ftl_lightning.shipped import shipped
from ftl_lightning.tensor_file import expect_finite, load_tensors, save_tensors

KIND = "concept"
VERSION = 5
"""Version of the file format."""
MODES = ("mode_embeddings", "mode_weights")
"""Tensors of the modes, with the header's key ``mixed``; only in files of concepts that have modes."""
COMPOSING = ("composing_embeddings", "composing_weights")
"""Tensors of the set that a concept is composed from; only in files of concepts that have one."""
ADAPTER = "adapter/"
"""Prefix of the tensors of an adapter."""


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
class Choice:
    """How the form of a concept was chosen, see :mod:`ftl_lightning.learning.forms`.

    Attributes:
        form: its name.
        because: why, in a sentence.
        numbers: what was measured, by name.
    """

    form: str
    because: str
    numbers: Mapping[str, float]

    def __str__(self) -> str:
        return f"{self.form}: {self.because}"


@dataclass(frozen=True)
class QualityRecord:
    """What samples of a concept were like when somebody looked, see :mod:`ftl_lightning.learning.quality`.

    Attributes:
        samples: how many were looked at.
        novelty, spread, roughness: beside the demonstrations, as shares, 0 or more.
        metric: name of the domain's metric that tells how many are right; empty where none can.
        right: share of right samples by that metric, 0 to 1; ``None`` where none can tell.

    Raises:
        UserError: at construction, for a number out of its range.
    """

    samples: int
    novelty: float
    spread: float
    roughness: float
    metric: str = ""
    right: float | None = None

    def __post_init__(self) -> None:
        for name in ("novelty", "spread", "roughness"):
            expect_range(f"key 'quality.{name}'", getattr(self, name), 0)
        if self.right is not None:
            expect_range("key 'quality.right'", self.right, 0, 1)


@dataclass(frozen=True, repr=False)
class Concept(Shown):
    """K embeddings and their guidance weights.

    Attributes:
        embeddings: ``(K, knots, n)`` float32 in the concept space of the pretrained model: of each component one, which is the
            paper's form, or several at even times of the plan.
        weights: ``(K,)`` float32, omega.
        origin: where it comes from.
        modes: several sets of embeddings, which samples are generated from where the concept stands alone; ``None`` for the paper's
            form. Composing uses ``embeddings``, unless the concept has several knots.
        adapter: what it changes of the denoiser; ``None`` for the paper's form.
        choice: how its form was chosen; ``None`` where it was told.
        composing: embeddings ``(K, knots, n)`` and weights ``(K,)`` that take the place of all others, and of the adapter, where
            the concept is composed; ``None`` for the same as alone.
        quality: what its samples were like; ``None`` where nobody looked. It is a key of the file's header that is written only
            where it is there, and that readers who do not know it pass by.

    Raises:
        UserError: at construction, for tensors of other shapes or types.
    """

    embeddings: Tensor
    weights: Tensor
    origin: Origin
    modes: Modes | None = None
    adapter: LowRank | None = None
    choice: Choice | None = None
    composing: tuple[Tensor, Tensor] | None = None
    quality: QualityRecord | None = None

    def __post_init__(self) -> None:
        _expect_shapes(self._sets)

    @property
    def _sets(self) -> dict[str, Tensor]:
        """Embeddings and weights, by the names of a file's tensors."""
        found = {"embeddings": self.embeddings, "weights": self.weights}
        if self.modes is not None:
            found |= dict(zip(MODES, (self.modes.embeddings, self.modes.weights), strict=True))
        if self.composing is not None:
            found |= dict(zip(COMPOSING, self.composing, strict=True))
        return found

    @property
    def knots(self) -> int:
        """Embeddings of a component, at even times of the plan; 1 is the paper's form."""
        return self.embeddings.shape[1]

    def _words(self) -> Iterator[str]:
        yield repr(self.origin.name)
        yield f"K = {len(self.weights)}"
        if self.knots > 1:
            yield counted(self.knots, "knot")
        if self.modes is not None:
            yield f"{counted(len(self.modes), 'mode')}{', mixed' if self.modes.mixed else ''}"
        if self.adapter is not None:
            yield "an adapter"
        yield f"loss {self.origin.loss:.3f}"
        yield f"weights {numbers(self.weights.tolist())}"
        yield f"from {counted(self.origin.count, 'demonstration')}"
        yield f"of {space_of(self.origin.domain, self.origin.pretrained)}"

    @property
    def composition(self) -> Composition:
        """What it is generated from, alone or composed with others."""
        space = space_of(self.origin.domain, self.origin.pretrained)
        plain = Composition(self.embeddings, self.weights, modes=self.modes, space=space)
        if self.adapter is not None:
            plain = replace(plain, adapters=(self.adapter,), adapter=torch.ones(len(self.weights), dtype=torch.int64))
        return plain if self.composing is None else Composition(*self.composing, alone=plain, space=space)

    def component(self, number: int) -> Composition:
        """One of its components alone, by its number from 1."""
        chosen = slice(number - 1, number)
        one = replace(self, embeddings=self.embeddings[chosen], weights=self.weights[chosen], modes=None, composing=None)
        return one.composition

    def parts(self) -> dict[str, Part]:
        """Every knot of every component, and those of every mode, by their names."""
        sets: list[tuple[int | None, Tensor, Tensor]] = [(None, self.weights, self.embeddings)]
        if self.modes is not None:
            modes = zip(self.modes.weights, self.modes.embeddings, strict=True)
            sets += [(number, weights, embeddings) for number, (weights, embeddings) in enumerate(modes, start=1)]
        parts = [
            Part(weight, embedding, number, mode, knot if self.knots > 1 else None)
            for mode, weights, embeddings in sets
            for number, (weight, component) in enumerate(zip(weights.tolist(), embeddings, strict=True), start=1)
            for knot, embedding in enumerate(component, start=1)
        ]
        return {part.name: part for part in parts}

    @property
    def weighted_sum(self) -> Tensor:
        """Its components added up by their weights ``(knots, n)``."""
        return (self.weights @ self.embeddings.flatten(1)).unflatten(0, self.embeddings.shape[1:])

    def at_knots(self, component: Tensor) -> dict[str, Tensor]:
        """The embeddings ``(n,)`` of a component ``(knots, n)`` by the end of a name: empty of a single one, else ', knot 3'."""
        return {"" if self.knots == 1 else f", knot {knot}": embedding for knot, embedding in enumerate(component, start=1)}

    def expect_finite(self, where: str) -> None:
        """Refuse a concept of numbers that are none or too large, or of such a loss.

        Raises:
            UserError: naming ``where`` and the first of them.
        """
        expect_finite(self.numbers, where, "lower model.budget.learning_rate")
        for name, value in self.numbers.items():
            if name != "loss" and value.numel() and not value.abs().max() <= LARGEST_FACTOR:
                raise UserError(f"{where}: expected numbers up to {LARGEST_FACTOR:g}, found larger ones in {short(name)!r}")

    @property
    def numbers(self) -> dict[str, Tensor]:
        """All that it holds, by name."""
        factors = {} if self.adapter is None else self.adapter.tensors()
        return {"loss": torch.tensor(float(self.origin.loss)), **self._sets, **factors}

    def save(self, path: str | Path) -> None:
        """Write a safetensors file with a JSON header.

        Args:
            path: of the file; it is written whole or not at all.

        Raises:
            UserError: for numbers that are not finite.
        """
        self.expect_finite(str(path))
        header = {**asdict(self.origin), "components": len(self.weights)}
        if self.modes is not None:
            header |= {"mixed": self.modes.mixed}
            header |= {} if self.modes.stretch == STRETCH else {"stretch": self.modes.stretch}
        if self.choice is not None:
            header |= {"choice": asdict(self.choice)}
        if self.quality is not None:
            header |= {"quality": asdict(self.quality)}
        if self.adapter is not None and self.adapter.everywhere:
            header |= {"everywhere": True}
        factors = {} if self.adapter is None else self.adapter.tensors()
        tensors = {**self._sets, **{f"{ADAPTER}{name}": factor for name, factor in factors.items()}}
        save_tensors(path, KIND, {name: values.contiguous() for name, values in tensors.items()}, header, VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a concept.

        Args:
            path: of its file; ``pretrained/...`` is looked for in the current folder, then among the files that ship.

        Raises:
            UserError: for a file that is missing, damaged or not a concept.
        """
        tensors, header = load_tensors(shipped(path), KIND, VERSION)
        several, composed = "mixed" in header, COMPOSING[0] in tensors
        names = ["embeddings", "weights", *(MODES if several else ()), *(COMPOSING if composed else ())]
        keys = [field.name for field in fields(Origin)]
        missing = [key for key in keys if key not in header] + [name for name in names if name not in tensors]
        with about(path):
            if missing:
                raise UserError(f"expected the keys of a concept, found none of {', '.join(missing)}")
            factors = {name.removeprefix(ADAPTER): values for name, values in tensors.items() if name.startswith(ADAPTER)}
            if unknown := set(tensors) - set(names) - {f"{ADAPTER}{name}" for name in factors}:
                raise UserError(f"expected the tensors {', '.join(names)}, found {short(', '.join(sorted(unknown)))} too")
            _expect_shapes({name: tensors[name] for name in names})
            everywhere = expect_type(header.get("everywhere", False), bool, "everywhere")
            adapter = LowRank.from_tensors(factors, everywhere) if factors else None
            mixed = expect_type(header.get("mixed", False), bool, "mixed")
            stretch = expect_type(header.get("stretch", STRETCH), float, "stretch")
            expect_factor("key 'stretch'", stretch, 0)
            modes = Modes(tensors[MODES[0]], tensors[MODES[1]], mixed, stretch) if several else None
            origin = from_mapping(Origin, {key: header[key] for key in keys}, "")
            choice = from_mapping(Choice, header["choice"], "choice") if header.get("choice") else None
            composing = (tensors[COMPOSING[0]], tensors[COMPOSING[1]]) if composed else None
            quality = from_mapping(QualityRecord, header["quality"], "quality") if header.get("quality") is not None else None
            concept = cls(tensors["embeddings"], tensors["weights"], origin, modes, adapter, choice, composing, quality)
            if header.get("components", len(concept.weights)) != len(concept.weights):
                raise UserError(f"key 'components': expected {len(concept.weights)}, found {shown(header['components'])}")
            concept.expect_finite("content")
            return concept


def file_name(concept: str) -> str:
    """A concept's name as a file name: letters, digits and dots kept, the rest underscores."""
    return "".join(letter if letter.isalnum() or letter == "." else "_" for letter in concept)


def _expect_shapes(tensors: Mapping[str, Tensor]) -> None:
    """Check that the tensors of a concept are float32 and that their shapes go together.

    Args:
        tensors: ``embeddings`` ``(K, knots, n)``, ``weights`` ``(K,)``; maybe :data:`MODES` and :data:`COMPOSING`.

    Raises:
        UserError: naming the first tensor of another shape or type.
    """
    shape = tuple(tensors["embeddings"].shape)
    if len(shape) != 3 or not all(shape):
        raise UserError(f"key 'embeddings': expected shape (K, knots, n), found {shape}")
    modes = max((*tensors.get("mode_embeddings", torch.empty(0)).shape, 0)[0], 1)
    composing = (*tuple(tensors.get(COMPOSING[1], tensors["weights"]).shape)[:1], *shape[1:])
    expected = {"embeddings": shape, "weights": shape[:1], "mode_embeddings": (modes, *shape), "mode_weights": (modes, shape[0])}
    expected |= {COMPOSING[0]: composing, COMPOSING[1]: composing[:1]}
    for name, values in tensors.items():
        if values.shape != expected[name] or values.dtype != torch.float32:
            told = f"{str(values.dtype).removeprefix('torch.')} of shape {tuple(values.shape)}"
            raise UserError(f"key {name!r}: expected float32 of shape {expected[name]}, found {told}")
