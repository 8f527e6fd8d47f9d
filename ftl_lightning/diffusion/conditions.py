"""Condition encoders: what a denoiser reads from observed features.

Each has two halves: ``observe`` reads the features once a plan, ``attend`` brings in the concept at every step of denoising. The
paper's encoder takes vectors as one, and so does another that sees the concept, too; two treat exchangeable entities alike.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.concepts.branches import Context
from ftl_lightning.diffusion.denoiser import Sizes
from ftl_lightning.diffusion.image_encoder import POINT
from ftl_lightning.errors import UserError


class ConditionEncoder(nn.Module, ABC):
    """What every condition encoder offers."""

    @abstractmethod
    def observe(self, vector: Tensor) -> Context:
        """What is read of the observed vectors ``(batch, m)``, one after another and normalised, whatever the concept."""

    @abstractmethod
    def attend(self, context: Context, concept: Tensor) -> Tensor:
        """Features ``(batch, width)`` of that for ``concept (batch, n)``."""

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        """A unit vector ``(batch, 2)``, from which directions in a plan are told; ``None`` where they are told as they are."""
        return None


class FlatEncoder(ConditionEncoder):
    """All vectors through one network, as in the paper; it does not see the concept.

    Args:
        sizes: of which the observed vectors' is used.
        width: of the features.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(sizes.vector_dim, 4 * width), nn.Mish(), nn.Linear(4 * width, width))

    def observe(self, vector: Tensor) -> Context:
        return (self.net(vector),)

    def attend(self, context: Context, concept: Tensor) -> Tensor:
        return context[0]


class JointEncoder(ConditionEncoder):
    """All vectors and the concept through one network. The paper does not say where the two meet.

    Args:
        sizes: of which the observed vectors' and the concept's are used.
        width: of the features.
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
    """Columns of each entity ``(entity, columns)`` and those that belong to none."""
    if not sizes.entities:
        raise UserError(f"denoiser_args.initial_encoder: expected flat, found {name}: this domain does not name its entities")
    columns = torch.tensor(sizes.entities)
    own = {column for entity in sizes.entities for column in entity}
    # Columns that say which entity is which (one-hot types) would tell alike entities apart; they are constant, and constant
    # columns are 0 after normalisation.
    shared = [column for column in range(sizes.vector_dim) if column not in own]
    return columns, torch.tensor(shared, dtype=torch.int64)


class EntityEncoder(ConditionEncoder):
    """Every entity through the same network; the concept attends to them by their attributes, not by their places.

    The concept is turned into a weight for each column of an entity's attributes, and their sum decides which entity is attended
    to: what makes red and what makes a bowl add up in a red bowl that was never seen. There is one head: several can disagree about
    where to go, which traps concepts that are learned through them. What is read from the attended entity is all but its
    attributes, so that a red bowl is reached like any other. Exchanging two entities changes nothing. What belongs to no entity
    goes to each of them, and into the features.

    Args:
        sizes: of the observed vectors and their entities, of whose columns those a concept asks for are not read; where none are
            named, all are asked for and all are read.
        width: of the features.
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
        # Attention that is sure of the wrong entity stays so: it starts unsure, and as the concept comes in with norm 1, a step of
        # Adam turns the query a little (with norm 20, as it is, it would flip it).
        self.query = nn.Linear(sizes.concept_dim, len(self.attributes))
        if not self.query.weight.is_meta:  # where there are sizes alone, torch would import its compiler to draw nothing
            nn.init.normal_(self.query.weight, std=0.2)
        self.value = nn.Linear(inner + len(self.rest), inner)
        self.out = nn.Sequential(nn.Linear(inner + len(shared), inner), nn.Mish(), nn.Linear(inner, width))
        # Where the attended entity is gets through without a bend: a plan ends there.
        self.direct = nn.Linear(inner + len(shared), width)

    def observe(self, vector: Tensor) -> Context:
        """What tells the entities apart, what is read from each, and what belongs to none."""
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
    """Every entity through the same network, of whose features the largest and the mean are read (deep sets, Zaheer et al., 2017).

    What belongs to no entity goes to each of them, and into the features. The concept is not seen.

    Args:
        sizes: of the observed vectors and their entities.
        width: of the features.
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
    """Points that were read of images: the concept chooses some, of which is read how they lie to each other and to the origin.

    Each of :data:`CHOSEN` choices is a mean of the points that are seen, weighed by the concept alone (attention whose keys are the
    points' names), so that another concept may mean another thing by the same plan. Of every chosen point, and of every difference
    between two, the network is given the vector, its direction and the logarithm of its length: what is near and what is far
    differ in scale. All points stand beside them as they are. Where plans have a plane, all vectors are told from the direction
    from the first chosen point to the second, and so is the plan: whatever is learned holds in every direction.

    Args:
        sizes: with the numbers that are read of images, which have to be points.
        width: of the features.

    Raises:
        UserError: for an encoder of images that does not read points.
    """

    def __init__(self, sizes: Sizes, width: int) -> None:
        super().__init__()
        if not sizes.image_dim or sizes.image_dim % POINT:
            raise UserError("denoiser_args.initial_encoder: expected flat, found points: no points are read of images")
        self.count, self.turns = sizes.image_dim // POINT, bool(sizes.plane)
        self.choice = nn.Linear(sizes.concept_dim, CHOSEN * self.count)
        with torch.no_grad():  # every choice starts with a favourite of its own
            # The device is said, wherever a network is being made: arithmetic on none (meta) makes torch import its compiler.
            favourites = functional.one_hot(torch.arange(CHOSEN, device="cpu") % self.count, self.count)
            self.choice.bias.copy_(favourites.flatten())
        vectors = CHOSEN * (CHOSEN + 1) // 2
        inputs = sizes.measured_dim + 5 * vectors + 2 * CHOSEN + POINT * self.count
        self.net = nn.Sequential(nn.Linear(inputs, 4 * width), nn.Mish(), nn.Linear(4 * width, width))

    def observe(self, vector: Tensor) -> Context:
        """What was measured, and x, y, height and probability of being seen of each point ``(batch, point, 4)``."""
        measured, points = vector.split((vector.shape[1] - POINT * self.count, POINT * self.count), dim=1)
        points = points.unflatten(1, (POINT, self.count)).transpose(1, 2)
        return measured, torch.cat((points[..., :3], points[..., 3:].sigmoid()), dim=-1)

    def _chosen(self, points: Tensor, concept: Tensor) -> Tensor:
        """x, y, height, and how much of what is asked for is seen ``(batch, choice, 4)``."""
        logits = SHARPNESS * self.choice(concept / concept.shape[-1] ** 0.5)
        weights = logits.unflatten(1, (CHOSEN, self.count)).softmax(dim=-1) * points[:, None, :, 3]
        seen = weights.sum(dim=-1, keepdim=True)
        return torch.cat((weights @ points[..., :3] / (seen + 1e-3), seen), dim=-1)

    def direction(self, context: Context, concept: Tensor) -> Tensor | None:
        if not self.turns:
            return None
        # The direction between points that are close to each other is steep in where they are: no gradient goes there.
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
"""Points that a concept chooses."""
SHARPNESS = 4.0
"""Factor of the numbers that decide a choice: a mean of several points is where none of them is."""
SMALLEST = 0.02
"""Length of a vector below which its direction counts less and less."""


def turned(values: Tensor, direction: Tensor, plane: Sequence[int], back: bool) -> Tensor:
    """Vectors told from a direction, or, back, told as they are.

    Args:
        values: ``(batch, ..., column)``.
        direction: unit vectors ``(batch, 2)``.
        plane: the two columns of x and y.
        back: whether they are told from the direction.
    """
    x, y = (values[..., column] for column in plane)
    cos, sin = (part.reshape(-1, *(1,) * (x.dim() - 1)) for part in direction.unbind(dim=1))
    if back:
        sin = -sin
    found = list(values.unbind(dim=-1))
    found[plane[0]], found[plane[1]] = cos * x + sin * y, cos * y - sin * x
    return torch.stack(found, dim=-1)


ENCODERS: dict[str, Callable[[Sizes, int], ConditionEncoder]] = {
    "flat": FlatEncoder,
    "joint": JointEncoder,
    "entities": EntityEncoder,
    "set": SetEncoder,
    "points": PointEncoder,
}


def condition_encoder(name: str, sizes: Sizes, width: int) -> ConditionEncoder | None:
    """An encoder by its name in a configuration; ``None`` where no vector is observed.

    Raises:
        UserError: for a name that is none, or one that needs entities in a domain without them.
    """
    if name not in ENCODERS:
        raise UserError(f"denoiser_args.initial_encoder: expected one of {', '.join(ENCODERS)}, found {name!r}")
    return ENCODERS[name](sizes, width) if sizes.vector_dim else None
