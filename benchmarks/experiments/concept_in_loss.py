"""Influence of the concept by timestep: loss on held-out demonstrations with their concept, other concepts, and none.

    python benchmarks/experiments/concept_in_loss.py --pretrained agent
    python benchmarks/experiments/concept_in_loss.py --pretrained logs/changes/agent-paper0/pretrained \
        --out results/concept_in_loss.json

The loss is the squared error of the noise (Eq. 1), given the initial state of each demonstration. *others* and *none* are the
increases of the loss with another training concept (mean over all) and with the empty concept; 0 if the model ignores the concept.
"""

import argparse
import json

import torch

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.settings import Loss
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.concept_model import ConceptModel

TIMESTEPS = (20, 50, 70, 80, 90, 95, 99)


def together(concept: torch.Tensor) -> Composition:
    """A single concept of weight 1, as one run."""
    return Composition(concept[None, None, None], concept.new_ones(1, 1))


@torch.no_grad()
def losses(model: ConceptModel, shown: Demonstrations, t: int) -> dict[str, float]:
    """The loss with the right concept, and by how much it grows with others and with none."""
    found: dict[str, list[torch.Tensor]] = {"right": [], "others": [], "none": []}
    texts = model.config.training_concepts
    for text in texts:
        own = shown.rows([row for row, name in enumerate(shown.concepts) if name == text])
        count = len(own)
        states, observed = own.windows(torch.arange(count), torch.zeros(count, dtype=torch.int64), model.window)
        draws = model.draws(count, 1.0, generator("cpu", t))
        assert draws is not None
        device = model.empty.device
        draws = Draws(torch.full_like(draws.t, t).to(device), draws.noise.to(device))
        states, observed = states.to(device), {name: value.to(device) for name, value in observed.items()}
        each = {
            name: model.losses(states, observed, together(concept), draws, Loss())[0]
            for name, concept in zip(("none", *texts), (model.empty, *model.training_embeddings), strict=True)
        }
        found["right"].append(each[text])
        found["none"].append(each["none"] - each[text])
        found["others"] += [each[name] - each[text] for name in texts if name != text]
    return {name: float(torch.cat(values).mean()) for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="agent")
    parser.add_argument("--count", type=int, default=50, help="demonstrations of each training concept")
    parser.add_argument("--split", choices=("train", "validation"), default="validation", help="train: those it has seen")
    parser.add_argument("--timesteps", type=int, nargs="+", default=TIMESTEPS)
    parser.add_argument("--device", default="cpu", help="cpu, or cuda for a large model")
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    few = FewShot.from_pretrained(options.pretrained)
    few.model.to(options.device)
    shown = few.domain.source(None).split(options.split, options.count, 0)
    found = {t: losses(few.model, shown, t) for t in options.timesteps}
    for t, told in found.items():
        print(f"{t:4d}", " ".join(f"{name} {value:+.6f}" for name, value in told.items()))
    if options.out:
        content = {"model": few.model.hash, "timesteps": {str(t): told for t, told in found.items()}}
        write_text(options.out, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
