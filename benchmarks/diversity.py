"""How different the scenes are that a method generates for one task, which accuracy does not see.

    python benchmarks/diversity.py --out results/diversity.json

Learns the ten new concepts of object rearrangement with our method and with the two baselines that learn them by gradient descent
(two minutes), and prints the standard deviation of the shapes' centres over 50 scenes, the mean over coordinates and tasks.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from ftl_lightning.cli import main
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import load_concepts
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.object_rearrangement.relations import PER_SHAPE, SHAPES
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.seeding import generator
from ftl_lightning.tensor_file import write_text

DOMAIN = "object_rearrangement"
RUNS = {
    "FTL-IGM, temperature 0.1": (f"conf/invert/{DOMAIN}.yaml", f"pretrained/{DOMAIN}", 0.1),
    "FTL-IGM, temperature 1": (f"conf/invert/{DOMAIN}.yaml", f"pretrained/{DOMAIN}", 1.0),
    "BC": (f"conf/baseline/bc/invert/{DOMAIN}.yaml", f"pretrained/baseline/bc/{DOMAIN}", 0.0),
    "CVAE": (f"conf/baseline/cvae/invert/{DOMAIN}.yaml", f"pretrained/baseline/cvae/{DOMAIN}", 0.1),
}
COUNT = 50
CENTRES = [shape * PER_SHAPE + axis for shape in range(len(SHAPES)) for axis in range(2)]


def spread(scenes: Tensor) -> float:
    return float(scenes[:, CENTRES].std(dim=0).mean())


def learned(config: str, folder: str) -> None:
    quiet = ["--evaluation.suites=[paper]", "--evaluation.samples=1", "--evaluation.figures=0", "--evaluation.references=false"]
    if main(
        ["invert", "--config", config, *quiet, f"--model.output={folder}", f"--trainer.logger.init_args.save_dir={folder}/logs"]
    ):
        raise SystemExit(2)


def measured(config: str, pretrained: str, temperature: float) -> float:
    model = load_model(pretrained)
    with TemporaryDirectory() as folder:
        learned(config, folder)
        concepts = load_concepts(sorted(Path(folder).glob("*.safetensors")))
    draws = [generator("cpu", 0, number) for number in range(len(concepts))]
    compositions = [Composition(one.embeddings, one.weights) for one in concepts]
    sampling = Sampling("ddpm", model.max_steps or 1, temperature)
    scenes = model.sample(compositions, COUNT, sampling, draws)[:, :, 0]
    return sum(map(spread, scenes)) / len(scenes)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", help="JSON file to write")
    options = parser.parse_args()
    domain = load_domain(DOMAIN)
    drawn = [spread(domain.source(None).draw(task, COUNT, 0).states[:, 0]) for task in domain.concepts.suites["paper"].learned]
    found = {"the tasks themselves": sum(drawn) / len(drawn)} | {name: measured(*run) for name, run in RUNS.items()}
    found = {name: round(value, 3) for name, value in found.items()}
    print(json.dumps(found, indent=2))
    if options.out:
        write_text(options.out, json.dumps(found, indent=2) + "\n")
