import math
import os
from pathlib import Path

import numpy as np
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from torch import Tensor

from ftl_lightning.domains.films import seen
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.rendering import LEFT, MAX_SAMPLES, RIGHT, SOLE, TRUNK, film, picture, wireframe
from ftl_lightning.domains.mocap.skeleton import HORIZON
from ftl_lightning.domains.mocap.source import read_folder
from ftl_lightning.evaluation.pictures import gif, side_by_side
from tests.domains.mocap_samples import folder

STANDING = (
    (0.1, 0, 0), (0.1, 0, -0.42), (0.1, 0, -0.82), (-0.1, 0, 0), (-0.1, 0, -0.42), (-0.1, 0, -0.82), (0.2, 0, 0.5), (0.22, 0, 0.22),
    (0.22, 0.05, 0), (-0.2, 0, 0.5), (-0.22, 0, 0.22), (-0.22, 0.05, 0), (0, 0, 0.55), (0, 0, 0.75),
)  # fmt: skip
"""Metres."""


def waving(frames: int = HORIZON) -> Tensor:
    """Both arms go up and down once at the sides, the legs apart and together: ``(frames, 42)``."""
    body = torch.tensor(STANDING).repeat(frames, 1, 1)
    for frame in range(frames):
        raised = math.pi * math.sin(math.pi * frame / frames) ** 2
        spread = 0.15 * raised / math.pi
        for side, shoulder, elbow, wrist, knee, ankle in ((1, 6, 7, 8, 1, 2), (-1, 9, 10, 11, 4, 5)):
            along = torch.tensor((side * math.sin(raised), 0.0, -math.cos(raised)))
            body[frame, elbow] = body[frame, shoulder] + 0.28 * along
            body[frame, wrist] = body[frame, shoulder] + 0.5 * along
            body[frame, knee, 0] += side * spread
            body[frame, ankle, 0] += 2 * side * spread
    return body.flatten(1)


def inked(frame: np.ndarray, colour: str) -> np.ndarray:
    """Which pixels ``(height, width)`` have about this colour."""
    wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    found: np.ndarray = np.abs(frame.astype(int) - wanted).max(axis=-1) < 30
    return found


def frames_of(figure: Figure) -> list[str]:
    return [to_hex(axes.spines["left"].get_edgecolor()) for axes in figure.axes]


def test_a_picture_has_a_strip_of_eight_poses_for_each_sample_that_fits_marked_right_or_wrong() -> None:
    states = torch.stack([waving()] * 3)
    figure = picture(states, [True, False, True], "jumping jacks", None)
    assert frames_of(figure) == ["#2e9e46", "#d03a3a", "#2e9e46"]
    assert figure.get_suptitle() == "jumping jacks"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["left", "right", "trunk"]
    for axes in figure.axes:
        assert len(axes.collections) == 8
        assert axes.get_aspect() == 1
        times = [text.get_text() for text in axes.texts]
        assert (times[0], times[-1]) == ("0 s", "1.03 s")
    unmarked = picture(states[:1], None, "", None)
    assert set(frames_of(unmarked)) == {"#8a8a8a"}
    unmarked.savefig("strip.png")
    assert Path("strip.png").stat().st_size > 5_000
    figure = picture(torch.stack([waving(4)] * 12), None, "walk", None)
    assert len(figure.axes) == MAX_SAMPLES
    assert figure.get_suptitle() == f"walk ({MAX_SAMPLES} of 12 shown)"
    assert len(figure.axes[0].collections) == 4  # no more poses than frames


def test_limbs_are_coloured_by_the_own_side_of_a_person_who_faces_the_viewer() -> None:
    body = wireframe(waving())
    by_colour: dict[str, set[str]] = {LEFT: set(), RIGHT: set(), TRUNK: set()}
    for (a, b), colour in zip(body.lines, body.colours, strict=True):
        by_colour[colour] |= {f"{skeleton.JOINTS[a]}-{skeleton.JOINTS[b]}"}
    assert by_colour[LEFT] == {"LHip-LKnee", "LKnee-LAnkle", "LShoulder-LElbow", "LElbow-LWrist"}
    assert by_colour[RIGHT] == {name.replace("L", "R") for name in by_colour[LEFT]}
    assert len(by_colour[TRUNK]) == len(skeleton.BONES) - 8
    frame = film(waving())[0]
    assert inked(frame, RIGHT).nonzero()[1].mean() < inked(frame, LEFT).nonzero()[1].mean()


def test_whoever_squats_comes_down_and_the_lowest_joint_stands_on_the_floor() -> None:
    states = waving(2)
    squatting = skeleton.as_joints(states[1:].clone())
    squatting[0, [2, 5], 2] = -0.3  # the feet nearer to the hips
    squatting[0, [1, 4], 2] = -0.2
    body = wireframe(torch.cat((states[:1], squatting.flatten(1)))).points
    assert np.allclose(body[..., 2].min(axis=1), SOLE)
    assert body[1, skeleton.HEAD, 2] < body[0, skeleton.HEAD, 2] - 0.4
    assert np.allclose(np.linalg.norm(body[:, 0] - body[:, 3], axis=-1), 0.2)  # nothing else is changed


def test_nothing_in_a_film_is_longer_than_it_is() -> None:
    ends = torch.randn(200, 2, 3, generator=torch.Generator().manual_seed(0)).numpy()
    lengths, whole = (np.linalg.norm(points[:, 0] - points[:, 1], axis=-1) for points in (seen(ends), ends))
    assert np.allclose(lengths, whole, atol=1e-5)


def test_a_film_shows_every_frame_at_one_scale_and_what_leaves_the_usual_room() -> None:
    pictures = film(waving())
    assert len(pictures) == HORIZON
    assert {(picture.shape, picture.dtype) for picture in pictures} == {((240, 240, 3), np.dtype(np.uint8))}
    left, top = (inked(pictures[time], LEFT).nonzero() for time in (0, HORIZON // 2))
    assert top[0].min() < left[0].min() - 40  # the hand goes up
    feet = [inked(picture, TRUNK).nonzero()[0].min() for picture in (pictures[0], film(waving(40))[0])]
    assert feet[0] == feet[1]
    wide = skeleton.as_joints(waving(2))
    wide[:, [skeleton.L_WRIST], 0] = -3.0
    frame = film(wide.flatten(1))[0]
    assert inked(frame, LEFT).any()
    assert not inked(frame[:, -2:], LEFT).any()


def test_films_stand_beside_one_another_above_their_names() -> None:
    short, long = film(waving(3)), film(waving(5))
    together = side_by_side({"demonstration": short, "ours": long, "a name that is long enough to need another line": long})
    assert len(together) == 5
    assert together[0].shape[1] == 3 * 240
    assert together[0].shape[0] > 240 + 2 * 14
    assert np.array_equal(together[4][:240, :240], short[-1])
    assert np.array_equal(together[4][:240, 240:480], long[-1])
    assert gif(together)[:6] == b"GIF89a"
    assert side_by_side({}) == []


def test_recordings_can_be_filmed(tmp_path: Path) -> None:
    """Made-up ones, and the user's where they are named."""
    named = os.environ.get("FTL_LIGHTNING_DATA")
    for root in (folder(tmp_path / "recordings"), *([Path(named)] if named else [])):
        recorded, _ = read_folder(root)
        pictures = film(torch.from_numpy(recorded.trial(0)[:HORIZON]))
        assert len(pictures) == HORIZON
        assert all(inked(frame, LEFT).any() and inked(frame, RIGHT).any() for frame in pictures)
        assert any(not np.array_equal(frame, pictures[0]) for frame in pictures), "nobody moves"
