"""Base class of models: concept space, normalisation, and view of behaviour."""

import difflib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import READ, Feature, Observed, check_features
from ftl_lightning.igm.adapter import LowRank
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.point import EMPTY_CONCEPT, TRAINING_CONCEPT, Point
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.networks.image_encoder import ImageEncoders
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.tensor_file import bytes_hash, serialise
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.training.method import Method
from ftl_lightning.training.model_config import ModelConfig, find_view
from ftl_lightning.training.prepared import Prepared

KIND = "generative model"
"""Kind of a file of model weights."""
NEAREST = 3
"""Number of similar training concepts in the error for an unknown text."""


class Draws(NamedTuple):
    """Timesteps ``(sample,)`` int64 and noise ``(sample, horizon, state)`` of diffusion."""

    t: Tensor
    noise: Tensor


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
    """

    method: ClassVar[Method]
    """The model's method."""
    Config: ClassVar[type[ModelConfig]]
    """Class of the model's configuration."""
    invertible: ClassVar[bool] = False
    """Whether concepts are learned through :meth:`losses` by gradient descent."""
    empty: Tensor
    training_embeddings: Tensor

    def __init__(self, prepared: Prepared[ModelConfig]) -> None:
        super().__init__()
        config, domain = prepared.config, prepared.domain
        self.config, self.domain = config, domain
        self.examples: Demonstrations | None = None
        self.view = find_view(domain, config.view)
        self._perturb = self.view.perturb if config.perturb and self.view is not None else None
        if config.perturb and self._perturb is None:
            raise UserError(f"model.perturb: expected a view that can perturb the present, found {config.view!r}")
        if config.image_encoder and not config.image_dim:
            raise UserError(f"image_encoder: expected none, as no image is observed, found {shown(dict(config.image_encoder))}")
        self.images = ImageEncoders(config.observed, config.image_encoder) if config.image_dim else None
        if self.images is not None and self.images.size != config.image_dim:
            raise UserError(f"image_dim: expected {self.images.size} (what is read of the images), found {config.image_dim}")
        self.normalization = prepared.normalization
        self.initial_normalization = prepared.observed
        self.register_buffer("empty", prepared.embeddings[0].clone())
        self.register_buffer("training_embeddings", prepared.embeddings[1:].clone())

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
        """Sample behaviour for several compositions in one batch.

        Args:
            compositions: ``(K, ...)`` each; K may differ.
            count: samples for each composition.
            sampling: sampler, steps and temperature.
            generators: a noise generator for each composition, so that samples do not depend on the rest of the batch.
            observed: features ``(composition * count, *shape)`` by name, in the domain's units; ``None`` for none.

        Returns:
            ``(composition, count, horizon, state)`` in the domain's units.
        """

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws | None:
        """Random numbers of :meth:`losses`, shared by all runs; ``None`` for a deterministic loss."""
        return None

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        """Losses of behaviour under concepts, for inversion by gradient descent.

        Args:
            states: ``(run * sample, window, state)`` in the domain's units.
            observed: features ``(run * sample, *shape)`` by name.
            composition: ``(run, K, ...)``.
            draws: result of :meth:`draws`.
            loss: target of a diffusion model's squared error.

        Returns:
            ``(run, sample)``.

        Raises:
            UserError: for a method without inversion.
        """
        raise UserError(f"model.pretrained: expected a model that concepts are learned through, found one of {self.method.name}")

    @property
    def traits(self) -> tuple[str, ...]:
        """Suffixes of the method's name in tables."""
        return (self.config.view,) if self.config.view else ()

    @property
    def over_time(self) -> bool:
        """Whether a concept may vary over a plan, with several knots."""
        return False

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
        """The embedding ``(n,)`` of a training concept.

        Raises:
            UserError: for an unknown text, with the nearest training concepts.
        """
        known = self.config.training_concepts
        if text not in known:
            near = difflib.get_close_matches(str(text), known, n=NEAREST, cutoff=0)
            raise UserError(
                f"concept {shown(text)}: expected a training concept of the model: {'; '.join(short(text, 40) for text in near)} "
                f"are the nearest of {len(known)}; list all: python -m ftl_lightning concepts MODEL"
            )
        return self.training_embeddings[self.config.training_concepts.index(text)]

    def points(self) -> list[Point]:
        """Embeddings of the empty concept and the training concepts."""
        training = zip(self.config.training_concepts, self.training_embeddings, strict=True)
        return [Point("(empty)", EMPTY_CONCEPT, self.empty), *(Point(text, TRAINING_CONCEPT, each) for text, each in training)]

    def adaptable(self) -> dict[str, tuple[int, int]]:
        """Weights that an adapter can change, see :func:`ftl_lightning.igm.adapter.adaptable`; none without adapters."""
        return {}

    def check_adapter(self, adapter: LowRank) -> None:
        """Refuse an adapter that does not fit.

        Raises:
            UserError: naming the weight; always for a method without adapters.
        """
        raise UserError(f"key 'adapter': expected none for a model of {self.method.name}, found one")

    def perturbed(self, states: Tensor, observed: Observed, draw: torch.Generator) -> tuple[Tensor, Observed]:
        """Training windows with the present state perturbed, if configured."""
        return (states, observed) if self._perturb is None else self._perturb(states, observed, draw)

    def encode(self, states: Tensor, observed: Observed) -> Tensor:
        """Map behaviour ``(sample, horizon, state)`` in the domain's units to the network's inputs."""
        if self.view is not None:
            states = self.view.encode(states, observed)
        return self.normalization.encode(states)

    def decode(self, normalised: Tensor, observed: Observed) -> Tensor:
        """The inverse of :meth:`encode`."""
        states = self.normalization.decode(normalised)
        return states if self.view is None else self.view.decode(states, observed)

    def vector(self, observed: Observed) -> Tensor | None:
        """Observation vector ``(batch, m)`` of the network: normalised vectors, then image encodings.

        Args:
            observed: features by name, in the domain's units; :data:`~ftl_lightning.data.features.READ`, the result of
                :meth:`of_images`, may replace the images.

        Returns:
            ``None`` if nothing is observed.

        Raises:
            UserError: for a missing feature or another shape.
        """
        if not self.config.observed:
            return None
        seen = self._seen(observed)
        parts = []
        if self.initial_normalization is not None:
            vectors = self.initial_normalization.encode(joined_vectors(seen, self.config.observed))
            parts.append(self._dropped(vectors) if self.training else vectors)
        if self.images is not None:
            parts.append(self.images.from_origins(observed[READ] if READ in observed else self.images(seen), seen))
        return torch.cat(parts, dim=-1)

    def of_images(self, observed: Observed) -> Tensor | None:
        """Image encodings ``(batch, n)``, for methods that encode images once and vectors often; ``None`` without images."""
        read: Tensor | None = None if self.images is None else self.images(self._seen(observed))
        return read

    def _seen(self, observed: Observed) -> Observed:
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


def _unread(features: Mapping[str, Feature], read: bool) -> Mapping[str, Feature]:
    """Required features, without images if they are already encoded."""
    return {name: feature for name, feature in features.items() if not (read and feature.kind == "image")}


def joined_vectors(observed: Observed, features: Mapping[str, Feature]) -> Tensor:
    """Concatenate the observed vectors ``(batch, m)``."""
    vectors = [observed[name].flatten(1) for name, feature in features.items() if feature.kind == "vector"]
    return torch.cat(vectors, dim=1)
