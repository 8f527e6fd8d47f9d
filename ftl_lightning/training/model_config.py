"""Configuration of a pretrained model, its ``config.json``, and the inputs for building its network."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.domain import OWN, Domain, View
from ftl_lightning.networks.conditions import Sizes
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.shipped import MODEL_FILES, missing_model
from ftl_lightning.services.validation import LARGEST, check_range, check_type, read_json

CONFIG = MODEL_FILES[-1]
"""File name in a model's folder."""
VERSION = 2
"""Version of the configuration's format."""
LONGEST = 10_000
"""Maximum number of states in a plan; networks over time have the same weights for any horizon."""


MOST_CONCEPTS = 20_000
"""Maximum number of training concepts of a model."""


@dataclass(frozen=True, kw_only=True)
class ModelConfig(Sizes):
    """Configuration to build a model before its weights are read; each method adds options of its network.

    Attributes:
        domain: name of the domain.
        training_concepts: texts, in the order of the model's training embeddings.
        encoder: identity of the text encoder.
        view: name of the domain's view; empty for none.
        perturb: whether training perturbs the present state, see :class:`~ftl_lightning.domains.domain.View`.
        image_encoder: arguments of the image encoders, see :class:`~ftl_lightning.networks.image_encoder.ImageEncoder`.
        feature_dropout: dropout probability of observed vectors by name (0 after normalisation) in training.
        places: columns of the state in the same frame as observed features that plans follow, by feature, in a user's data; see
            :func:`~ftl_lightning.data.places.places`. The network does not observe places: from a few demonstrations, what depends
            on a place is learned much worse by a network than by a linear regression.
        metrics: metrics of plans for a user's data, see :mod:`ftl_lightning.domains.from_file`.
        training: training options, for the record.

    Raises:
        UserError: at construction, for a size out of its range.
    """

    domain: str
    training_concepts: tuple[str, ...]
    encoder: str
    view: str = ""
    perturb: bool = False
    image_encoder: Mapping[str, Any] = field(default_factory=dict)
    feature_dropout: Mapping[str, float] = field(default_factory=dict)
    places: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_range("horizon", self.horizon, 1, LONGEST)
        check_range("state_dim", self.state_dim, 1, LARGEST)
        check_range("concept_dim", self.concept_dim, 1, LARGEST)
        check_range("key 'training_concepts': number", len(self.training_concepts), 0, MOST_CONCEPTS)
        check_range("observed, image_dim", self.vector_dim, 0, LARGEST)


def find_view(domain: Domain, name: str) -> View | None:
    """A domain's view by name; ``None`` for the empty name; ``UserError`` for an unknown name."""
    if not name:
        return None
    if name not in domain.plans.views:
        raise UserError(f"model.view: expected one of {', '.join(map(repr, ('', *domain.plans.views)))}, found {short(name)!r}")
    return domain.plans.views[name]


def width_of(domain: Domain, view: View | None) -> int:
    """Number of columns that a model generates."""
    return len(view.columns if view is not None and view.columns else domain.plans.columns)


def read_config(folder: str | Path) -> dict[str, Any]:
    """Read the configuration of a pretrained model, with its ``format``, ``hash`` and ``kind``, as plain data.

    Raises:
        UserError: with the file, if it is missing or invalid.
    """
    path = Path(folder) / CONFIG
    if not path.exists():
        raise UserError(missing_model(folder))
    content = read_json(path)
    with about(path):
        if not isinstance(content, dict) or content.get("format") != VERSION:
            raise UserError(f"expected the configuration of a pretrained model, found something else (its format is not {VERSION})")
        for key in ("kind", "hash", "domain"):
            check_type(content.get(key), str, key)
        return content


def check_domain(config: ModelConfig, domain: Domain) -> None:
    """Refuse sizes that differ from the domain's; ``UserError`` with the key."""
    if config.metrics and config.domain != OWN:
        raise UserError(f"key 'metrics': expected none, as domain {domain.name} has its own, found {shown(dict(config.metrics))}")
    view = find_view(domain, config.view)
    if config.state_dim != (columns := width_of(domain, view)):
        raise UserError(f"key 'state_dim': expected {columns} (domain {domain.name}), found {config.state_dim}")
    expected = domain.observed if view is None else view.features
    for name, feature in config.observed.items():
        if name not in expected or not feature.fits(expected[name]):
            wanted = expected[name].words if name in expected else f"one of {', '.join(expected) or 'no features'}"
            raise UserError(f"key 'observed.{short(name)}': expected {wanted}, found {short(feature.words)}")


C = TypeVar("C", bound=ModelConfig, covariant=True)
K = TypeVar("K", bound=ModelConfig)


@dataclass(frozen=True)
class Prepared(Generic[C]):
    """Inputs for building a network.

    Attributes:
        config: configuration.
        domain: domain of the model.
        normalization: normalisation of states.
        embeddings: concept embeddings ``(1 + training concepts, n)``, the empty concept first.
        observed: normalisation of the observed vectors; ``None`` without any.
        frames: frames of the training concepts ``(training concept, place, horizon)``; ``None`` without places.
    """

    config: C
    domain: Domain
    normalization: Normalization
    embeddings: Tensor
    observed: Normalization | None = None
    frames: Tensor | None = None

    def configured(self, kind: type[K], **options: Any) -> "Prepared[K]":
        """Copy with the configuration of a method's network."""
        known = {field.name: getattr(self.config, field.name) for field in fields(self.config)}
        parts = (self.domain, self.normalization, self.embeddings, self.observed, self.frames)
        return Prepared(kind(**known | options), *parts)

    def embedded(self, embeddings: Tensor) -> "Prepared[C]":
        """Copy with other embeddings ``(1 + training concepts, n)``."""
        return replace(self, embeddings=embeddings)


def blank(config: K, domain: Domain) -> Prepared[K]:
    """Zeros, for a network whose weights and buffers are read afterwards."""
    states, vectors = torch.zeros(config.state_dim), torch.zeros(config.measured_dim)
    return Prepared(
        config,
        domain,
        Normalization(states, states),
        torch.zeros(1 + len(config.training_concepts), config.concept_dim),
        Normalization(vectors, vectors) if config.measured_dim else None,
        torch.zeros(len(config.training_concepts), len(config.places), config.horizon) if config.places else None,
    )
