"""Condition encoders of observed features.

Each encoder has two halves: ``observe`` reads the features once per plan, ``attend`` adds the concept at every denoising step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.igm.diffusion import Context
from ftl_lightning.networks.denoiser import Sizes
from ftl_lightning.networks.image_encoder import POINT
from ftl_lightning.services.errors import UserError


class ConditionEncoder(nn.Module, ABC):
    """Base class of condition encoders."""

    @abstractmethod
    def observe(self, vector: Tensor) -> Context:
        """Encode the concatenated, normalised observed vectors ``(batch, m)`` independently of the concept."""

    @abstractmethod
    def attend(self, context: Context, concept: Tensor) -> Tensor:
        """Features ``(batch, width)`` of a context for ``concept (batch, n)``."""

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        """Unit vector ``(batch, 2)`` of the plan's x axis; ``None`` for unrotated plans."""
        return None


class FlatEncoder(ConditionEncoder):
    """MLP of all vectors, as in the paper, independent of the concept.

    Args:
        sizes: size of the observed vectors.
        width: number of features.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(sizes.vector_dim, 4 * width), nn.Mish(), nn.Linear(4 * width, width))

    def observe(self, vector: Tensor) -> Context:
        return (self.net(vector),)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        return context[0]


class JointEncoder(ConditionEncoder):
    """MLP of all vectors and the concept. The paper does not specify where they are combined.

    Args:
        sizes: sizes of the observed vectors and the concept.
        width: number of features.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        inputs = sizes.vector_dim + sizes.concept_dim
        self.net = nn.Sequential(nn.Linear(inputs, 4 * width), nn.Mish(), nn.Linear(4 * width, width))

    def observe(self, vector: Tensor) -> Context:
        return (vector,)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        features: Tensor = self.net(torch.cat((context[0], concept), dim=-1))
        return features


def _entity_columns(name: str, sizes: Sizes) -> tuple[Tensor, Tensor]:
    """Columns of each entity ``(entity, columns)`` and the columns of no entity."""
    if not sizes.entities:
        raise UserError(f"denoiser_args.initial_encoder: expected flat, found {name}: this domain does not name its entities")
    columns = torch.tensor(sizes.entities)
    used = {column for entity in sizes.entities for column in entity}
    # One-hot entity types would break the symmetry, but they are constant, and constant columns are normalised to 0.
    shared = [column for column in range(sizes.vector_dim) if column not in used]
    return columns, torch.tensor(shared, dtype=torch.int64)


class EntityEncoder(ConditionEncoder):
    """Attention over entities: the concept attends to their attributes, not to their positions.

    The concept determines a weight for each attribute column, and the weighted sum is the attention logit of an entity: the weights
    for red and for bowl add up to an unseen red bowl. There is a single head: several heads can disagree about the target, which
    traps concepts learned through them. The values exclude the attributes, so a red bowl is reached like any other. The encoder is
    invariant to exchanging entities. Columns of no entity are appended to every entity and to the features.

    Args:
        sizes: sizes of the observed vectors and their entities. Attribute columns are keys only; without named attributes all
            columns are keys and values.
        width: number of features.
    """

    columns: Tensor
    shared: Tensor

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        columns, shared = _entity_columns("entities", sizes)
        self.attributes = list(sizes.attributes or range(columns.shape[1]))
        self.rest = [column for column in range(columns.shape[1]) if column not in sizes.attributes]
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("shared", shared, persistent=False)
        inner = 2 * width
        self.entity = nn.Sequential(nn.Linear(len(self.rest) + len(shared), inner), nn.Mish(), nn.Linear(inner, inner), nn.Mish())
        # Saturated attention on the wrong entity gets stuck: start with small weights and scale the concept to norm 1, so that a
        # step of Adam changes the query a little (at the original norm of 20 it would flip the query).
        self.query = nn.Linear(sizes.concept_dim, len(self.attributes))
        if not self.query.weight.is_meta:  # on the meta device torch would import its compiler
            nn.init.normal_(self.query.weight, std=0.2)
        self.value = nn.Linear(inner + len(self.rest), inner)
        self.out = nn.Sequential(nn.Linear(inner + len(shared), inner), nn.Mish(), nn.Linear(inner, width))
        # Linear path for the position of the attended entity, where a plan ends.
        self.direct = nn.Linear(inner + len(shared), width)

    def observe(self, vector: Tensor) -> Context:
        """Keys (attributes) and values of the entities, and the columns of no entity."""
        shared = vector[:, self.shared]
        each = vector[:, self.columns]  # (batch, entity, columns)
        rest = each[..., self.rest]
        hidden = self.entity(torch.cat((rest, shared[:, None].expand(-1, each.shape[1], -1)), dim=-1))
        return each[..., self.attributes], self.value(torch.cat((hidden, rest), dim=-1)), shared

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        attributes, value, shared = context
        query = self.query(concept / concept.shape[-1] ** 0.5)[:, None]
        attended = functional.scaled_dot_product_attention(query, attributes, value, scale=1.0)[:, 0]
        both = torch.cat((attended, shared), dim=-1)
        features: Tensor = self.out(both) + self.direct(both)
        return features


class SetEncoder(ConditionEncoder):
    """Max and mean pooling over the features of entities (deep sets, Zaheer et al., 2017), independent of the concept.

    Columns of no entity are appended to every entity and to the features.

    Args:
        sizes: sizes of the observed vectors and their entities.
        width: number of features.
    """

    columns: Tensor
    shared: Tensor

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        columns, shared = _entity_columns("set", sizes)
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("shared", shared, persistent=False)
        inner = 2 * width
        self.entity = nn.Sequential(nn.Linear(columns.shape[1] + len(shared), inner), nn.Mish(), nn.Linear(inner, inner), nn.Mish())
        self.out = nn.Sequential(nn.Linear(2 * inner + len(shared), inner), nn.Mish(), nn.Linear(inner, width))

    def observe(self, vector: Tensor) -> Context:
        shared = vector[:, self.shared]
        each = vector[:, self.columns]  # (batch, entity, columns)
        hidden = self.entity(torch.cat((each, shared[:, None].expand(-1, each.shape[1], -1)), dim=-1))
        return (self.out(torch.cat((hidden.amax(dim=1), hidden.mean(dim=1), shared), dim=-1)),)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        return context[0]


class PointEncoder(ConditionEncoder):
    """Attention over image points: the concept chooses points and reads their positions relative to each other and to the origin.

    Each of :data:`CHOSEN` choices is a mean of the visible points. Its weights depend on the concept alone (attention whose keys
    are the points' numbers), so the same plan may refer to different objects. The inputs for every chosen point, and for every
    difference between two, are the vector, its direction and the logarithm of its length, as near and far differ in scale. All
    points are additional inputs. If plans have a plane, all vectors and the plan are rotated into the direction from the first
    chosen point to the second: the encoder is equivariant to rotation.

    Args:
        sizes: sizes with the number of image features, which must be points.
        width: number of features.

    Raises:
        UserError: for an image encoder without points.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        if not sizes.image_dim or sizes.image_dim % POINT:
            raise UserError("denoiser_args.initial_encoder: expected flat, found points: no points are read of images")
        self.count, self.turns = sizes.image_dim // POINT, bool(sizes.plane)
        self.choice = nn.Linear(sizes.concept_dim, CHOSEN * self.count)
        with torch.no_grad():  # every choice starts with a different preferred point
            # Explicit CPU: arithmetic on the meta device makes torch import its compiler.
            favourites = functional.one_hot(torch.arange(CHOSEN, device="cpu") % self.count, self.count)
            self.choice.bias.copy_(favourites.flatten())
        vectors = CHOSEN * (CHOSEN + 1) // 2
        inputs = sizes.measured_dim + 5 * vectors + 2 * CHOSEN + POINT * self.count
        self.net = nn.Sequential(nn.Linear(inputs, 4 * width), nn.Mish(), nn.Linear(4 * width, width))

    def observe(self, vector: Tensor) -> Context:
        """Measured vectors, and x, y, height and visibility of each point ``(batch, point, 4)``."""
        measured, points = vector.split((vector.shape[1] - POINT * self.count, POINT * self.count), dim=1)
        points = points.unflatten(1, (POINT, self.count)).transpose(1, 2)
        return measured, torch.cat((points[..., :3], points[..., 3:].sigmoid()), dim=-1)

    def _chosen(self, points: Tensor, concept: Tensor) -> Tensor:
        """x, y, height and visibility of each choice ``(batch, choice, 4)``."""
        logits = SHARPNESS * self.choice(concept / concept.shape[-1] ** 0.5)
        weights = logits.unflatten(1, (CHOSEN, self.count)).softmax(dim=-1) * points[:, None, :, 3]
        seen = weights.sum(dim=-1, keepdim=True)
        return torch.cat((weights @ points[..., :3] / (seen + 1e-3), seen), dim=-1)

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        if not self.turns:
            return None
        # No gradient to the points: it is large for two close points.
        first, second = self._chosen(context[1].detach(), concept)[:, :2, :2].unbind(dim=1)
        return functional.normalize(second - first + 1e-6, dim=-1)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        measured, points = context
        chosen = self._chosen(points, concept)
        places, seen = chosen[..., :2], points[..., 3:]
        first, second = torch.triu_indices(CHOSEN, CHOSEN, 1, device=places.device)
        vectors = torch.cat((places, places[:, second] - places[:, first], seen * points[..., :2]), dim=1)
        if (direction := self.direction(context, concept)) is not None:
            vectors = turned(vectors, direction, (0, 1), back=False)
        near, plain = vectors[:, : -self.count], vectors[:, -self.count :]
        length = (near.square().sum(dim=-1, keepdim=True) + SMALLEST**2).sqrt()
        rest = (10 * chosen[..., 2], chosen[..., 3], 10 * (seen * points[..., 2:3])[..., 0], seen[..., 0], plain.flatten(1))
        parts = (measured, near.flatten(1), (near / length).flatten(1), (length / SMALLEST).log()[..., 0] / 3, *rest)
        features: Tensor = self.net(torch.cat(parts, dim=1))
        return features


CHOSEN = 4
"""Number of points that a concept chooses."""
SHARPNESS = 4.0
"""Inverse temperature of a choice: the mean of several points is at none of them."""
SMALLEST = 0.02
"""Length of a vector below which its direction is scaled down."""


def turned(values: Tensor, direction: Tensor, plane: Sequence[int], back: bool) -> Tensor:
    """Rotate vectors into the frame whose x axis is a direction, or back.

    Args:
        values: ``(batch, ..., column)``.
        direction: unit vectors ``(batch, 2)``.
        plane: columns of x and y.
        back: apply the inverse rotation.
    """
    x, y = (values[..., column] for column in plane)
    cos, sin = (part.reshape(-1, *(1,) * (x.dim() - 1)) for part in direction.unbind(dim=1))
    if back:
        sin = -sin
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
    if name not in ENCODERS:
        raise UserError(f"denoiser_args.initial_encoder: expected one of {', '.join(ENCODERS)}, found {name!r}")
    return ENCODERS[name](sizes, width) if sizes.vector_dim else None
