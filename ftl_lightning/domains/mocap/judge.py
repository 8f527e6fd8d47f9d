"""Judge: classifier of the action in a window of motion, trained by ``benchmarks/experiments/mocap_judge.py`` on recordings.

Ensembles of convolutional networks and linear classifiers judge the whole body, arms with trunk, and legs separately. An ensemble
picks the likeliest action, even if half of it is missing; verifiers of the whole body therefore reject hard negatives, such as an
action's arms on the legs of a walk. Training excludes generated motion and demonstrators of new concepts.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from ftl_lightning.domains.mocap.features import LOWER, UPPER, extremes, signals, summary, turns
from ftl_lightning.domains.mocap.skeleton import COLUMNS, FPS, HORIZON, as_joints
from ftl_lightning.domains.mocap.tasks import CLASSES, LEG_CLASSES, OTHER, STAND, actions, of_legs
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.shipped import shipped
from ftl_lightning.services.tensor_file import file_hash, load_tensors, save_tensors

KIND = "motion judge"
PATH = Path("pretrained/mocap/judge.safetensors")  # File of the shipped judge
WHOLE, ARMS, LEGS = "whole", "arms", "legs"
PARTS: Mapping[str, tuple[tuple[int, ...], tuple[str, ...]]] = {
    WHOLE: ((*LOWER, *UPPER), CLASSES),
    ARMS: (UPPER, CLASSES),
    LEGS: (LOWER, LEG_CLASSES),
}
"""Joints and classes of each part of the judge; the trunk belongs to the arms."""
NUMBERS = {"summary": summary, "extremes": extremes}  # Features of linear classifiers by name
VERIFIED_BY = {**NUMBERS, "turns": turns}  # Features of verifiers by name
VERIFIER = 32  # Hidden units of a verifier
WIDTH, EMBEDDING = 40, 32  # Channels and embedding size of a network
STILL = 0.3  # Speed in metres per second. If every joint is slower over a sixth of a second, there is no action.
RESTING = ("pose", STAND, OTHER)  # Classes of windows without movement
CONFIRMED = -3.0
"""Minimum mean verifier logit of a confirmed action: low, as new people differ from those trained on."""
VERIFIED = {"walk": CONFIRMED, "jump": CONFIRMED, "jumping jacks": CONFIRMED, "knee raise": CONFIRMED, "arm circle": 2.2}
"""Minimum mean logits of the verified actions; for others, verifiers reject too many new people. Circles need more: a third of a
large circle is hardly smaller than a small circle."""
_SIXTH = FPS // 6
_OUTLIER = 5.0  # Standard deviations at which features are clipped


class Network(nn.Module):
    """Convolutional network over the time series of :func:`~ftl_lightning.domains.mocap.features.signals`."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()

        def layer(inputs: int, size: int, stride: int, dropped: float) -> list[nn.Module]:
            convolution = nn.Conv1d(inputs, WIDTH, size, stride=stride, padding=size // 2)
            return [convolution, nn.GroupNorm(4, WIDTH), nn.SiLU(), nn.Dropout1d(dropped)]

        self.layers = nn.Sequential(*layer(channels, 5, 2, 0.1), *layer(WIDTH, 5, 2, 0.1), *layer(WIDTH, 3, 1, 0.0))
        self.embed = nn.Sequential(nn.Dropout(0.3), nn.Linear(2 * WIDTH, EMBEDDING), nn.ReLU())
        self.head = nn.Linear(EMBEDDING, classes)

    def embedding(self, courses: Tensor) -> Tensor:
        """Map ``(sample, channels, frame)`` to ``(sample, EMBEDDING)``, nonnegative."""
        inside = self.layers(courses)
        return self.embed(torch.cat([inside.mean(dim=-1), inside.amax(dim=-1)], dim=1))

    def forward(self, courses: Tensor) -> Tensor:
        """Logits ``(sample, class)``."""
        return self.head(self.embedding(courses))


class Verifier(nn.Sequential):
    """Perceptron on window features: logits ``(sample, class)`` that the window shows a whole action."""

    def __init__(self, numbers: int, classes: int) -> None:
        super().__init__(nn.Dropout(0.2), nn.Linear(numbers, VERIFIER), nn.ReLU(), nn.Dropout(0.3), nn.Linear(VERIFIER, classes))


class Recogniser(nn.Module):
    """Ensemble of networks (``members``) and linear classifiers with the same visible ``joints`` and ``classes``.

    ``verifiers`` perceptrons confirm whole actions; with 0, all are confirmed.
    """

    def __init__(self, joints: Sequence[int], classes: Sequence[str], members: int = 2, verifiers: int = 0) -> None:
        super().__init__()
        self.joints, self.classes = tuple(joints), tuple(classes)
        still = torch.zeros(1, HORIZON, len(COLUMNS))
        channels = signals(still, joints).shape[1]
        numbers = {name: of(still, joints).shape[1] for name, of in (VERIFIED_BY if verifiers else NUMBERS).items()}
        self.networks = nn.ModuleList(Network(channels, len(classes)) for _ in range(members))
        self.verifiers = nn.ModuleList(Verifier(sum(numbers.values()), len(classes)) for _ in range(verifiers))
        self.linear = nn.ModuleDict({name: nn.Linear(numbers[name], len(classes)) for name in NUMBERS})
        for name, size in {"signals": channels, "embedding": EMBEDDING, **numbers}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def set_scale(self, name: str, values: Tensor, floor: float) -> None:
        """Set mean and standard deviation from values ``(sample, size)`` or ``(sample, size, frame)``."""
        flat = values.transpose(1, -1).flatten(0, -2)
        getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))
        getattr(self, f"{name}_std").copy_(flat.std(dim=0).clamp_min(floor))

    def _scaled(self, name: str, values: Tensor) -> Tensor:
        mean, std = getattr(self, f"{name}_mean"), getattr(self, f"{name}_std")
        shape = (1, -1, *(1 for _ in values.shape[2:]))
        return ((values - mean.view(shape)) / std.view(shape)).clamp(-_OUTLIER, _OUTLIER)

    def courses(self, states: Tensor) -> Tensor:
        """Network inputs of windows ``(sample, 32, 42)``."""
        return self._scaled("signals", signals(states, self.joints))

    def numbers(self, states: Tensor) -> dict[str, Tensor]:
        """Scaled features of windows ``(sample, 32, 42)`` for linear classifiers, and for verifiers if there are any."""
        measures = VERIFIED_BY if len(self.verifiers) else NUMBERS
        return {name: self._scaled(name, of(states, self.joints)) for name, of in measures.items()}

    def features(self, states: Tensor) -> Tensor:
        """Embedding of the first network ``(sample, EMBEDDING)``, with about unit variance over the training windows."""
        return self._scaled("embedding", cast(Network, self.networks[0]).embedding(self.courses(states)))

    def votes(self, states: Tensor, numbers: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
        """Log probabilities ``(sample, class)`` of the networks, and of each linear classifier, with their features."""
        courses, numbers = self.courses(states), self.numbers(states) if numbers is None else numbers
        networks = torch.stack([network(courses).log_softmax(dim=-1) for network in self.networks]).mean(dim=0)
        linear = {name: layer(numbers[name]).log_softmax(dim=-1) for name, layer in self.linear.items()}
        return {"networks": networks, **linear}

    def forward(self, states: Tensor) -> Tensor:
        """Mean log probabilities ``(sample, class)``; -inf for actions without motion, or that verifiers reject."""
        numbers = self.numbers(states)
        scores = torch.stack(list(self.votes(states, numbers).values())).mean(dim=0)
        actions_only = torch.tensor([name not in RESTING for name in self.classes])
        excluded = self._still(states)[:, None]
        if len(self.verifiers):
            thresholds = torch.tensor([VERIFIED.get(name, -torch.inf) for name in self.classes])
            excluded = excluded | (self.verified(numbers) < thresholds)
        return scores.masked_fill(excluded & actions_only, -torch.inf)

    def verified(self, numbers: Mapping[str, Tensor]) -> Tensor:
        """Mean logits ``(sample, class)`` that a window shows a whole action; meaningful for :data:`VERIFIED` alone."""
        every = torch.cat(list(numbers.values()), dim=1)
        return torch.stack([verifier(every) for verifier in self.verifiers]).mean(dim=0)

    def _still(self, states: Tensor) -> Tensor:
        """Whether no joint moves far within a sixth of a second: ``(sample,)``. Trembling joints are still."""
        positions = as_joints(states)[:, :, list(self.joints)]
        displacement = torch.linalg.vector_norm(positions[:, _SIXTH:] - positions[:, :-_SIXTH], dim=-1)
        return displacement.amax(dim=(1, 2)) * (FPS / _SIXTH) < STILL

    def says(self, states: Tensor, name: str) -> Tensor:
        """Whether windows ``(sample, 32, 42)`` show a class: ``(sample,)`` of bool; ``False`` for nonfinite windows."""
        finite = states.flatten(1).isfinite().all(dim=1)
        return finite & (self(states.nan_to_num(0.0, 0.0, 0.0)).argmax(dim=-1) == self.classes.index(name))


class Judge(nn.Module):
    """Ensembles by part of the body, each of ``members`` networks; ``forward`` returns features, as torchmetrics expects."""

    def __init__(self, members: int = 2) -> None:
        super().__init__()
        self.members = members
        self.parts = nn.ModuleDict({name: Recogniser(*PARTS[name], members, members * (name == WHOLE)) for name in PARTS})
        self.num_features = EMBEDDING
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode: torchmetrics and Lightning switch their submodules; parts are trained separately."""
        return super().train(False)

    def part(self, name: str) -> Recogniser:
        """Ensemble of a key of :data:`PARTS`."""
        return cast(Recogniser, self.parts[name])

    @torch.no_grad()
    def forward(self, states: Tensor) -> Tensor:
        """Features ``(sample, 32)`` of windows ``(sample, 32, 42)``."""
        return self.part(WHOLE).features(states)

    @torch.no_grad()
    def recognised(self, goal: str, states: Tensor) -> Tensor:
        """Whether windows ``(sample, 32, 42)`` show a goal: ``(sample,)`` of bool; a ``UserError`` for a goal without an action.

        For two joined actions, arms and trunk show the first and the legs the second, judged independently.
        """
        names = actions(goal)
        require(names, "goal", "an action that the judge of motion knows, such as 'walk'", repr(goal))
        if len(names) == 1:
            return self.part(WHOLE).says(states, names[0])
        return self.part(ARMS).says(states, names[0]) & self.part(LEGS).says(states, of_legs(names[1]))

    def save(self, path: str | Path, training: Mapping[str, Any]) -> None:
        """Write weights and training settings atomically."""
        save_tensors(path, KIND, self.state_dict(), {"classes": CLASSES, "members": self.members, "training": training})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a judge; raise a ``UserError`` for a file that is missing, damaged or of another kind."""
        remedy = "take it from the project's repository, or make it with benchmarks/experiments/mocap_judge.py"
        require(Path(path).is_file(), str(path), "the judge of motion", f"nothing; {remedy}")
        tensors, header = load_tensors(path, KIND)
        require(header.get("classes") == list(CLASSES), f"{path}: key 'classes'", "those of this version", "others; train it again")
        members = header.get("members")
        if not isinstance(members, int) or not 1 <= members <= 100:
            raise UserError(f"{path}: key 'members': expected a number of networks, found {members!r}; train it again")
        judge = cls(members)
        shapes, expected = ({name: value.shape for name, value in values.items()} for values in (tensors, judge.state_dict()))
        require(shapes == expected, str(path), "weights of this version's judge", "others; train it again")
        judge.load_state_dict(tensors)
        return judge.requires_grad_(False)


@cache
def shipped_judge() -> Judge:
    """The shipped judge, read once."""
    return Judge.load(shipped(PATH))


def identity() -> str:
    """Hash of the shipped judge's file; empty if it is missing."""
    path = shipped(PATH)
    return file_hash(path) if path.is_file() else ""
