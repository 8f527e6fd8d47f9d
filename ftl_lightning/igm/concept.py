"""A learned concept and its file."""

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from ftl_lightning.data.references import NAMES, VARIED, Reference
from ftl_lightning.igm.composition import Composition, space_of
from ftl_lightning.igm.forms.adapter import LowRank
from ftl_lightning.igm.forms.modes import STRETCH, Modes
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.shipped import shipped
from ftl_lightning.services.tensor_file import check_finite, load_tensors, save_tensors
from ftl_lightning.services.text import Shown, counted, numbers
from ftl_lightning.services.validation import LARGEST_FACTOR, check_factor, check_range, check_type, from_mapping

KIND = "concept"
SKILL, NEARER, KNOWN = "skill, ", "nearer, ", "best training concept"
"""Prefixes of :attr:`Choice.skills` and :attr:`Choice.nearer` in its numbers, and the reference of a training concept."""
VERSION = 5
"""Version of the file format."""
MODES = ("mode_embeddings", "mode_weights")
"""Tensors of the modes, with the header's key ``mixed``; only in files of concepts with modes."""
COMPOSING = ("composing_embeddings", "composing_weights")
"""Tensors that replace all others when composing; only in files of concepts with such a set."""
FRAMES = "frames"
"""Tensor of the shares of observed places; only in files of models with places."""
ADAPTER = "adapter/"
"""Prefix of the tensors of an adapter."""
REFERENCE = "reference/"
"""Prefix of the tensors of a reference."""
EMPTY_CONCEPT, TRAINING_CONCEPT, NEW_COMPONENT = "empty concept", "training concept", "new component"
"""Values of :attr:`Point.set`."""


class Part(NamedTuple):
    """An embedding of a learned concept. Numbers count from 1.

    Attributes:
        weight: weight of the component.
        embedding: ``(n,)``.
        component: number of the component.
        mode: number of the mode; ``None`` without modes.
        knot: number of the knot; ``None`` for a single knot.
    """

    weight: float
    embedding: Tensor
    component: int
    mode: int | None = None
    knot: int | None = None

    @property
    def name(self) -> str:
        """Name such as ``'component 1'``, ``'mode 2, component 1'`` or ``'component 1, knot 3'``."""
        mode = "" if self.mode is None else f"mode {self.mode}, "
        return f"{mode}component {self.component}{'' if self.knot is None else f', knot {self.knot}'}"


class Point(NamedTuple):
    """An embedding of a concept space.

    Attributes:
        text: name of the concept.
        set: :data:`EMPTY_CONCEPT`, :data:`TRAINING_CONCEPT` or :data:`NEW_COMPONENT`.
        embedding: ``(n,)``.
        part: part of a learned concept; ``None`` otherwise.
    """

    text: str
    set: str
    embedding: Tensor
    part: Part | None = None


@dataclass(frozen=True)
class Origin:
    """Provenance of a concept.

    Attributes:
        name: name of the task.
        domain: name of the domain.
        encoder: identity of the model's text encoder.
        pretrained: hash of the pretrained model.
        demonstrations: hash of the demonstrations.
        count: number of demonstrations.
        weights: ``'fixed'`` or ``'learned'``.
        loss: final composed denoising loss on the demonstrations.
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
    """Selection of a concept's form, see :mod:`ftl_lightning.igm.forms.choice`.

    Attributes:
        form: name of the form.
        because: reason, as a sentence.
        numbers: measurements by name.
    """

    form: str
    because: str
    numbers: Mapping[str, float]

    def __str__(self) -> str:
        return f"{self.form}: {self.because}"

    @property
    def skills(self) -> Mapping[str, float]:
        """Skill of forms and references on left-out demonstrations, see :class:`~ftl_lightning.igm.forms.skill.LeftOut`."""
        return self._named(SKILL)

    @property
    def nearer(self) -> Mapping[str, float]:
        """Share of samples of forms and references that are nearer to the demonstrations than to the best training concept."""
        return self._named(NEARER)

    def _named(self, prefix: str) -> dict[str, float]:
        return {name.removeprefix(prefix): value for name, value in self.numbers.items() if name.startswith(prefix)}

    @property
    def words(self) -> str:
        """Skill of the form beside references that need no learning, and share of nearer samples; empty if it was not measured."""
        skills = self.skills
        if self.form not in skills:
            return ""
        others = sorted(
            ((skills[name], name) for name in (*NAMES, VARIED, KNOWN) if name in skills and name != self.form), reverse=True
        )
        beside = ", ".join(f"{name} {value:.2f}" for value, name in others)
        said = f"skill {skills[self.form]:.2f} (without learning: {beside})"
        share = self.nearer.get(self.form)
        return said if share is None else f"{said}, {share:.2f} of samples nearer to demonstrations than to the {KNOWN}"


@dataclass(frozen=True)
class QualityRecord:
    """Quality of a concept's samples, see :mod:`ftl_lightning.igm.forms.quality`.

    Attributes:
        samples: number of evaluated samples.
        novelty, spread, roughness: relative to the demonstrations, 0 or more.
        metric: name of the domain's success metric; empty without such a metric.
        right: share of right samples by ``metric``, 0 to 1; ``None`` without a metric.

    Raises:
        UserError: at construction, for a value out of range.
    """

    samples: int
    novelty: float
    spread: float
    roughness: float
    metric: str = ""
    right: float | None = None

    def __post_init__(self) -> None:
        for name in ("novelty", "spread", "roughness"):
            check_range(f"key 'quality.{name}'", getattr(self, name), 0)
        if self.right is not None:
            check_range("key 'quality.right'", self.right, 0, 1)


@dataclass(frozen=True, repr=False)
class Concept(Shown):
    """K embeddings and their guidance weights.

    Attributes:
        embeddings: ``(K, knots, n)`` float32 in the pretrained model's concept space. Each component has a single embedding (the
            paper's form) or several at evenly spaced times of the plan.
        weights: ``(K,)`` float32, omega.
        origin: provenance.
        modes: several sets of embeddings for sampling the concept alone; ``None`` for the paper's form. Composing uses
            ``embeddings``, unless the concept has several knots.
        adapter: low-rank change of the denoiser; ``None`` for the paper's form.
        choice: how the form was selected; ``None`` if the user set it.
        composing: embeddings ``(K, knots, n)`` and weights ``(K,)`` that replace all others, and the adapter, when composing;
            ``None`` to compose the concept as it is alone.
        reference: maker of the concept's samples without the model, such as a shifted demonstration; ``None`` for samples of the
            model. Composing uses the embeddings.
        share: share of the samples alone that the reference makes, above 0 to 1.
        variation: share of the variance of training concepts in samples, see :class:`~ftl_lightning.igm.composition.Composition`.
        quality: quality of the samples; ``None`` if not measured. Optional key of the file's header.
        frames: shares of observed places in plans ``(place, horizon)``, see :class:`~ftl_lightning.data.places.Frames`; ``None``
            for a model without places.

    Raises:
        UserError: at construction, for wrong shapes or dtypes.
    """

    embeddings: Tensor
    weights: Tensor
    origin: Origin
    modes: Modes | None = None
    adapter: LowRank | None = None
    choice: Choice | None = None
    composing: tuple[Tensor, Tensor] | None = None
    quality: QualityRecord | None = None
    reference: Reference | None = None
    frames: Tensor | None = None
    share: float = 1.0
    variation: float = 0.0

    def __post_init__(self) -> None:
        _expect_shapes(self._sets)
        check_range("key 'share'", self.share, 0, 1)
        check_range("key 'variation'", self.variation, 0, 1)

    @property
    def _sets(self) -> dict[str, Tensor]:
        """Embeddings and weights by tensor name."""
        sets = {"embeddings": self.embeddings, "weights": self.weights}
        if self.modes is not None:
            sets |= dict(zip(MODES, (self.modes.embeddings, self.modes.weights), strict=True))
        if self.composing is not None:
            sets |= dict(zip(COMPOSING, self.composing, strict=True))
        return sets if self.frames is None else sets | {FRAMES: self.frames}

    @property
    def knots(self) -> int:
        """Number of embeddings per component, at evenly spaced times of the plan; 1 is the paper's form."""
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
        if self.reference is not None:
            yield f"{self.share:.0%} {self.reference.name}"
        if self.variation:
            yield f"{self.variation:.0%} of the variance of training concepts"
        yield f"loss {self.origin.loss:.3f}"
        yield f"weights {numbers(self.weights.tolist())}"
        yield f"from {counted(self.origin.count, 'demonstration')}"
        yield f"of {space_of(self.origin.domain, self.origin.pretrained)}"

    @property
    def composition(self) -> Composition:
        """The concept as a composition, to sample alone or to compose."""
        space = space_of(self.origin.domain, self.origin.pretrained)
        common: dict[str, Any] = {"variation": self.variation, "space": space}
        plain = Composition(self.embeddings, self.weights, modes=self.modes, frames=self._frames(self.weights), **common)
        if self.adapter is not None:
            plain = replace(plain, adapters=(self.adapter,), adapter=torch.ones(len(self.weights), dtype=torch.int64))
        if self.reference is not None:
            plain = replace(plain, made=self.reference, share=self.share)
        composing = self.composing
        if composing is None and self.reference is not None:
            composing = self.embeddings, self.weights
        if composing is None:
            return plain
        return Composition(*composing, frames=self._frames(composing[1]), alone=plain, **common)

    def _frames(self, weights: Tensor) -> Tensor | None:
        """Frames of each component ``(K, place, horizon)``."""
        return None if self.frames is None else self.frames.expand(len(weights), *self.frames.shape)

    def component(self, number: int) -> Composition:
        """A single component; ``number`` counts from 1."""
        rows = slice(number - 1, number)
        component = replace(self, embeddings=self.embeddings[rows], weights=self.weights[rows], modes=None, composing=None)
        return component.composition

    def parts(self) -> dict[str, Part]:
        """All knots of all components, including those of the modes, by name."""
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
        """Weighted sum of the components ``(knots, n)``."""
        return (self.weights @ self.embeddings.flatten(1)).unflatten(0, self.embeddings.shape[1:])

    def at_knots(self, component: Tensor) -> dict[str, Tensor]:
        """Embeddings ``(n,)`` of a component ``(knots, n)`` by name suffix: empty for a single knot, else ', knot 3'."""
        return {"" if self.knots == 1 else f", knot {knot}": embedding for knot, embedding in enumerate(component, start=1)}

    def check_finite(self, where: str) -> None:
        """Check that all tensors and the loss are finite and the tensors not too large.

        Raises:
            UserError: naming ``where`` and the first offending value.
        """
        check_finite(self.numbers, where, "lower model.budget.learning_rate")
        for name, value in self.numbers.items():
            if name != "loss" and value.numel() and not value.abs().max() <= LARGEST_FACTOR:
                raise UserError(f"{where}: expected numbers up to {LARGEST_FACTOR:g}, found larger ones in {short(name)!r}")

    @property
    def numbers(self) -> dict[str, Tensor]:
        """Loss and all tensors by name."""
        factors = {} if self.adapter is None else self.adapter.tensors()
        made = {} if self.reference is None else self.reference.tensors()
        return {"loss": torch.tensor(float(self.origin.loss)), **self._sets, **factors, **made}

    def save(self, path: str | Path) -> None:
        """Write a safetensors file with a JSON header.

        Args:
            path: output file, written atomically.

        Raises:
            UserError: for non-finite or too large values.
        """
        self.check_finite(str(path))
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
        header |= {"variation": self.variation} if self.variation else {}
        factors = {} if self.adapter is None else self.adapter.tensors()
        tensors = {**self._sets, **{f"{ADAPTER}{name}": factor for name, factor in factors.items()}}
        if self.reference is not None:
            header |= {"reference": self.reference.header, "share": self.share}
            tensors |= {f"{REFERENCE}{name}": values for name, values in self.reference.tensors().items()}
        save_tensors(path, KIND, {name: values.contiguous() for name, values in tensors.items()}, header, VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a concept.

        Args:
            path: input file; ``pretrained/...`` is searched in the current folder, then among the shipped files.

        Raises:
            UserError: for a file that is missing, damaged or not a concept.
        """
        tensors, header = load_tensors(shipped(path), KIND, VERSION)
        several, composed = "mixed" in header, COMPOSING[0] in tensors
        names = ["embeddings", "weights", *(MODES if several else ()), *(COMPOSING if composed else ())]
        names += [FRAMES] if FRAMES in tensors else []
        keys = [field.name for field in fields(Origin)]
        missing = [key for key in keys if key not in header] + [name for name in names if name not in tensors]
        with about(path):
            if missing:
                raise UserError(f"expected the keys of a concept, found none of {', '.join(missing)}")
            factors = {name.removeprefix(ADAPTER): values for name, values in tensors.items() if name.startswith(ADAPTER)}
            made = {name.removeprefix(REFERENCE): values for name, values in tensors.items() if name.startswith(REFERENCE)}
            of_parts = {f"{ADAPTER}{name}" for name in factors} | {f"{REFERENCE}{name}" for name in made}
            if unknown := set(tensors) - set(names) - of_parts:
                raise UserError(f"expected the tensors {', '.join(names)}, found {short(', '.join(sorted(unknown)))} too")
            _expect_shapes({name: tensors[name] for name in names})
            everywhere = check_type(header.get("everywhere", False), bool, "everywhere")
            adapter = LowRank.from_tensors(factors, everywhere) if factors else None
            mixed = check_type(header.get("mixed", False), bool, "mixed")
            stretch = check_type(header.get("stretch", STRETCH), float, "stretch")
            check_factor("key 'stretch'", stretch, 0)
            modes = Modes(tensors[MODES[0]], tensors[MODES[1]], mixed, stretch) if several else None
            origin = from_mapping(Origin, {key: header[key] for key in keys}, "")
            choice = from_mapping(Choice, header["choice"], "choice") if header.get("choice") else None
            composing = (tensors[COMPOSING[0]], tensors[COMPOSING[1]]) if composed else None
            quality = from_mapping(QualityRecord, header["quality"], "quality") if header.get("quality") is not None else None
            reference = Reference.from_file(made, header.get("reference")) if made or "reference" in header else None
            share = check_type(header.get("share", 1.0), float, "share")
            variation = check_type(header.get("variation", 0.0), float, "variation")
            parts = (origin, modes, adapter, choice, composing, quality, reference, tensors.get(FRAMES), share, variation)
            concept = cls(tensors["embeddings"], tensors["weights"], *parts)
            if header.get("components", len(concept.weights)) != len(concept.weights):
                raise UserError(f"key 'components': expected {len(concept.weights)}, found {shown(header['components'])}")
            concept.check_finite("content")
            return concept


LONGEST_NAME = 200
"""Maximum bytes of a file name without its ending."""


def file_name(concept: str) -> str:
    """File name of a concept: letters, digits and dots are kept, all else becomes underscores.

    Leading dots are left out, and a long name is cut and marked by its hash.
    """
    name = "".join(letter if letter.isalnum() or letter == "." else "_" for letter in concept)
    name = name.lstrip(".") or "concept"
    if len(name.encode()) <= LONGEST_NAME:
        return name
    return f"{name.encode()[: LONGEST_NAME - 9].decode(errors='ignore')}_{zlib.crc32(concept.encode(errors='replace')):08x}"


def _expect_shapes(tensors: Mapping[str, Tensor]) -> None:
    """Check that tensors are float32: ``embeddings (K, knots, n)``, ``weights (K,)``, and any of modes and composing."""
    shape = tuple(tensors["embeddings"].shape)
    if len(shape) != 3 or not all(shape):
        raise UserError(f"key 'embeddings': expected shape (K, knots, n), found {shape}")
    modes = max((*tensors.get("mode_embeddings", torch.empty(0)).shape, 0)[0], 1)
    composing = (*tuple(tensors.get(COMPOSING[1], tensors["weights"]).shape)[:1], *shape[1:])
    expected = {"embeddings": shape, "weights": shape[:1], "mode_embeddings": (modes, *shape), "mode_weights": (modes, shape[0])}
    expected |= {COMPOSING[0]: composing, COMPOSING[1]: composing[:1]}
    frames = tuple(tensors[FRAMES].shape) if FRAMES in tensors else ()
    expected |= {FRAMES: frames if len(frames) == 2 and all(frames) else (0, 0)}
    for name, values in tensors.items():
        if values.shape != expected[name] or values.dtype != torch.float32:
            actual = f"{str(values.dtype).removeprefix('torch.')} of shape {tuple(values.shape)}"
            raise UserError(f"key {name!r}: expected float32 of shape {expected[name]}, found {actual}")
