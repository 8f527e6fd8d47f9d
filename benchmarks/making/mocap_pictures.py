"""The films of human motion in the documentation, with the model and the concepts that ship; starts are made by rule.

    python benchmarks/making/mocap_pictures.py --out docs

``human_motion.gif``: jumping jacks, walking, and both composed by parts of the body. ``human_motion_starts.gif``: jumping jacks
from somebody who stands level, and from strides.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from ftl_lightning.domains.mocap.measures import is_stride
from ftl_lightning.domains.mocap.rendering import film
from ftl_lightning.domains.mocap.skeleton import L_ANKLE, POSE, R_ANKLE, as_joints, standing_poses, walking_poses
from ftl_lightning.evaluation.pictures import gif, side_by_side
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.tensor_file import atomic

FOLDER = Path("pretrained/mocap")
SEED = 1


def write(path: Path, content: bytes) -> None:
    """Whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def starts(seed: int) -> torch.Tensor:
    """Somebody level, and two strides, one with each foot in front: ``(3, 42)``."""
    draw = torch.Generator().manual_seed(seed)
    walking = walking_poses(200, draw)
    wide = walking[is_stride(walking)]
    joints = as_joints(wide)
    right = joints[:, R_ANKLE, 1] > joints[:, L_ANKLE, 1]
    return torch.stack((standing_poses(1, draw)[0], wide[right][0], wide[~right][0]))


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    chosen = parser.parse_args(arguments)
    model = FewShot.from_pretrained("mocap")
    jacks = model.load(FOLDER / "jumping_jacks.safetensors")
    adapted = model.load(FOLDER / "jumping_jacks_adapter.safetensors")
    both = model.compose(f"walk@legs:1.8 + {FOLDER / 'jumping_jacks.safetensors'}@arms,trunk")
    three = {POSE: starts(SEED)}
    walked = model.sample(1.8 * model["walk"], observed=three, seed=SEED).states
    plain, changed = (model.sample(concept, observed=three, seed=SEED).states for concept in (jacks, adapted))
    composed = model.sample(both, observed=three, seed=SEED).states
    first = {"jumping jacks": plain[0], "walk": walked[0], "jacks on arms, walk on legs": composed[0]}
    write(chosen.out / "human_motion.gif", gif(side_by_side({name: film(states) for name, states in first.items()})))
    names = ("level", "right foot in front", "left foot in front")
    rows = {
        f"{name}, {form}": states
        for form, plans in (("ours", plain), ("adapter", changed))
        for name, states in zip(names, plans, strict=True)
    }
    write(chosen.out / "human_motion_starts.gif", gif(side_by_side({name: film(states) for name, states in rows.items()})))


if __name__ == "__main__":
    main()
