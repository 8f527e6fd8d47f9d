"""Base class of models: concept space, normalisation, and view of behaviour."""

import difflib
import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ftl_lightning.data.actions import PRESENT
from ftl_lightning.data.deformation import Deformations, share_a_path
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import PINNED, READ, Feature, Observed, check_features, moved
from ftl_lightning.data.places import Places, feature_of, first_windows, frames_of, shift, starts
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import EMPTY_CONCEPT, TRAINING_CONCEPT, Concept, Origin, Point
from ftl_lightning.igm.forms.adapter import LowRank
from ftl_lightning.igm.forms.choice import learn
from ftl_lightning.igm.inversion import Inversion, Tell, Watch
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import ADAPTED, AUTO, MIXED, MODES, NOT_LEARNED, ONE, PAPER, InversionSettings, Loss
from ftl_lightning.networks.image_encoder import ImageEncoders
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.tensor_file import bytes_hash, serialise
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.training.method import Method, class_path, method_of
from ftl_lightning.training.model_config import ModelConfig, Prepared, find_view

KIND = "generative model"
"""Kind of a file of model weights."""
NEAREST = 3
"""Number of similar training concepts in the error for an unknown text."""


class ConceptModel(Shown, nn.Module, ABC):
    """Concept-conditioned model of behaviour: interface for adaptation, sampling and evaluation.

    Args:
        prepared: configuration, domain, normalisation, and embeddings in the model's concept space.

    Raises:
        UserError: for options that the domain does not support.

    Attributes:
        empty: embedding ``(n,)`` of the empty concept (unconditional).
        training_embeddings: ``(training concept, n)`` in the model's concept space.
        examples: demonstrations of each training concept, saved with the weights, for a user's data.
        frames: shares with which plans follow observed places ``(training concept, place, horizon)``: the network's plans are what
            the places do not explain, see :class:`~ftl_lightning.data.places.Frames`; ``None`` without places.
    """

    kind: ClassVar[str]
    """Kind of the model in ``config.json``, as in the declaration of its method."""
    Config: ClassVar[type[ModelConfig]]
    """Class of the model's configuration."""
    invertible: ClassVar[bool] = False
    """Whether concepts are learned by gradient descent on :meth:`losses`."""
    empty: Tensor
    training_embeddings: Tensor
    frames: Tensor | None

    def __init__(self, prepared: Prepared[ModelConfig]) -> None:
        super().__init__()
        for name in ("kind", "Config"):
            require(hasattr(type(self), name), class_path(type(self)), f"a class attribute {name!r}", "none")
        config, domain = prepared.config, prepared.domain
        self.config, self.domain, self.places = config, domain, config.places
        self.examples: Demonstrations | None = None
        self._see()
        perturbs = not config.perturb or self._perturb is not None
        require(perturbs, "model.perturb", "a view that can perturb the present", repr(config.view))
        images = config.image_dim or not config.image_encoder
        require(images, "image_encoder", "none, as no image is observed", dict(config.image_encoder))
        self.images = ImageEncoders(config.observed, config.image_encoder) if config.image_dim else None
        if self.images is not None:
            size = self.images.size
            require(size == config.image_dim, "image_dim", f"{size} (size of the image encoding)", config.image_dim)
        self.normalization = prepared.normalization
        self.initial_normalization = prepared.observed
        self.register_buffer("empty", prepared.embeddings[0].clone())
        self.register_buffer("training_embeddings", prepared.embeddings[1:].clone())
        self.register_buffer("frames", prepared.frames)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "view": None, "_perturb": None}  # functions of the domain

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._see()

    def _see(self) -> None:
        self.view = find_view(self.domain, self.config.view)
        self._perturb = self.view.perturb if self.config.perturb and self.view is not None else None

    @property
    def method(self) -> Method:
        """The method of the model's kind."""
        return method_of(self.kind)

    def _words(self) -> Iterator[str]:
        yield repr(self.config.domain)
        yield self.method.name
        yield counted(len(self.config.training_concepts), "training concept")
        yield counted(sum(parameter.numel() for parameter in self.parameters()), "parameter")
        if self.device.type != "meta":  # a meta model has no weights
            yield f"hash {self.hash}"
        yield f"on {self.device}"

    @abstractmethod
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Sample behaviour for several compositions in a single batch.

        Args:
            compositions: ``(K, ...)`` each; K may differ.
            count: samples for each composition.
            generators: a noise generator for each composition, so that samples do not depend on the rest of the batch.
            observed: features ``(composition * count, *shape)`` by name, in the domain's units; ``None`` for none.

        Returns:
            ``(composition, count, horizon, state)`` in the domain's units.
        """

    def learn_concepts(
        self,
        demonstrations: Demonstrations,
        settings: InversionSettings,
        steps: int,
        tell: Tell = lambda loss: None,
        watch: Watch | None = None,
        start: Inversion | None = None,
    ) -> dict[str, Concept]:
        """Learn every concept of the demonstrations, in the form of the settings, by gradient descent through the frozen model.

        A model that is not :attr:`invertible` reads its concepts from the demonstrations, see :meth:`read_concepts`.

        Args:
            demonstrations, settings, steps, tell, watch, start: see :func:`~ftl_lightning.igm.forms.choice.learn`.

        Raises:
            UserError: for settings that the model does not support, or a loss that is not finite.
        """
        if not self.invertible:
            concepts = self.read_concepts(demonstrations)
            for concept in concepts.values():
                self.check_sizes(concept)
            return concepts
        return learn(self, demonstrations, settings, steps, tell, watch, start)

    def read_concepts(self, demonstrations: Demonstrations) -> dict[str, Concept]:
        """Concepts by name, made from demonstrations without gradient descent; required of models that are not invertible.

        Raises:
            UserError: for a model that does not define it.
        """
        name = self.method.name
        raise UserError(f"model.pretrained: expected a model that learns or reads concepts, found one of {name}; mend its package")

    def check_sizes(self, concept: Concept) -> None:
        """Refuse a concept whose sizes do not fit the model; ``UserError`` with the key."""
        place, size = "key 'embeddings'", self.config.concept_dim
        require(concept.embeddings.shape[2] == size, place, f"{size} numbers each", concept.embeddings.shape[2])
        require(concept.knots == 1 or self.over_time, place, "1 knot for this model", concept.knots)
        if concept.adapter is not None:
            self.check_adapter(concept.adapter)
        sizes = [None if frames is None else tuple(frames.shape) for frames in (self.frames, concept.frames)]
        wanted = None if sizes[0] is None else sizes[0][1:]
        require(sizes[1] == wanted, "key 'frames'", "none" if wanted is None else f"shape {wanted}", sizes[1])

    def check_settings(self, settings: InversionSettings) -> None:
        """Refuse settings that the model does not support; ``UserError`` with the key."""
        name, adapts = self.method.name, bool(self.adaptable())
        require(self.invertible, "model.pretrained", "a model that concepts are learned through", f"one of {name}")
        off_span, knots = settings.embeddings.off_span, settings.embeddings.knots
        free = off_span == 1 or self.text_space
        require(free, "model.embeddings.off_span", f"1 (free) for {name}, whose concepts are no texts", off_span)
        constant = "1 for this model, whose concepts do not vary over a plan"
        require(knots == 1 or self.over_time, "model.embeddings.knots", constant, knots)
        adapted = settings.form in (AUTO, ADAPTED, MIXED, *NOT_LEARNED)
        require(adapts or not adapted, "model.form", f"{PAPER}, {ONE} or {MODES} for {name}", settings.form)
        require(adapts or not settings.adapter.rank, "model.adapter.rank", f"0 (none) for {name}", settings.adapter.rank)

    def origin(self, demonstrations: Demonstrations, name: str, weights: str, loss: float, pretrained: str = "") -> Origin:
        """Provenance of a learned concept.

        Args:
            demonstrations: demonstrations, including the concept's.
            weights: ``'fixed'`` or ``'learned'``.
            pretrained: the model's hash, if known (hashing takes as long as several steps).
        """
        selected, space = demonstrations.select(name), (self.config.domain, self.config.encoder, pretrained or self.hash)
        return Origin(name, *space, selected.hash, len(selected), weights, loss)

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws | None:
        """Random numbers of :meth:`losses`, common to all runs; ``None`` for a deterministic loss."""
        return None

    def windows(
        self, demonstrations: Demonstrations, rows: Tensor, share: Tensor, draw: torch.Generator
    ) -> tuple[Tensor, Observed]:
        """Training windows ``(row, window, state)`` and their observed features, on the model's device.

        Args:
            rows: row of the demonstration of each window ``(row,)``.
            share: relative start of each window ``(row,)``, 0 to 1; ignored with places, whose shares depend on time.
            draw: generator of the perturbation, if configured.
        """
        plans = self.domain.plans
        share = share if self.frames is None else torch.zeros_like(share)
        starts = demonstrations.starts(rows, share, plans.exponent(self.window), self.window, plans.at_rest)
        states, observed = demonstrations.windows(rows, starts, self.window)
        return self.perturbed(states.to(self.device), moved(observed, self.device), draw)

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
        """Losses ``(run, sample)`` of behaviour under concepts, for inversion by gradient descent.

        Args:
            states: ``(run * sample, window, state)`` in the domain's units.
            observed: features ``(run * sample, *shape)`` by name.
            composition: ``(run, K, ...)``.
            draws: result of :meth:`draws`.
            loss: target of a diffusion model's squared error, and weights of the states.
        """
        raise NotImplementedError(f"{type(self).__name__}: an invertible model defines losses")

    def products(self, states: Tensor, observed: Observed, frames: Tensor | None, draws: Draws | None, loss: Loss) -> Tensor | None:
        """Inner products of the branches of all training concepts; ``None`` for a model without a composed denoiser.

        See :meth:`ftl_lightning.igm.model.DiffusionModel.branch_products`.
        """
        return None

    @property
    def text_space(self) -> bool:
        """Whether the concept space is the text encoder's."""
        return False

    @property
    def traits(self) -> tuple[str, ...]:
        """Suffixes of the method's name in tables."""
        return (self.config.view,) if self.config.view else ()

    @property
    def over_time(self) -> bool:
        """Whether a concept may vary over a plan, with several knots."""
        return False

    @property
    def chooses_form(self) -> bool:
        """Whether the form of a concept of a user's data may be chosen by samples of whole behaviour."""
        return bool(self.adaptable()) and PRESENT not in self.domain.observed

    @property
    def horizon(self) -> int:
        """Number of states in a plan."""
        return self.config.horizon

    @property
    def window(self) -> int:
        """Number of states in a training window."""
        return self.config.horizon

    @property
    def max_steps(self) -> int | None:
        """Maximum number of sampler steps, the T of diffusion; ``None`` for other methods."""
        return None

    @property
    def device(self) -> torch.device:
        """The model's device."""
        return self.empty.device

    def concept(self, text: str) -> Tensor:
        """The embedding ``(n,)`` of a training concept; ``UserError`` for an unknown text, with the nearest training concepts."""
        known = self.config.training_concepts
        if text not in known:
            near = difflib.get_close_matches(str(text), known, n=NEAREST, cutoff=0)
            raise UserError(
                f"concept {shown(text)}: expected a training concept of the model: {'; '.join(short(text, 40) for text in near)} "
                f"are the nearest of {len(known)}; list all: python -m ftl_lightning concepts MODEL"
            )
        return self.training_embeddings[self.config.training_concepts.index(text)]

    def compositions(self, rows: slice | Tensor = slice(None)) -> Composition:
        """Training concepts, each with weight 1: ``(row, 1, ...)``."""
        embeddings = self.training_embeddings[rows, None, None]
        frames = None if self.frames is None else self.frames[rows, None]
        return Composition(embeddings, torch.ones(embeddings.shape[:2], device=self.device), frames=frames)

    def __getitem__(self, text: str) -> Composition:
        """A training concept, with weight 1; ``UserError`` for an unknown text."""
        self.concept(text)
        return self.compositions(slice(self.config.training_concepts.index(text), None)).row(0)

    def frames_of(self, demonstrations: Demonstrations) -> Tensor | None:
        """Frames of each concept of the demonstrations ``(concept, place, horizon)``; ``None`` for a model without places."""
        if self.frames is None:
            return None
        return frames_of(demonstrations, self.horizon, self.config.places, self.frames.cpu()).to(self.device)

    @functools.cached_property
    def variations(self) -> Deformations | None:
        """How normalised examples vary within training concepts, without what places explain; ``None`` without examples, or for a
        network that observes something.
        """
        if self.examples is None or self.config.observed:
            return None
        names, observed = self.config.training_concepts, moved(self.examples.initial_states.observed, self.device)
        rows = torch.tensor([names.index(text) for text in self.examples.concepts], device=self.device)
        frames = None if self.frames is None else self.frames[rows]
        plans = self.encode(first_windows(self.examples, self.horizon).to(self.device), observed, frames)
        several = [plans[some] for some in (rows == number for number in range(len(names))) if some.sum() > 1]
        deform = self.frames is None  # else paths follow places
        several = [paths for paths in several if share_a_path(paths)] if deform else several
        return Deformations.fit(several, deform) if several else None

    def varied(self, plans: Tensor, parts: Sequence[Composition], generators: Sequence[torch.Generator]) -> Tensor:
        """Add the variation of the compositions to normalised plans ``(composition * count, horizon, state)``."""
        variations = self.variations
        if variations is None or not any(part.variation for part in parts):
            return plans
        varied = []
        for part, draw, some in zip(parts, generators, plans.chunk(len(parts)), strict=True):
            if part.variation:
                chosen = torch.randint(len(variations), (len(some),), generator=draw, device=draw.device).to(some.device)
                some = some + part.variation**0.5 * variations.of(some, chosen)
            varied.append(some)
        return torch.cat(varied)

    def points(self) -> list[Point]:
        """Embeddings of the empty concept and the training concepts."""
        training = zip(self.config.training_concepts, self.training_embeddings, strict=True)
        return [Point("(empty)", EMPTY_CONCEPT, self.empty), *(Point(text, TRAINING_CONCEPT, each) for text, each in training)]

    def adaptable(self, by_sample: bool = False) -> dict[str, tuple[int, int]]:
        """Weights that an adapter can change, see :func:`ftl_lightning.igm.forms.adapter.adaptable`; none without adapters."""
        return {}

    def check_adapter(self, adapter: LowRank) -> None:
        """Refuse an adapter that does not fit; ``UserError`` naming the weight; always for a method without adapters."""
        raise UserError(f"key 'adapter': expected none for a model of {self.method.name}, found one")

    def perturbed(
        self, states: Tensor, observed: Observed, draw: torch.Generator, pretraining: bool = False
    ) -> tuple[Tensor, Observed]:
        """Training windows with the present state perturbed, if configured; in ``pretraining`` or in inversion."""
        if self._perturb is None or self.view is None:
            return states, observed
        augment = self.view.pretraining if pretraining and self.view.pretraining is not None else self._perturb
        return augment(states, observed, draw)

    def encode(self, states: Tensor, observed: Observed, frames: Tensor | None = None) -> Tensor:
        """Map behaviour ``(sample, horizon, state)`` in the domain's units to the network's inputs.

        ``frames``, shares ``(sample, place, horizon)`` or ``(1, place, horizon)``, subtract what observed places explain.
        """
        if frames is not None:
            features = self.domain.observed
            check_features(
                observed, {name: features[name] for name in (feature_of(place, features) for place in self.config.places)}
            )
            states = states - shift(frames, self.config.places, observed, states.shape[2])
        if self.view is not None:
            states = self.view.encode(states, observed)
        return self.normalization.encode(states)

    def decode(self, normalised: Tensor, observed: Observed, frames: Tensor | None = None) -> Tensor:
        """The inverse of :meth:`encode`."""
        states = self.normalization.decode(normalised)
        if self.view is not None:
            states = self.view.decode(states, observed)
        return states if frames is None else states + shift(frames, self.config.places, observed, states.shape[2])

    def frames_by_plan(self, compositions: Sequence[Composition], count: int) -> Tensor | None:
        """Frames of ``count`` plans of each composition ``(composition * count, place, horizon)``; ``None`` without places.

        Compositions without frames have the mean of the training concepts'.
        """
        if self.frames is None:
            return None
        mean = self.frames.mean(dim=0)
        every = [mean if (frame := each.uncomposed.frame) is None else frame.to(mean) for each in compositions]
        return torch.stack(every).repeat_interleave(count, dim=0)

    def known_states(self, observed: Observed) -> Tensor | None:
        """Known states of plans ``(sample, horizon, state)`` in the domain's units, NaN where unknown; ``None`` without any.

        States are known by the key :data:`~ftl_lightning.data.features.PINNED`, and, in a user's data, by observed features that
        equal the initial state in every demonstration.
        """
        known = observed.get(PINNED)
        if not self.starts:
            return known
        if known is None:
            count = len(next(iter(observed.values())))
            known = torch.full((count, self.horizon, len(self.domain.plans.columns)), torch.nan, device=self.device)
        known = known.clone()
        for name, columns in self.starts.items():
            first = known[:, 0, list(columns)]
            known[:, 0, list(columns)] = torch.where(first.isnan(), observed[name].flatten(1).to(known), first)
        return known

    @functools.cached_property
    def starts(self) -> Places:
        """Columns of the observed features that equal the initial state in all examples; empty for shipped domains."""
        return {} if self.examples is None or not self.examples.observed else starts(self.examples)

    def vector(self, observed: Observed) -> Tensor | None:
        """Observation vector ``(batch, m)`` of the network: normalised vectors, then image encodings; ``None`` without any.

        Args:
            observed: features by name, in the domain's units; :data:`~ftl_lightning.data.features.READ`, the result of
                :meth:`of_images`, may replace the images.

        Raises:
            UserError: for a missing feature or another shape.
        """
        if not self.config.observed:
            return None
        viewed = self._viewed(observed)
        parts = []
        if (vectors := self._vectors(viewed)) is not None:
            parts.append(self._dropped(vectors) if self.training else vectors)
        if self.images is not None:
            parts.append(self.images.from_origins(observed[READ] if READ in observed else self.images(viewed), viewed))
        return torch.cat(parts, dim=-1)

    def vectors(self, observed: Observed) -> Tensor | None:
        """Normalised observed vectors ``(batch, m)``, without image encodings; ``None`` without any."""
        return None if self.initial_normalization is None else self._vectors(self._viewed(observed))

    def _vectors(self, viewed: Observed) -> Tensor | None:
        normalization = self.initial_normalization
        return None if normalization is None else normalization.encode(joined_vectors(viewed, self.config.observed))

    def of_images(self, observed: Observed) -> Tensor | None:
        """Image encodings ``(batch, n)``, for methods that encode images once, vectors at every step; ``None`` without images."""
        encodings: Tensor | None = None if self.images is None else self.images(self._viewed(observed))
        return encodings

    def _viewed(self, observed: Observed) -> Observed:
        read = READ in observed
        if self.view is not None:
            check_features(observed, _unread(self.domain.observed, read))
            observed = self.view.observe(observed)
        check_features(observed, _unread(self.config.observed, read))
        return observed

    def _dropped(self, vectors: Tensor) -> Tensor:
        """Apply feature dropout."""
        count, device = len(vectors), vectors.device
        for name, share in self.config.feature_dropout.items():
            kept = torch.ones_like(vectors)
            hidden = drawn(count, lambda n: torch.rand(n, 1, device=device)) < share
            kept[:, self.config.columns[name]] = (~hidden).float()
            vectors = vectors * kept
        return vectors

    @property
    def hash(self) -> str:
        """Hash of the weights, the same as :func:`~ftl_lightning.services.tensor_file.file_hash` of the saved file."""
        return bytes_hash(serialise(KIND, self.stored(), {"domain": self.config.domain}))

    def stored(self) -> dict[str, Tensor]:
        """Tensors for a file: weights in half precision, buffers unchanged."""
        weights = dict(self.named_parameters())
        return {name: value.half() if name in weights else value for name, value in self.state_dict().items()}


class TextConceptModel(ConceptModel):
    """A model whose concept space is the text encoder's.

    Embeddings are centred on the training concepts and scaled to unit mean square: embeddings of language models have a large
    common component, which hides differences.

    Args:
        prepared: inputs with the encoder's embeddings.
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, prepared: Prepared[ModelConfig]) -> None:
        embeddings = prepared.embeddings
        if embeddings.is_meta:  # sizes alone: arithmetic on meta tensors imports torch's compiler, which takes a second
            centre, spread = embeddings.new_empty(embeddings.shape[1]), embeddings.new_empty(())
        else:
            centre = embeddings[1:].mean(dim=0)
            spread = (embeddings[1:] - centre).square().mean().sqrt()
            spread = torch.where(spread > 0, spread, 1)  # 0 for a single training concept
            embeddings = (embeddings - centre) / spread
        super().__init__(prepared.embedded(embeddings))
        self.register_buffer("centre", centre)
        self.register_buffer("spread", spread)

    @property
    def text_space(self) -> bool:
        return True

    def standardise(self, embeddings: Tensor) -> Tensor:
        """Map the encoder's embeddings ``(..., n)`` to the model's concept space."""
        return (embeddings - self.centre) / self.spread


def _unread(features: Mapping[str, Feature], read: bool) -> Mapping[str, Feature]:
    """Required features, without images if they are already encoded."""
    return {name: feature for name, feature in features.items() if not (read and feature.kind == "image")}


def joined_vectors(observed: Observed, features: Mapping[str, Feature]) -> Tensor:
    """Concatenate the observed vectors ``(batch, m)``."""
    vectors = [observed[name].flatten(1) for name, feature in features.items() if feature.kind == "vector"]
    return torch.cat(vectors, dim=1)
