"""Inputs of denoisers: the domain's sizes, the timestep embedding, and condition encoders of observed features.

Each condition encoder has two halves: ``observe`` reads the features once per plan, ``attend`` adds the concept at every denoising
step.
"""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.features import Feature
from ftl_lightning.networks.image_encoder import POINT
from ftl_lightning.services.errors import require, shown

Context = tuple[Tensor, ...]
"""Output of a condition encoder, each ``(batch, ...)``; empty without observed features."""
CHOSEN = 4
"""Number of image points that a concept chooses."""
SHARPNESS = 4.0
"""Softmax inverse temperature of a choice: high, since the mean of several points is the position of none of them."""
SMALLEST = 0.02
"""Vector length below which the direction feature shrinks towards 0."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of a domain, the first argument of every denoiser.

    Attributes:
        horizon: number of states in a plan.
        state_dim: columns of a state.
        concept_dim: columns of a concept embedding.
        observed: features that condition the denoiser, by name; may be empty.
        image_dim: number of features of the observed images, which follow the observed vectors.
        plane: columns of a state with x and y in the coordinates of image points.
    """

    horizon: int
    state_dim: int
    concept_dim: int
    observed: Mapping[str, Feature] = field(default_factory=dict)
    image_dim: int = 0
    plane: tuple[int, ...] = ()

    @property
    def columns(self) -> dict[str, slice]:
        """Input columns of each observed vector, by name."""
        vectors = {name: feature.size for name, feature in self.observed.items() if feature.kind == "vector"}
        starts = itertools.accumulate(vectors.values(), initial=0)
        return {name: slice(start, start + size) for (name, size), start in zip(vectors.items(), starts, strict=False)}

    @property
    def measured_dim(self) -> int:
        """Number of columns of the concatenated observed vectors."""
        return max((columns.stop for columns in self.columns.values()), default=0)

    @property
    def vector_dim(self) -> int:
        """Number of input columns: observed vectors and image features."""
        return self.measured_dim + self.image_dim

    @property
    def entities(self) -> tuple[tuple[int, ...], ...]:
        """Input columns of each exchangeable entity."""
        placed = [(columns.start, self.observed[name]) for name, columns in self.columns.items()]
        return tuple(tuple(start + column for column in entity) for start, feature in placed for entity in feature.entities)

    @property
    def attributes(self) -> tuple[int, ...]:
        """Attribute columns of an entity, relative to its first, to which concepts refer; empty for all."""
        return next((self.observed[name].attributes for name in self.columns if self.observed[name].attributes), ())

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Columns of the observed vectors with the plan's initial state; may be empty."""
        return tuple(columns.start + column for name, columns in self.columns.items() for column in self.observed[name].state)


def sinusoidal_embedding(t: Tensor, dimension: int, period: float = 10_000.0) -> Tensor:
    """Sinusoidal features ``(batch, dimension)`` of timestep ``t (batch,)`` (Vaswani et al., 2017); ``dimension`` is even."""
    half = dimension // 2
    frequency = torch.exp(torch.arange(half, device=t.device) * (-math.log(period) / (half - 1)))
    angle = t[:, None] * frequency
    return torch.cat((angle.sin(), angle.cos()), dim=-1)


class ConditionEncoder(nn.Module, ABC):
    """Base class of condition encoders, constructed with the domain's :class:`Sizes` and the number of output features."""

    @abstractmethod
    def observe(self, vector: Tensor) -> Context:
        """Encode the concatenated, normalised observed vectors ``(batch, m)`` independently of the concept."""

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        """Features ``(batch, width)`` of a context for ``concept (batch, n)``; by default the first value of ``observe``."""
        return context[0]

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        """Unit vector ``(batch, 2)`` of the plan's x axis; ``None`` for unrotated plans."""
        return None


def _mlp(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 4 * width), nn.Mish(), nn.Linear(4 * width, width))


class FlatEncoder(ConditionEncoder):
    """MLP of all vectors, as in the paper, independent of the concept."""

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        self.net = _mlp(sizes.vector_dim, width)

    def observe(self, vector: Tensor) -> Context:
        return (self.net(vector),)


class JointEncoder(ConditionEncoder):
    """MLP of all vectors and the concept. The paper does not specify where they are combined."""

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        self.net = _mlp(sizes.vector_dim + sizes.concept_dim, width)

    def observe(self, vector: Tensor) -> Context:
        return (vector,)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        features: Tensor = self.net(torch.cat((context[0], concept), dim=-1))
        return features


class _Entities(ConditionEncoder):
    """Base class of encoders of exchangeable entities. Shared columns are appended to every entity and to the features."""

    columns: Tensor  # columns of each entity (entity, column)
    shared: Tensor  # columns that belong to no entity
    entity: nn.Sequential

    def __init__(self, name: str, sizes: Sizes) -> None:
        super().__init__()
        reason = f"{name}: this domain does not name its entities"
        require(sizes.entities, "denoiser_args.initial_encoder", "flat", reason)
        used = {column for entity in sizes.entities for column in entity}
        # One-hot entity types would break the symmetry, but they are constant, and constant columns are normalised to 0.
        shared = [column for column in range(sizes.vector_dim) if column not in used]
        self.register_buffer("columns", torch.tensor(sizes.entities), persistent=False)
        self.register_buffer("shared", torch.tensor(shared, dtype=torch.int64), persistent=False)

    def _build(self, inputs: int, inner: int) -> None:
        inputs += len(self.shared)
        self.entity = nn.Sequential(nn.Linear(inputs, inner), nn.Mish(), nn.Linear(inner, inner), nn.Mish())

    def _hidden(self, each: Tensor, shared: Tensor) -> Tensor:
        """Features ``(batch, entity, inner)`` of entities ``(batch, entity, column)`` and the other columns ``(batch, column)``."""
        hidden: Tensor = self.entity(torch.cat((each, shared[:, None].expand(-1, each.shape[1], -1)), dim=-1))
        return hidden


class EntityEncoder(_Entities):
    """Attention over entities, with the concept as query, attributes as keys and the other columns as values.

    The attention logit of an entity is linear in its attributes, so the queries of *red* and *bowl* add up to that of an unseen red
    bowl. Values exclude the attributes, so a red bowl is approached like any other object. Without named attributes all columns are
    keys and values. Attention has a single head: several heads can disagree about the target, and concepts learned through them get
    stuck. The encoder is invariant to permutations of the entities.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__("entities", sizes)
        self.attributes = list(sizes.attributes or range(self.columns.shape[1]))
        self.rest = [column for column in range(self.columns.shape[1]) if column not in sizes.attributes]
        inner = 2 * width
        self._build(len(self.rest), inner)
        # Saturated attention to a wrong entity has hardly any gradient. Weights start small, and the concept is scaled to norm 1,
        # so that a step of Adam changes the query a little; at the original norm of 20 it would reverse the query.
        self.query = nn.Linear(sizes.concept_dim, len(self.attributes))
        if not self.query.weight.is_meta:  # on the meta device torch would import its compiler
            nn.init.normal_(self.query.weight, std=0.2)
        self.value = nn.Linear(inner + len(self.rest), inner)
        self.out = nn.Sequential(nn.Linear(inner + len(self.shared), inner), nn.Mish(), nn.Linear(inner, width))
        # Linear path for the position of the attended entity, where a plan ends.
        self.direct = nn.Linear(inner + len(self.shared), width)

    def observe(self, vector: Tensor) -> Context:
        """Keys (attributes) and values of the entities, and the shared columns."""
        shared, each = vector[:, self.shared], vector[:, self.columns]
        rest = each[..., self.rest]
        return each[..., self.attributes], self.value(torch.cat((self._hidden(rest, shared), rest), dim=-1)), shared

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        attributes, value, shared = context
        query = self.query(concept / concept.shape[-1] ** 0.5)[:, None]
        attended = functional.scaled_dot_product_attention(query, attributes, value, scale=1.0)[:, 0]
        both = torch.cat((attended, shared), dim=-1)
        features: Tensor = self.out(both) + self.direct(both)
        return features


class SetEncoder(_Entities):
    """Max and mean pooling over the features of entities (deep sets, Zaheer et al., 2017), independent of the concept."""

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__("set", sizes)
        inner = 2 * width
        self._build(self.columns.shape[1], inner)
        self.out = nn.Sequential(nn.Linear(2 * inner + len(self.shared), inner), nn.Mish(), nn.Linear(inner, width))

    def observe(self, vector: Tensor) -> Context:
        shared = vector[:, self.shared]
        hidden = self._hidden(vector[:, self.columns], shared)
        return (self.out(torch.cat((hidden.amax(dim=1), hidden.mean(dim=1), shared), dim=-1)),)


class PointEncoder(ConditionEncoder):
    """Attention over image points, with the concept as query and point indices as keys.

    Each of :data:`CHOSEN` choices is a weighted mean of the visible points. The weights depend only on the concept, so different
    concepts apply the same plan to different objects. Features are the coordinates of all points, and for each chosen point and
    each difference of two: the vector, its direction, and the logarithm of its length, which resolves small and large distances. If
    plans have a plane, all vectors and the plan are rotated into the direction from the first chosen point to the second, which
    makes the encoder equivariant to rotation.

    Raises:
        UserError: for an image encoder without points.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        has_points = sizes.image_dim > 0 and sizes.image_dim % POINT == 0
        require(has_points, "denoiser_args.initial_encoder", "flat", "points: the image encoder has no head of points")
        self.count, self.turns = sizes.image_dim // POINT, bool(sizes.plane)
        self.choice = nn.Linear(sizes.concept_dim, CHOSEN * self.count)
        with torch.no_grad():  # every choice starts with a different preferred point
            # Explicit CPU: arithmetic on the meta device makes torch import its compiler.
            favourites = functional.one_hot(torch.arange(CHOSEN, device="cpu") % self.count, self.count)
            self.choice.bias.copy_(favourites.flatten())
        vectors = CHOSEN * (CHOSEN + 1) // 2
        inputs = sizes.measured_dim + 5 * vectors + 2 * CHOSEN + POINT * self.count
        self.net = _mlp(inputs, width)

    def observe(self, vector: Tensor) -> Context:
        """Measured vectors, and x, y, height and visibility of each point ``(batch, point, 4)``."""
        measured, points = vector.split((vector.shape[1] - POINT * self.count, POINT * self.count), dim=1)
        points = points.unflatten(1, (POINT, self.count)).transpose(1, 2)
        return measured, torch.cat((points[..., :3], points[..., 3:].sigmoid()), dim=-1)

    def _chosen(self, points: Tensor, concept: Tensor) -> Tensor:
        """x, y, height and visibility of each choice ``(batch, choice, 4)``."""
        logits = SHARPNESS * self.choice(concept / concept.shape[-1] ** 0.5)
        weights = logits.unflatten(1, (CHOSEN, self.count)).softmax(dim=-1) * points[:, None, :, 3]
        visibility = weights.sum(dim=-1, keepdim=True)
        return torch.cat((weights @ points[..., :3] / (visibility + 1e-3), visibility), dim=-1)

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        if not self.turns:
            return None
        # No gradient to the points: it is large for two close points.
        first, second = self._chosen(context[1].detach(), concept)[:, :2, :2].unbind(dim=1)
        return functional.normalize(second - first + 1e-6, dim=-1)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        measured, points = context
        chosen = self._chosen(points, concept)
        places, visibility = chosen[..., :2], points[..., 3:]
        first, second = torch.triu_indices(CHOSEN, CHOSEN, 1, device=places.device)
        vectors = torch.cat((places, places[:, second] - places[:, first], visibility * points[..., :2]), dim=1)
        if (direction := self.direction(context, concept)) is not None:
            vectors = turned(vectors, direction, (0, 1), back=False)
        near, plain = vectors[:, : -self.count], vectors[:, -self.count :]
        length = (near.square().sum(dim=-1, keepdim=True) + SMALLEST**2).sqrt()
        of_chosen = measured, near.flatten(1), (near / length).flatten(1), (length / SMALLEST).log()[..., 0] / 3
        heights = 10 * chosen[..., 2], chosen[..., 3], 10 * (visibility * points[..., 2:3])[..., 0], visibility[..., 0]
        parts = (*of_chosen, *heights, plain.flatten(1))
        features: Tensor = self.net(torch.cat(parts, dim=1))
        return features


def turned(values: Tensor, direction: Tensor, plane: Sequence[int], back: bool) -> Tensor:
    """Rotate vectors ``(batch, ..., column)`` into the frame whose x axis is ``direction (batch, 2)``, of unit length, or back.

    The columns of x and y are ``plane``.
    """
    x, y = (values[..., column] for column in plane)
    cos, sin = (part.reshape(-1, *(1,) * (x.dim() - 1)) for part in direction.unbind(dim=1))
    sin = -sin if back else sin
    columns = list(values.unbind(dim=-1))
    columns[plane[0]], columns[plane[1]] = cos * x + sin * y, cos * y - sin * x
    return torch.stack(columns, dim=-1)


ENCODERS: dict[str, Callable[[Sizes, int], ConditionEncoder]] = {
    "flat": FlatEncoder,
    "joint": JointEncoder,
    "entities": EntityEncoder,
    "set": SetEncoder,
    "points": PointEncoder,
}


def condition_encoder(name: str, sizes: Sizes, width: int) -> ConditionEncoder | None:
    """Build an encoder by its configuration name; ``None`` without observed vectors.

    Raises:
        UserError: for an unknown name, or an encoder of entities in a domain without entities.
    """
    require(name in ENCODERS, "denoiser_args.initial_encoder", f"one of {', '.join(ENCODERS)}", shown(name))
    return ENCODERS[name](sizes, width) if sizes.vector_dim else None
