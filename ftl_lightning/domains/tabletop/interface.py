"""Table-top without the simulator: cameras, observations, actions, tasks, and views, which augment scenes in training."""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ftl_lightning.data.features import Feature, Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.execution import Simulator, pybullet
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.services.errors import require
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.shipped import check_extra


@dataclass(frozen=True)
class Camera:
    """Fixed camera."""

    eye: tuple[float, float, float]  # metres
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    angle: float  # vertical field of view in degrees
    size: tuple[int, int]  # height and width of images

    def _matrices(self) -> tuple[list[float], list[float]]:
        view = pybullet().computeViewMatrix(self.eye, self.target, self.up)
        return view, pybullet().computeProjectionMatrixFOV(self.angle, self.size[1] / self.size[0], 0.1, 3.0)

    def picture(self, client: Simulator, shadow: bool = False) -> NDArray[np.uint8]:
        """Image ``(height, width, 3)`` of pybullet's software renderer."""
        height, width = self.size
        options = {"lightDirection": [0.3, -0.6, 1.5], "shadow": int(shadow), "renderer": pybullet().ER_TINY_RENDERER}
        image = client.getCameraImage(width, height, *self._matrices(), **options)
        rgba: NDArray[np.uint8] = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
        return np.ascontiguousarray(rgba[..., :3])

    def pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column and row ``(n, 2)`` of points ``(n, 3)`` in an image."""
        view, lens = (np.array(matrix).reshape(4, 4).T for matrix in self._matrices())
        clip = np.concatenate((places, np.ones((len(places), 1))), axis=-1) @ (lens @ view).T
        device = clip[:, :2] / clip[:, 3:]
        return (np.array([1, 1]) + device * (1, -1)) / 2 * (self.size[1], self.size[0])


OVERHEAD = Camera((0.5, 0.0, 0.85), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), 45.0, (64, 64))  # Camera of the model
FRONT = Camera((1.15, 0.0, 0.65), (0.53, 0.0, 0.05), (-1.0, 0.0, 1.0), 36.0, (240, 320))  # Camera of films


NAME, WIDE_NAME = "tabletop", "tabletop_wide"
STATE_NAMES = ("hand.x", "hand.y", "hand.z", "gripper.opening")
STATE_UNITS = ("m",) * 4
IMAGE, POSE, PLACES = "image", "pose", "places"
FEATURES = {IMAGE: Feature((3, *OVERHEAD.size), "image"), POSE: Feature((8,), state=(0, 1, 2, 7))}
"""Image of the overhead camera, without the arm; measured position (m), quaternion (real part last) and opening (m) of the hand,
which are the initial state of a plan, up to the arm's lag of millimetres behind the command."""
SEEN = Feature((5, 4))  # Privileged feature: visibility and centre (m) of each object, only for images of a training set
ACTION = 4  # Size of an action: position of the hand (m) and opening of the gripper (m)
HERTZ = 10  # Actions per second
MAX_STEPS = 160  # Maximum steps per episode, as in the paper: 16 seconds
OPEN, THRESHOLD = 0.08, 0.06
"""Opening of an open gripper, and opening above which an action opens the gripper, else it closes; in metres."""


def check_simulator() -> None:
    """Check that pybullet is installed; the ``UserError`` has the command that installs it."""
    check_extra("tabletop", f"domain {NAME}: its simulator")


TO_BOOK = "pick green circle to book"
TO_WHITE = "pick green circle to elevated white surface"
PUSH = "push green circle to orange triangle"
AROUND_BOWL = "push green circle to orange triangle around purple bowl"
PUSH_ON_BOOK = "push green circle to orange triangle on book"
BESIDE_BOWL = "pick green circle to beside purple bowl"
PUSH_TO_BOWL = "push green circle to purple bowl"
PUSH_TO_WHITE = "push green circle to elevated white surface"
PUSH_TO_BOOK = "push green circle to book"
BESIDE_TRIANGLE = "pick green circle to beside orange triangle"
BESIDE_BOOK = "pick green circle to beside book"
BESIDE_WHITE = "pick green circle to beside elevated white surface"
TO_TRIANGLE = "pick green circle to orange triangle"
TO_BOWL = "pick green circle to purple bowl"
LIFT = "lift green circle"

TRAINING_CONCEPTS = (TO_BOOK, TO_WHITE, PUSH, AROUND_BOWL)  # Training concepts of the paper
WIDE_CONCEPTS = (*TRAINING_CONCEPTS, PUSH_TO_BOWL, PUSH_TO_WHITE, BESIDE_TRIANGLE)
"""Training concepts of the wide model: more pushes and picks, none of which is an evaluation task."""
PAIRS = (PUSH_TO_BOOK, BESIDE_BOWL, BESIDE_BOOK, BESIDE_WHITE, TO_TRIANGLE, TO_BOWL)
"""Pairs of a verb and an object that the wide model's pretraining shows separately."""
TASKS = (*WIDE_CONCEPTS, PUSH_ON_BOOK, *PAIRS, LIFT)
PUSHES = tuple(task for task in TASKS if task.startswith("push"))
BESIDE = (BESIDE_BOWL, BESIDE_TRIANGLE, BESIDE_BOOK, BESIDE_WHITE)  # Picks that end on the table

SUITES = {
    "training": training_suite(TRAINING_CONCEPTS),
    "paper": Suite((EvaluationTask("new concept", PUSH_ON_BOOK, (PUSH_ON_BOOK,)),)),
    "representation": Suite((EvaluationTask("training representation", PUSH_ON_BOOK, texts=(PUSH,)),)),
    "validation": Suite((EvaluationTask("new concept", BESIDE_BOWL, (BESIDE_BOWL,)),)),
}
"""``validation`` is a pick, so that no setting is tuned on the evaluated push. ``representation`` is the paper's baseline: scenes
of the new task with the text of the push on the table."""
WIDE_SUITES = {
    "training": training_suite(WIDE_CONCEPTS),
    "paper": SUITES["paper"],
    "pairs": Suite((EvaluationTask("new concept", PUSH_TO_BOOK, (PUSH_TO_BOOK,)),)),
    "validation": SUITES["validation"],
    "more": Suite(tuple(EvaluationTask("new concept, eight tasks", task, (task,)) for task in (*PAIRS, PUSH_ON_BOOK, LIFT))),
}
"""``pairs``: a verb and an object that pretraining shows separately; ``more``: all :data:`PAIRS`, a lift and the paper's task."""


def check_task(task: str) -> str:
    """Return a known task; raise a ``UserError`` for an unknown one."""
    require(task in TASKS, "table-top task", f"one of {', '.join(map(repr, TASKS))}", repr(task))
    return task


HAND, POINTS, LEVEL, MOVED = "hand", "points", "level", "moved"
ORIGIN = "origin"
"""Observed hand position in the image. View ``hand``: column and row, -1 to 1; view ``points``: x and y from the image centre, in
half images."""
SHIFT = 0.07  # Maximum shift of a scene in metres, in x and in y
RAISED = 0.05  # Maximum elevation in metres of half of the scenes without image, so that pushes and picks generalise to any surface
TURN = 0.5  # Maximum rotation in radians of half of the scenes; the other half is rotated by any angle
BLUR = (0.004, 0.004, 0.002)  # Standard deviation of the errors of an image encoder on new scenes, in metres, in x, y and height
SURE = 6.0  # Visibility logit of a confident encoder
HALF = OVERHEAD.eye[2] * math.tan(math.radians(OVERHEAD.angle) / 2)  # Metres of the table from the centre of an image to its edge
MIDDLE = OVERHEAD.target[:2]  # x and y of the centre of an image


def moved(states: Tensor, observed: Observed, mirrored: Tensor, angles: Tensor, shifts: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Mirror a scene, rotate it about the image centre and shift it: states ``(sample, horizon, 4)`` and observations.

    The camera looks straight down: the image moves with the table, up to a few per cent of perspective of high objects. The yaw of
    the hand, which plans do not command, is constant.

    Args:
        observed: ``pose``, optionally ``image`` and the privileged ``places``.
        mirrored, angles, shifts: ``(sample,)`` of bool, left and right exchanged; ``(sample,)`` in radians; ``(sample, 2)`` in m.
    """
    cos, sin = angles.cos(), angles.sin()
    side = torch.where(mirrored, -1.0, 1.0)
    turned = torch.stack((torch.stack((cos, -sin * side), dim=-1), torch.stack((sin, cos * side), dim=-1)), dim=-2)
    middle = states.new_tensor(MIDDLE)

    def places(values: Tensor) -> Tensor:
        """Transform ``(sample, ..., columns)`` with x and y in the first two columns."""
        flat = values.flatten(1, -2) if values.dim() > 2 else values[:, None]
        xy = (flat[..., :2] - middle) @ turned.transpose(1, 2) + middle + shifts[:, None]
        return torch.cat((xy, flat[..., 2:]), dim=-1).reshape(values.shape)

    # A pixel at column u and row v (-1 to 1) shows x = -HALF v, y = -HALF u, from the centre. Each is sampled at its source.
    back = turned.transpose(1, 2)
    offset = (back @ shifts[..., None])[..., 0] / HALF
    theta = torch.cat((back.flip(1, 2), offset.flip(1)[..., None]), dim=-1)
    result = {**observed, POSE: places(observed[POSE])}
    if IMAGE in observed:
        grid = functional.affine_grid(theta, list(observed[IMAGE].shape), align_corners=False)
        image = functional.grid_sample(observed[IMAGE].float(), grid, padding_mode="border", align_corners=False)
        result[IMAGE] = image.round().to(torch.uint8)
    if PLACES in observed:
        visible, centres = observed[PLACES].split((1, 3), dim=-1)
        centres = places(centres)
        inside = ((centres[..., :2] - middle).abs() < HALF).all(dim=-1, keepdim=True)
        result[PLACES] = torch.cat((visible * inside, centres), dim=-1)
    return places(states), result


def raised(states: Tensor, observed: Observed, heights: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Raise the table by heights ``(sample,)`` in metres: states, ``pose`` and ``places``, not images."""
    states, pose, places = states.clone(), observed[POSE].clone(), observed[PLACES].clone()
    pose[:, 2] += heights
    places[..., 3] += heights[:, None]
    states[..., 2] += heights[:, None]
    return states, {**observed, POSE: pose, PLACES: places}


def keypoint_loss(keypoints: Tensor, places: Tensor) -> Tensor:
    """Loss of an image encoder's keypoints ``(sample,)``.

    L1 error of the centres of visible objects, in half images, plus .01 times the cross-entropy of visibility.

    Args:
        keypoints: x, y, height and visibility logit of each object, all x first ``(sample, 20)``; see :class:`.ImageEncoder`.
        places: :data:`SEEN` ``(sample, 5, 4)``.
    """
    keypoints, visible = keypoints.unflatten(1, (4, -1)).transpose(1, 2), places[..., 0]
    error = keypoints[..., :3] - (places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))) / HALF
    entropy = functional.binary_cross_entropy_with_logits(keypoints[..., 3], visible, reduction="none")
    return (error.abs().sum(dim=-1) * visible + 0.01 * entropy).sum(dim=-1)


def noisy_keypoints(places: Tensor, draw: torch.Generator) -> Tensor:
    """Simulate keypoints of an image encoder, as of :func:`keypoint_loss`: true centres plus normal noise of :data:`BLUR`."""
    visible, centres = places[..., :1], places[..., 1:] - places.new_tensor((*MIDDLE, 0.0))
    noise = drawn(len(centres), lambda n: torch.randn((n, *centres.shape[1:]), generator=draw, device=centres.device))
    noise = noise * centres.new_tensor(BLUR)
    return torch.cat((visible * (centres + noise) / HALF, SURE * (2 * visible - 1)), dim=-1).transpose(1, 2).flatten(1)


def _turned(states: Tensor, observed: Observed, draw: torch.Generator | None, unmoved: float = 0.0) -> tuple[Tensor, Observed]:
    """Mirror, rotate and shift scenes at random, except a share that stays ``unmoved``.

    New tasks (``draw`` is ``None``) are not transformed. Interpolation blurs images, so an encoder of moved images alone is less
    precise on new images.
    """
    if draw is None:
        return states, observed
    count, device = len(states), states.device
    uniform = drawn(count, lambda n: torch.rand((n, 5), generator=draw, device=device))
    most = torch.where(uniform[:, 1] < 0.5, TURN, math.pi)
    moves = uniform[:, 1] < 1 - unmoved
    angles, shifts = moves * most * (2 * uniform[:, 2] - 1), moves[:, None] * SHIFT * (2 * uniform[:, 3:] - 1)
    return moved(states, observed, moves & (uniform[:, 0] < 0.5), angles, shifts)


def _turned_and_raised(
    states: Tensor, observed: Observed, draw: torch.Generator | None, unmoved: float = 0.0
) -> tuple[Tensor, Observed]:
    """:func:`_turned`; half of the scenes without image are also raised, by up to :data:`RAISED`."""
    states, observed = _turned(states, observed, draw, unmoved)
    if draw is None or IMAGE in observed:
        return states, observed
    height = drawn(len(states), lambda n: torch.rand(n, generator=draw, device=states.device))
    return raised(states, observed, RAISED * (2 * height - 1).clamp(min=0))


def _place(observed: Observed) -> Tensor:
    """Origin of states with the view ``hand``: hand position, and zero opening, ``(sample, 1, 4)``."""
    return functional.pad(observed[POSE][:, None, :3], (0, 1))


def _with_place(observed: Observed) -> dict[str, Tensor]:
    return {**observed, ORIGIN: (observed[POSE][:, :2] - observed[POSE].new_tensor(MIDDLE)) / HALF}


def _with_pixel(observed: Observed) -> dict[str, Tensor]:
    return {**observed, ORIGIN: -_with_place(observed)[ORIGIN].flip(1)}


_FROM_HAND = View(
    features={**FEATURES, ORIGIN: Feature((2,))},
    observe=_with_pixel,
    encode=lambda states, observed: states - _place(observed),
    decode=lambda states, observed: states + _place(observed),
    perturb=_turned_and_raised,
)
VIEWS = {
    HAND: _FROM_HAND,
    POINTS: replace(_FROM_HAND, observe=_with_place, plane=(0, 1)),
    LEVEL: replace(_FROM_HAND, observe=_with_place, plane=(0, 1), perturb=_turned),
    MOVED: View(
        features=FEATURES,
        observe=lambda observed: observed,
        encode=lambda states, observed: states,
        decode=lambda states, observed: states,
        perturb=_turned_and_raised,
        same_columns=True,
    ),
}
"""All views augment scenes. States are relative to the hand in ``hand`` and ``points``, absolute in ``moved``. ``points`` is for
image encoders with x and y of objects; ``level`` is ``points`` without raised scenes, as in the paper.
Keypoints can be relative to the hand, see :data:`ORIGIN`."""
UNMOVED = 0.25  # Share of the scenes of pretraining
WIDE_VIEWS = {POINTS: replace(VIEWS[POINTS], pretraining=partial(_turned_and_raised, unmoved=UNMOVED))}
"""View of the wide model: pretraining does not move a share of :data:`UNMOVED` of the scenes. Inversion moves all scenes: unmoved
scenes of a few demonstrations would be memorised."""
