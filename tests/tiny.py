"""Sizes with which every configuration that ships is fitted in a second or two, and what its domain needs to be fitted at all."""

from pathlib import Path

import numpy as np

from tests.conftest import CONF
from tests.domains.mocap_samples import folder

OURS = ("agent", "driving", "driving_wide", "mocap", "mocap_root", "object_rearrangement", "own", "tabletop", "tabletop_wide")
CONFIGURATIONS = [Path(f"{domain}.yaml") for domain in OURS] + sorted(
    path.relative_to(CONF) for method in ("bc", "cvae", "in_context") for path in (CONF / method).glob("*.yaml")
)
"""Whatever ``fit`` takes, relative to ``conf``."""
FEW = ["--data.samples_per_concept=2", "--data.validation_per_concept=1"]
ONE = ["--data.samples_per_concept=1", "--data.validation_per_concept=1", "--data.recoveries=1"]
DATA = {
    "object_rearrangement": ["--data.samples_per_concept=4", "--data.validation_per_concept=1"],
    "agent": FEW,
    "driving": FEW,
    "driving_wide": FEW,
    "mocap": [],
    "mocap_root": [],
    "own": [],
    "tabletop": ONE,
    "tabletop_wide": ONE,
}
MLP = "hidden_dim: 16, depth: 2, condition_dim: 16"
UNET = "width: 8, multipliers: [1, 2], film: true, broadcast: true, clock: 8"
NETWORK = {
    "agent": [f"--model.denoiser_args={{{UNET}, initial_encoder: entities}}"],
    "driving": [f"--model.denoiser_args={{{MLP}, initial_encoder: set, initial_dim: 16, dropout: 0.1}}"],
    "driving_wide": [f"--model.denoiser_args={{{MLP}, initial_encoder: entities, initial_dim: 16}}"],
    "mocap": [f"--model.denoiser_args={{{UNET}, skip: true, smooth: 2}}"],
    "mocap_root": [f"--model.denoiser_args={{{UNET}, skip: true, smooth: 2}}"],
    "object_rearrangement": [f"--model.denoiser_args={{{MLP}, dropout: 0.1}}"],
    "own": [f"--model.denoiser_args={{{MLP}, dropout: 0.1}}"],
    "tabletop": [f"--model.denoiser_args={{{MLP}, initial_dim: 16}}"],
    "tabletop_wide": [f"--model.denoiser_args={{{MLP}, initial_dim: 16}}"],
    "bc": ["--model.hidden_dim=16"],
    "cvae": ["--model.hidden_dim=16", "--model.latent_dim=4"],
    "in_context": ["--model.width=16", "--model.layers=1", "--model.heads=2"],
}
"""Sizes alone; everything else is as it ships, and dropout on top of it where the network has some."""
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]


def fit(path: Path, *options: str) -> list[str]:
    """Arguments of a tiny fit of a configuration, whose data lie in the current folder.

    Args:
        path: of the configuration, relative to ``conf``.
        options: after all others.
    """
    from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
    from ftl_lightning.domains.mocap.tasks import TRAINING_CONCEPTS

    domain, method = path.stem, path.parent.name or path.stem
    arguments = ["fit", f"--config={CONF / path}", *DATA[domain], *NETWORK[method], *QUIET]
    if domain.startswith("mocap"):
        recordings = Path("recordings").absolute()
        arguments += [f"--data.root={recordings if recordings.is_dir() else folder(recordings, TRAINING_CONCEPTS)}"]
    if domain == "own":
        states = np.concatenate([strokes(kind, 4, 0) for kind in TRAINING])
        np.savez("strokes.npz", states=states, concepts=np.repeat(TRAINING, 4))
        arguments += ["--data.demonstrations=strokes.npz"]
    return [*arguments, *options]
