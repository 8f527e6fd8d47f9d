"""What every method's model has: a concept space, normalisation, a view of behaviour, and the folder it is kept in."""

import difflib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.adapter import LowRank
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import Feature, Observed, expect_features
from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion.image_encoder import ImageEncoders
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import OWN, own_domain
from ftl_lightning.domains.registry import domain_of_file
from ftl_lightning.errors import UserError, about, short, shown
from ftl_lightning.learning.model_config import CONFIG, VERSION, ModelConfig, expect_domain, find_view, read_config, upgrade
from ftl_lightning.learning.model_weights import WEIGHTS, at_most, expect_weights
from ftl_lightning.representation import Shown, counted
from ftl_lightning.schema import built
from ftl_lightning.tensor_file import (
    alone,
    bytes_hash,
    expect_finite,
    file_hash,
    load_tensors,
    save_tensors,
    serialise,
    write_text,
)

KIND = "generative model"
NEAREST = 3
"""Training concepts that are told for a text that is none."""
EXAMPLES = "demonstrations.safetensors"
"""In the folder of a model of a user's own data."""


class Draws(NamedTuple):
    """Timesteps ``(sample,)`` int64 and noise ``(sample, horizon, state)`` of diffusion."""

    t: Tensor
    noise: Tensor


class ConceptModel(Shown, nn.Module, ABC):
    """A model of behaviour given a concept: what adapting, sampling and evaluation ask of every method.

    Args:
        config: sizes and names.
        domain: whose behaviour it is.
        normalization: of states.
        embeddings: ``(1 + training concepts, n)``, the empty concept first.
        initial_normalization: of the observed vectors, one after another, where there are any.

    Attributes:
        empty: the empty concept ``(n,)`` in the model's concept space.
        training_embeddings: ``(training concept, n)``, likewise.
        examples: of a user's own data, some demonstrations of each training concept, kept beside the weights.
    """

    kind: ClassVar[str]
    """Which method's model a folder holds."""
    name: ClassVar[str]
    """The method's name in tables."""
    Config: ClassVar[type[ModelConfig]]
    """Of the class's models."""
    empty: Tensor
    training_embeddings: Tensor

    def __init__(
        self,
        config: ModelConfig,
        domain: Domain,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        super().__init__()
        self.config, self.domain = config, domain
        self.examples: Demonstrations | None = None
        self.view = find_view(domain, config.view)
        if config.perturb and (self.view is None or self.view.perturb is None):
            raise UserError(f"model.perturb: expected a view that can perturb the present, found {config.view!r}")
        if config.image_encoder and not config.image_dim:
            raise UserError(f"image_encoder: expected none, as no image is observed, found {shown(dict(config.image_encoder))}")
        self.images = ImageEncoders(config.observed, config.image_encoder) if config.image_dim else None
        if self.images is not None and self.images.size != config.image_dim:
            raise UserError(f"image_dim: expected {self.images.size} (what is read of the images), found {config.image_dim}")
        self.normalization = normalization
        self.initial_normalization = initial_normalization
        self.register_buffer("empty", embeddings[0].clone())
        self.register_buffer("training_embeddings", embeddings[1:].clone())

    def _words(self) -> Iterator[str]:
        yield repr(self.config.domain)
        yield self.name
        yield counted(len(self.config.training_concepts), "training concept")
        yield counted(sum(parameter.numel() for parameter in self.parameters()), "parameter")
        if self.device.type != "meta":  # on paper it has no weights
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
        """Generate behaviour of several compositions in one batch.

        Args:
            compositions: ``(K, ...)`` each; K may differ between them.
            count: samples of each.
            sampling: sampler, steps and temperature.
            generators: of the noise, one for each composition, so that its samples do not depend on what is sampled beside it.
            observed: features ``(composition * count, *shape)`` by name, in the domain's units; ``None`` for none.

        Returns:
            ``(composition, count, horizon, state)`` in the domain's units.
        """

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws | None:
        """What is random in :meth:`losses`, alike for every run; ``None`` for a method that has nothing random."""
        return None

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        """How badly concepts explain behaviour, for a method that learns them by gradient descent.

        Args:
            states: ``(run * sample, window, state)`` in the domain's units.
            observed: features ``(run * sample, *shape)`` by name.
            composition: ``(run, K, ...)``.
            draws: of :meth:`draws`.
            loss: whose squared error a diffusion model minimises.

        Returns:
            ``(run, sample)``.

        Raises:
            UserError: for a method that learns none.
        """
        raise UserError(f"model.pretrained: expected a model that concepts are learned through, found one of {self.name}")

    @property
    def traits(self) -> tuple[str, ...]:
        """What tables tell of the model beside the method's name."""
        return (self.config.view,) if self.config.view else ()

    @property
    def over_time(self) -> bool:
        """Whether a concept may vary over a plan, with several knots."""
        return False

    @property
    def window(self) -> int:
        """States of a demonstration that are learned from together."""
        return self.config.horizon

    @property
    def max_steps(self) -> int | None:
        """Most steps that a sampler can make, the T of diffusion; ``None`` for a method without."""
        return None

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self.empty.device

    def concept(self, text: str) -> Tensor:
        """The embedding ``(n,)`` of a training concept.

        Raises:
            UserError: for a text that is none, with the nearest that are some.
        """
        known = self.config.training_concepts
        if text not in known:
            near = difflib.get_close_matches(str(text), known, n=NEAREST, cutoff=0)
            raise UserError(
                f"concept {shown(text)}: expected a training concept of the model: {'; '.join(short(one, 40) for one in near)} "
                f"are the nearest of {len(known)}; list all: python -m ftl_lightning concepts MODEL"
            )
        return self.training_embeddings[self.config.training_concepts.index(text)]

    def named_embeddings(self) -> dict[str, Tensor]:
        """The training concepts' embeddings ``(n,)`` by text, and the empty one's."""
        return {"(empty)": self.empty} | dict(zip(self.config.training_concepts, self.training_embeddings, strict=True))

    def check(self, concept: Concept, path: str | Path) -> None:
        """Refuse a learned concept that belongs to another model.

        Raises:
            UserError: if encoder, domain or pretrained model differ, or its sizes are not those of the model.
        """
        mine = {"encoder": self.config.encoder, "domain": self.config.domain, "pretrained": self.hash}
        for key, expected in mine.items():
            if (found := getattr(concept.origin, key)) != expected:
                raise UserError(
                    f"{path}: key {key!r}: expected {expected!r} (the pretrained model's), found {short(found)!r}; learn it again"
                )
        with about(path):
            if (found := concept.embeddings.shape[2]) != self.config.concept_dim:
                raise UserError(f"key 'embeddings': expected {self.config.concept_dim} numbers each, found {found}")
            if concept.knots > 1 and not self.over_time:
                raise UserError(f"key 'embeddings': expected 1 knot for this model, found {concept.knots}")
            if concept.adapter is not None:
                self.expect_adapter(concept.adapter)

    def expect_adapter(self, adapter: LowRank) -> None:
        """Refuse an adapter that does not fit.

        Raises:
            UserError: naming what it would change; for a method without adapters, any.
        """
        raise UserError(f"key 'adapter': expected none for a model of {self.name}, found one")

    def perturbed(self, states: Tensor, observed: Observed, draw: torch.Generator) -> tuple[Tensor, Observed]:
        """What to learn from: behaviour with another present, if the model's configuration says so."""
        if not self.config.perturb:
            return states, observed
        assert self.view is not None
        assert self.view.perturb is not None
        return self.view.perturb(states, observed, draw)

    def encode(self, states: Tensor, observed: Observed) -> Tensor:
        """Behaviour ``(sample, horizon, state)`` in the domain's units to what the network sees."""
        if self.view is not None:
            states = self.view.encode(states, observed)
        return self.normalization.encode(states)

    def decode(self, normalised: Tensor, observed: Observed) -> Tensor:
        """The inverse of :meth:`encode`."""
        states = self.normalization.decode(normalised)
        return states if self.view is None else self.view.decode(states, observed)

    def vector(self, observed: Observed, of_images: Tensor | None = None) -> Tensor | None:
        """What is observed as the network sees it: vectors one after another, then what is read of images ``(batch, m)``.

        Args:
            observed: features by name, in the domain's units.
            of_images: what :meth:`of_images` read, where it has been read before.

        Returns:
            ``None`` where nothing is observed.

        Raises:
            UserError: if a feature is missing or of another shape.
        """
        if not self.config.observed:
            return None
        seen = self._seen(observed)
        parts = []
        if self.initial_normalization is not None:
            vectors = self.initial_normalization.encode(joined_vectors(seen, self.config.observed))
            parts.append(self._dropped(vectors) if self.training else vectors)
        if self.images is not None:
            parts.append(self.images.from_origins(self.images(seen) if of_images is None else of_images, seen))
        return torch.cat(parts, dim=-1)

    def of_images(self, observed: Observed) -> Tensor | None:
        """What is read of observed images ``(batch, n)``, for methods that look at them once and at vectors often; ``None`` where
        none is observed.
        """
        found: Tensor | None = None if self.images is None else self.images(self._seen(observed))
        return found

    def _seen(self, observed: Observed) -> Observed:
        if self.view is not None:
            expect_features(observed, self.domain.observed)
            observed = self.view.observe(observed)
        expect_features(observed, self.config.observed)
        return observed

    def _dropped(self, vectors: Tensor) -> Tensor:
        """The same where some of the vectors are hidden."""
        for name, share in self.config.feature_dropout.items():
            kept = torch.ones_like(vectors)
            kept[:, self.config.columns[name]] = (torch.rand(len(vectors), 1, device=vectors.device) >= share).float()
            vectors = vectors * kept
        return vectors

    @property
    def hash(self) -> str:
        """Hash of the weights, the same as :func:`~ftl_lightning.tensor_file.file_hash` of the saved file."""
        return bytes_hash(serialise(KIND, self._stored(), {"domain": self.config.domain}))

    def _stored(self) -> dict[str, Tensor]:
        """What the file holds: weights in half precision, everything else as it is."""
        weights = dict(self.named_parameters())
        return {name: value.half() if name in weights else value for name, value in self.state_dict().items()}

    def save(self, folder: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``, each whole or not at all; weights in half precision.

        Where there are examples, they are written too.

        Raises:
            UserError: before anything is written, for weights that are not finite or too large for half precision.
        """
        folder, stored = Path(folder), self._stored()
        expect_finite(stored, str(folder), "nothing was written; train it anew")
        header = {"format": VERSION, "hash": self.hash, "kind": self.kind}
        with alone(folder):  # of two that are written to the same folder, the files of one
            save_tensors(folder / WEIGHTS, KIND, stored, {"domain": self.config.domain})
            if self.examples is not None:
                self.examples.save(folder / EXAMPLES)
            write_text(folder / CONFIG, json.dumps(header | asdict(self.config), indent=2) + "\n")

    @classmethod
    def load(cls, folder: str | Path, domain: Domain | None = None) -> Self:
        """Read a folder written by :meth:`save`; the model is frozen and in evaluation mode.

        Args:
            folder: to read.
            domain: in place of the one that the folder names; ``None`` for that, if an installed package offers it or a person
                names it beside the folder.

        Raises:
            UserError: naming the file, if it is missing, damaged, or the two files do not belong together.
        """
        path = Path(folder) / CONFIG
        content = read_config(folder)
        with about(path):
            if (found := content.pop("kind")) != cls.kind:
                raise UserError(f"key 'kind': expected {cls.kind!r}, found {found!r}, the model of another method")
            if domain is None and content["domain"] != OWN:
                domain = domain_of_file(content["domain"])
            if domain is not None:
                upgrade(content, domain)
            del content["format"]
            expected_hash = content.pop("hash")
            config = built(cls.Config, content, "")
        weights = Path(folder) / WEIGHTS
        tensors, _ = load_tensors(weights, KIND)
        if (found := file_hash(weights)) != expected_hash:
            raise UserError(
                f"{weights}: expected the hash {short(expected_hash)} that {CONFIG} names, found {found}; copy both files again"
            )
        examples = Demonstrations.load(Path(folder) / EXAMPLES) if config.domain == OWN else None
        with about(path):
            if examples is not None:
                domain = own_domain(examples, config.training_concepts, config.horizon, config.metrics)
            assert domain is not None
            expect_domain(config, domain)
            # First on paper: a file of a few bytes can name sizes that no memory holds.
            with torch.device("meta"), at_most(sum(value.numel() for value in tensors.values())):
                expected = cls._blank(config, domain).state_dict()
        with about(weights):
            expect_weights(tensors, expected)
        model = cls._blank(config, domain)
        model.examples = examples
        model.load_state_dict(tensors)
        return model.requires_grad_(False).eval()

    @classmethod
    def _blank(cls, config: ModelConfig, domain: Domain) -> Self:
        """A fresh model, whose buffers are zeros."""
        blank, initial = torch.zeros(config.state_dim), torch.zeros(config.measured_dim)
        return cls(
            config,
            domain,
            Normalization(blank, blank),
            torch.zeros(1 + len(config.training_concepts), config.concept_dim),
            Normalization(initial, initial) if config.measured_dim else None,
        )


def joined_vectors(observed: Observed, features: Mapping[str, Feature]) -> Tensor:
    """The vectors among observed features, one after another ``(batch, m)``."""
    vectors = [observed[name].flatten(1) for name, feature in features.items() if feature.kind == "vector"]
    return torch.cat(vectors, dim=1)


class TextConceptModel(ConceptModel):
    """A model whose concept space is the text encoder's.

    Embeddings are centred on the training concepts and scaled to unit mean square: language models put a large common part into
    all of them, which hides what tells two concepts apart.

    Args:
        config, domain, normalization, initial_normalization: see :class:`ConceptModel`.
        embeddings: the encoder's ``(1 + training concepts, n)``, the empty text first.
    """

    centre: Tensor
    spread: Tensor

    def __init__(
        self,
        config: ModelConfig,
        domain: Domain,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        centre = embeddings[1:].mean(dim=0)
        spread = (embeddings[1:] - centre).square().mean().sqrt()
        spread = torch.where(spread > 0, spread, 1)  # of a single training concept
        super().__init__(config, domain, normalization, (embeddings - centre) / spread, initial_normalization)
        self.register_buffer("centre", centre)
        self.register_buffer("spread", spread)

    def standardise(self, embeddings: Tensor) -> Tensor:
        """The encoder's embeddings ``(..., n)`` to the model's concept space."""
        return (embeddings - self.centre) / self.spread
