"""Localisation error of a model's image encoder on the table-top, to distinguish failures of planning and of perception.

    python benchmarks/experiments/tabletop_localisation.py --pretrained pretrained/tabletop --out results/tabletop_localisation.json

(``_wide`` after both names: of the wide model.)

Linear regression (ridge) and a small network estimate the position of every object from the features of an image. They are trained
on new scenes of all tasks and tested on others; the encoder stays fixed. Errors are distances in centimetres, for circle and
triangle by the surface below them. `middle` is the error of the mean position. An encoder of objects also has its direct estimate
(`read`), and an error of the height of a held circle (that of the hand), in demonstrations of a pick with and without the bowl.
"""

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor, nn

from ftl_lightning.domains.tabletop.interface import HALF, IMAGE, MIDDLE, POSE, TASKS, THRESHOLD, TO_WHITE
from ftl_lightning.domains.tabletop.scenes import BOWL, COLUMNS, scenes, support
from ftl_lightning.domains.tabletop.source import initial_states
from ftl_lightning.networks.image_encoder import POINT
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

SEED = 990
TESTED = 0.2
"""Share of the scenes."""
STEPS = 2000
"""Of the small network's training."""
EPISODES, LIFTED = 20, 0.1
"""Demonstrations with a held circle, and minimum height of the hand in metres."""


def ridge(features: Tensor, places: Tensor) -> nn.Module:
    """A linear layer from ``(scene, n)`` to ``(scene, 2)``, by least squares with a penalty of 1 on standardised features."""
    mean, spread = features.mean(dim=0), features.std(dim=0) + 1e-6
    inputs = torch.cat(((features - mean) / spread, torch.ones(len(features), 1)), dim=1).double()
    penalty = torch.eye(inputs.shape[1], dtype=torch.double)
    weights = torch.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ places.double()).float()
    layer = nn.Linear(features.shape[1], 2)
    with torch.no_grad():
        layer.weight.copy_((weights[:-1] / spread[:, None]).T)
        layer.bias.copy_(weights[-1] - (mean / spread) @ weights[:-1])
    return layer


def network(features: Tensor, places: Tensor) -> nn.Module:
    """Two hidden layers, trained in place of a policy's."""
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(features.shape[1], 128), nn.Mish(), nn.Linear(128, 128), nn.Mish(), nn.Linear(128, 2))
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(features), (64,))
        optimizer.zero_grad()
        (net(features[rows]) - places[rows]).square().mean().backward()
        optimizer.step()
        decay.step()
    return net


def told(features: Tensor, name: str) -> Tensor | None:
    """Where an encoder says that an object is ``(scene, 2)`` in centimetres, if it reads points."""
    count = len(COLUMNS)
    if features.shape[1] != POINT * count:
        return None
    number = list(COLUMNS).index(name)
    return 100 * (features[:, [number, count + number]] * HALF + torch.tensor(MIDDLE))


def heights(model: ConceptModel) -> dict[str, dict[str, float]]:
    """Errors in centimetres of the height of a held circle, with and without the bowl; of an encoder of objects."""
    episodes = model.domain.source(None).draw(TO_WHITE, EPISODES, SEED)
    images, poses = episodes.observed[IMAGE], episodes.observed[POSE]
    within = torch.arange(images.shape[1]) < episodes.lengths[:, None]
    held = within & (episodes.states[..., 3] < THRESHOLD) & (poses[..., 2] > LIFTED)
    assert episodes.scenes is not None
    assert model.images is not None
    bowl = (episodes.scenes[:, COLUMNS[BOWL].start] > 0.5)[:, None].expand_as(held)[held]
    with torch.no_grad():
        read = torch.cat([model.images({IMAGE: some}) for some in images[held].split(256)])
    off = 100 * (read[:, 2 * len(COLUMNS)] * HALF - poses[..., 2][held])
    parts = {"with the bowl": off[bowl], "without the bowl": off[~bowl]}
    return {
        f"height of a held circle {name}": {"images": float(len(part)), "read rms": part.square().mean().sqrt().item()}
        for name, part in parts.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/tabletop", help="folder of the model")
    parser.add_argument("--count", type=int, default=300, help="scenes of each task")
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    model = load_model(options.pretrained)
    with bar("scenes", len(TASKS)) as advance:
        starts = []
        for task in TASKS:
            starts.append(initial_states(scenes(task, options.count, SEED)))
            advance()
    drawn = torch.cat([one.require_scenes() for one in starts])
    with torch.no_grad():
        read = [model.of_images(one.observed) for one in starts]
    features = torch.cat([one for one in read if one is not None]) if model.images is not None else None
    if features is None:
        raise UserError(f"{options.pretrained}: expected a model that reads images, found one that does not")
    mixed = torch.randperm(len(drawn), generator=torch.Generator().manual_seed(SEED))
    found: dict[str, dict[str, float]] = {}
    for name, columns in COLUMNS.items():
        rows = mixed[drawn[mixed][:, columns.start] > 0.5]
        known, tested = rows[int(TESTED * len(rows)) :], rows[: int(TESTED * len(rows))]
        places = 100 * drawn[:, columns.start + 1 : columns.start + 3]

        def error(estimate: Tensor, places: Tensor = places, tested: Tensor = tested) -> Tensor:
            return (estimate - places[tested]).norm(dim=1)

        off = {}
        for kind, fit in (("linear", ridge), ("network", network)):
            with torch.no_grad():
                probe = torch.enable_grad()(fit)(features[known], places[known])
                off[kind] = error(probe(features[tested]))
        if (itself := told(features[tested], name)) is not None:
            off["read"] = error(itself)
        middle = error(places[known].mean(dim=0))
        raised = torch.tensor([support(scene, name) > 0 for scene in drawn[tested].numpy()])
        for where, rows in (("", ~raised), (" on the book", raised)):
            if not rows.any():
                continue
            numbers = {"scenes": float(rows.sum()), "middle": middle[rows].mean().item()}
            for kind, distances in off.items():
                one = distances[rows]
                numbers |= {f"{kind} median": one.median().item(), f"{kind} rms": one.square().mean().sqrt().item()}
            found[name + where] = numbers
            print(name + where, {key: round(value, 2) for key, value in numbers.items()}, flush=True)
    if features.shape[1] == POINT * len(COLUMNS):
        found |= heights(model)
    if options.out:
        content = {"model": model.hash, "pretrained": Path(options.pretrained).name, "cm": found}
        write_text(options.out, json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
