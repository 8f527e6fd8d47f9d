"""The judge: which action a window of motion shows, learned from recordings of people.

Three kinds of recognisers vote: small convolutional networks over time, and two linear ones on numbers of the whole window. There
is such a jury for the whole body, one for arms and trunk, and one for the legs, so that actions at the same time are judged apart.
A jury picks the likeliest action, also where half of it is missing. Therefore the one for the whole body has verifiers: they have
learned to tell an action from motion made to look like it, such as its arms on the legs of somebody who walks, or a third of its
size. Where they do not confirm an action, it is not said. None has seen generated motion, or people who demonstrate new concepts.
``benchmarks/mocap_judge.py`` trains it.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from ftl_lightning.domains.mocap.actions import CLASSES, LEG_CLASSES, OTHER, STAND, actions, of_legs
from ftl_lightning.domains.mocap.features import LOWER, UPPER, extremes, signals, summary, turns
from ftl_lightning.domains.mocap.skeleton import COLUMNS, FPS, HORIZON, as_joints
from ftl_lightning.errors import UserError
from ftl_lightning.shipped import shipped
from ftl_lightning.tensor_file import file_hash, load_tensors, save_tensors

KIND = "motion judge"
PATH = Path("pretrained/mocap/judge.safetensors")
"""The judge that ships."""
WHOLE, ARMS, LEGS = "whole", "arms", "legs"
PARTS: Mapping[str, tuple[tuple[int, ...], tuple[str, ...]]] = {
    WHOLE: ((*LOWER, *UPPER), CLASSES),
    ARMS: (UPPER, CLASSES),
    LEGS: (LOWER, LEG_CLASSES),
}
"""Joints that each part of the judge sees, and the classes it tells apart; the trunk belongs to the arms."""
NUMBERS = {"summary": summary, "extremes": extremes}
"""What linear recognisers see, by name."""
VERIFIED_BY = {**NUMBERS, "turns": turns}
"""What verifiers see, by name."""
VERIFIER = 32
"""Hidden units of a verifier."""
WIDTH, EMBEDDING = 40, 32
"""Channels of a network; numbers that its last layer decides by."""
STILL = 0.3
"""Metres a second. Where every joint is slower over a sixth of a second, nobody does anything, however it may look."""
RESTING = ("pose", STAND, OTHER)
"""Classes that are seen in windows without movement."""
CONFIRMED = -3.0
"""Mean verifier logit from which an action is confirmed: a probability of .05 that it is whole. Far lower than one half, as people
whom the judge has not seen do an action a little otherwise than those it has learned from. Hard negatives get less still."""
VERIFIED = {"walk": CONFIRMED, "jump": CONFIRMED, "jumping jacks": CONFIRMED, "knee raise": CONFIRMED, "arm circle": 2.2}
"""Actions that verifiers confirm or exclude, each with the least mean logit.

More is asked of circles: they were recorded in all sizes, and a third of a large one is hardly smaller than a small one. Of actions
that are not listed, verifiers refuse too many people whom they have not seen.
"""
_SIXTH = FPS // 6
_OUTLIER = 5.0
"""Standard deviations beyond which a feature says no more."""


class Network(nn.Module):
    """A convolutional network over time.

    Args:
        channels: courses that it sees, see :func:`~ftl_lightning.domains.mocap.features.signals`.
        classes: that it tells apart.
    """

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()

        def layer(inputs: int, size: int, stride: int, dropped: float) -> list[nn.Module]:
            convolution = nn.Conv1d(inputs, WIDTH, size, stride=stride, padding=size // 2)
            return [convolution, nn.GroupNorm(4, WIDTH), nn.SiLU(), nn.Dropout1d(dropped)]

        self.layers = nn.Sequential(*layer(channels, 5, 2, 0.1), *layer(WIDTH, 5, 2, 0.1), *layer(WIDTH, 3, 1, 0.0))
        self.embed = nn.Sequential(nn.Dropout(0.3), nn.Linear(2 * WIDTH, EMBEDDING), nn.ReLU())
        self.head = nn.Linear(EMBEDDING, classes)

    def embedding(self, courses: Tensor) -> Tensor:
        """``(sample, channels, frame)`` to ``(sample, EMBEDDING)``, at least zero."""
        inside = self.layers(courses)
        return self.embed(torch.cat([inside.mean(dim=-1), inside.amax(dim=-1)], dim=1))

    def forward(self, courses: Tensor) -> Tensor:
        """Logits ``(sample, class)``."""
        return self.head(self.embedding(courses))


class Verifier(nn.Sequential):
    """A perceptron on numbers of the whole window: logits ``(sample, class)`` that it shows the whole of an action.

    Args:
        numbers: that it sees.
        classes: that it verifies.
    """

    def __init__(self, numbers: int, classes: int) -> None:
        super().__init__(nn.Dropout(0.2), nn.Linear(numbers, VERIFIER), nn.ReLU(), nn.Dropout(0.3), nn.Linear(VERIFIER, classes))


class Recogniser(nn.Module):
    """Networks and linear recognisers of the same joints and classes.

    Args:
        joints: that it sees.
        classes: that it tells apart.
        members: number of networks.
        verifiers: number of perceptrons that say of each class whether a window shows all of it; without any, all is confirmed.
    """

    def __init__(self, joints: Sequence[int], classes: Sequence[str], members: int = 2, verifiers: int = 0) -> None:
        super().__init__()
        self.joints, self.classes = tuple(joints), tuple(classes)
        still = torch.zeros(1, HORIZON, len(COLUMNS))
        channels = signals(still, joints).shape[1]
        seen = VERIFIED_BY if verifiers else NUMBERS
        numbers = {name: of(still, joints).shape[1] for name, of in seen.items()}
        self.networks = nn.ModuleList(Network(channels, len(classes)) for _ in range(members))
        self.verifiers = nn.ModuleList(Verifier(sum(numbers.values()), len(classes)) for _ in range(verifiers))
        self.linear = nn.ModuleDict({name: nn.Linear(numbers[name], len(classes)) for name in NUMBERS})
        for name, size in {"signals": channels, "embedding": EMBEDDING, **numbers}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def set_scale(self, name: str, values: Tensor, floor: float) -> None:
        """Take mean and standard deviation from values ``(sample, size)`` or ``(sample, size, frame)``."""
        flat = values.transpose(1, -1).flatten(0, -2)
        getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))
        getattr(self, f"{name}_std").copy_(flat.std(dim=0).clamp_min(floor))

    def _scaled(self, name: str, values: Tensor) -> Tensor:
        mean, std = getattr(self, f"{name}_mean"), getattr(self, f"{name}_std")
        shape = (1, -1, *(1 for _ in values.shape[2:]))
        return ((values - mean.view(shape)) / std.view(shape)).clamp(-_OUTLIER, _OUTLIER)

    def courses(self, states: Tensor) -> Tensor:
        """What networks see of windows ``(sample, 32, 42)``."""
        return self._scaled("signals", signals(states, self.joints))

    def numbers(self, name: str, states: Tensor) -> Tensor:
        """What of :data:`VERIFIED_BY` is seen of them."""
        return self._scaled(name, VERIFIED_BY[name](states, self.joints))

    def features(self, states: Tensor) -> Tensor:
        """What the first network decides by: ``(sample, EMBEDDING)``, with about unit variance over the training windows."""
        network = cast(Network, self.networks[0])
        return self._scaled("embedding", network.embedding(self.courses(states)))

    def votes(self, states: Tensor) -> dict[str, Tensor]:
        """Log probabilities ``(sample, class)`` by the networks, and by each linear recogniser."""
        courses = self.courses(states)
        networks = torch.stack([network(courses).log_softmax(dim=-1) for network in self.networks]).mean(dim=0)
        linear = {name: layer(self.numbers(name, states)).log_softmax(dim=-1) for name, layer in self.linear.items()}
        return {"networks": networks, **linear}

    def forward(self, states: Tensor) -> Tensor:
        """The mean of all votes: scores ``(sample, class)``.

        Of actions, minus infinity where no joint that it sees moves, or where verifiers do not confirm that it is the whole action.
        """
        scores = torch.stack(list(self.votes(states).values())).mean(dim=0)
        actions_only = torch.tensor([name not in RESTING for name in self.classes])
        excluded = self._still(states)[:, None]
        if len(self.verifiers):
            least = torch.tensor([VERIFIED.get(name, -torch.inf) for name in self.classes])
            excluded = excluded | (self.verified(states) < least)
        return scores.masked_fill(excluded & actions_only, -torch.inf)

    def verified(self, states: Tensor) -> Tensor:
        """Of each class, mean logit ``(sample, class)`` that a window which looks like it shows the whole of it.

        It means something for those of :data:`VERIFIED`.
        """
        numbers = self.all_numbers(states)
        return torch.stack([verifier(numbers) for verifier in self.verifiers]).mean(dim=0)

    def all_numbers(self, states: Tensor) -> Tensor:
        """What verifiers see of windows ``(sample, 32, 42)``: ``(sample, number)``."""
        return torch.cat([self.numbers(name, states) for name in VERIFIED_BY], dim=1)

    def _still(self, states: Tensor) -> Tensor:
        """Whether no joint gets anywhere within a sixth of a second: ``(sample,)``. Trembling joints do not."""
        positions = as_joints(states)[:, :, list(self.joints)]
        way = torch.linalg.vector_norm(positions[:, _SIXTH:] - positions[:, :-_SIXTH], dim=-1)
        return way.amax(dim=(1, 2)) * (FPS / _SIXTH) < STILL

    def says(self, states: Tensor, name: str) -> Tensor:
        """Whether each window ``(sample, 32, 42)`` shows a class: ``(sample,)`` of bool; ``False`` where one is not finite."""
        finite = states.flatten(1).isfinite().all(dim=1)
        return finite & (self(states.nan_to_num(0.0, 0.0, 0.0)).argmax(dim=-1) == self.classes.index(name))


class Judge(nn.Module):
    """Recognisers by the part of the body that they see.

    Called like a module, it gives the whole body's features, as metrics of torchmetrics ask for it.

    Args:
        members: networks of each, and verifiers of the one that sees the whole body.
    """

    def __init__(self, members: int = 2) -> None:
        super().__init__()
        self.members = members
        self.parts = nn.ModuleDict(
            {
                name: Recogniser(joints, classes, members, members if name == WHOLE else 0)
                for name, (joints, classes) in PARTS.items()
            }
        )
        self.num_features = EMBEDDING
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Stay as it is: torchmetrics and Lightning switch modules that they hold; parts are trained one by one."""
        return super().train(False)

    def part(self, name: str) -> Recogniser:
        """That of :data:`PARTS`."""
        return cast(Recogniser, self.parts[name])

    @torch.no_grad()
    def forward(self, states: Tensor) -> Tensor:
        """Features ``(sample, 32)`` of windows ``(sample, 32, 42)``."""
        return self.part(WHOLE).features(states)

    @torch.no_grad()
    def recognised(self, goal: str, states: Tensor) -> Tensor:
        """Whether windows ``(sample, 32, 42)`` show what a goal asks for: ``(sample,)`` of bool.

        Of two actions joined, arms and trunk show the first and the legs the second, each judged without the other's joints.

        Raises:
            UserError: for a goal that behaviour cannot be judged by.
        """
        asked = actions(goal)
        if not asked:
            raise UserError(f"goal: expected an action that the judge of motion knows, such as 'walk', found {goal!r}")
        if len(asked) == 1:
            return self.part(WHOLE).says(states, asked[0])
        return self.part(ARMS).says(states, asked[0]) & self.part(LEGS).says(states, of_legs(asked[1]))

    def save(self, path: str | Path, training: Mapping[str, Any]) -> None:
        """Write it with how it was trained, whole or not at all."""
        save_tensors(path, KIND, self.state_dict(), {"classes": CLASSES, "members": self.members, "training": training})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read one.

        Raises:
            UserError: for a file that is missing, damaged or of another form.
        """
        if not Path(path).is_file():
            raise UserError(
                f"{path}: expected the judge of motion, found nothing; "
                "take it from the project's repository, or make it with benchmarks/mocap_judge.py"
            )
        tensors, header = load_tensors(path, KIND)
        if header.get("classes") != list(CLASSES):
            raise UserError(f"{path}: key 'classes': expected those of this version, found others; train it again")
        members = header.get("members")
        if not isinstance(members, int) or not 1 <= members <= 100:
            raise UserError(f"{path}: key 'members': expected a number of networks, found {members!r}; train it again")
        judge = cls(members)
        expected = judge.state_dict()
        if {name: value.shape for name, value in tensors.items()} != {name: value.shape for name, value in expected.items()}:
            raise UserError(f"{path}: expected weights of this version's judge, found others; train it again")
        judge.load_state_dict(tensors)
        return judge.requires_grad_(False)


@cache
def shipped_judge() -> Judge:
    """The one that ships, read once."""
    return Judge.load(shipped(PATH))


def identity() -> str:
    """Hash of the shipped judge's file; empty where there is none."""
    path = shipped(PATH)
    return file_hash(path) if path.is_file() else ""
