"""Speed, each ratio measured in one run on this machine: inversion and sampling in batches against the published procedure.

    python benchmarks/speed.py [--pretrained pretrained/object_rearrangement] [--out results/speed.json] [--full]

The published inversion takes one noised demonstration at a time, accumulates two, and evaluates the K + 1 branches one after
another, for 5 x 10,000 optimiser steps a concept; a slice of its steps is timed and scaled up. ``--full`` runs it to its end
and judges what both have learned from the same demonstrations.
"""

import argparse
import functools
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.diffusion.samplers import Sampling, ddpm
from ftl_lightning.diffusion.schedule import denoising_loss
from ftl_lightning.domains.data import InversionData
from ftl_lightning.domains.domain import ACCURACY
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.learning import InversionModule
from ftl_lightning.learning.generative_model import GenerativeModel
from ftl_lightning.seeding import generator
from ftl_lightning.tensor_file import write_text
from ftl_lightning.trainer import Trainer

PUBLISHED_STEPS = 50_000
OMEGA = 1.2
TEMPERATURE = 0.1
SAMPLING = Sampling("ddpm", 100, TEMPERATURE)

Result = TypeVar("Result")


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """A result, and the seconds it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def branch_by_branch(model: GenerativeModel, x: Tensor, t: Tensor, concepts: Tensor, weights: Tensor) -> Tensor:
    """Eq. 2 as the published code evaluates it: one call of the network for each branch."""
    empty: Tensor = model.denoiser(x, t, model.empty[None], torch.zeros_like(t))
    total = empty
    for concept, weight in zip(concepts, weights, strict=True):
        total = total + weight * (model.denoiser(x, t, concept[None], torch.zeros_like(t)) - empty)
    return total


def published_inversion(model: GenerativeModel, demonstrations: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Embeddings and weights after so many optimiser steps of the published procedure for one concept."""
    states = model.normalization.encode(demonstrations)
    concepts = torch.randn(2, model.config.concept_dim, requires_grad=True)
    weights = torch.full((2,), OMEGA)
    optimiser = torch.optim.Adam([concepts], lr=2e-4)
    for _ in range(steps):
        optimiser.zero_grad()
        for _ in range(2):
            clean = states[torch.randint(len(states), (1,))]
            t = torch.randint(len(model.alpha_bar), (1,))
            noise = torch.randn_like(clean)
            loss = denoising_loss(lambda x, t: branch_by_branch(model, x, t, concepts, weights), clean, noise, t, model.alpha_bar)
            (loss.mean() / 2).backward()
        optimiser.step()
    return concepts.detach(), weights


def our_inversion(pretrained: str, concepts: list[str], steps: int) -> list[Concept]:
    """What ``invert`` does with the shipped configuration, for some concepts of the validation suite."""
    data = InversionData("object_rearrangement", suite="validation", steps=steps)
    kept = [row for row, text in enumerate(data.demonstrations.concepts) if text in concepts]
    data.demonstrations, data.concepts = data.demonstrations.rows(kept), tuple(concepts)
    module = InversionModule(pretrained, omega=OMEGA)
    trainer = Trainer(
        max_epochs=1,
        check_val_every_n_epoch=2,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        default_root_dir="logs/benchmark",
    )
    trainer.fit(module, datamodule=data)
    return [module.learned()[name] for name in concepts]


def accuracy(model: GenerativeModel, task: str, concepts: Tensor, weights: Tensor) -> float:
    """Share of 50 samples that show the task."""
    states = model.sample([Composition(concepts, weights)], 50, SAMPLING, [generator("cpu", 0)])[0]
    return float(model.domain.metrics[ACCURACY].measure(task, states, None).float().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/object_rearrangement")
    parser.add_argument("--out", default="results/speed.json")
    parser.add_argument("--steps", type=int, default=400, help="of our inversion")
    parser.add_argument("--slice", type=int, default=300, help="timed steps of the published inversion")
    parser.add_argument("--task", default="circle antidiagonal to triangle", help="the one concept, of the validation suite")
    parser.add_argument("--full", action="store_true", help="run the published inversion to its end and judge both")
    options = parser.parse_args()
    torch.manual_seed(0)
    model = GenerativeModel.load(options.pretrained)
    domain = load_domain(model.config.domain)
    task = options.task
    others = [name for name in domain.concepts.suites["validation"].learned if name != task]
    demonstrations = InversionData(domain.name, suite="validation").demonstrations.select(task).states
    slice_steps = PUBLISHED_STEPS if options.full else options.slice

    published_inversion(model, demonstrations, 20)  # warm-up
    (theirs, their_weights), duration = timed(lambda: published_inversion(model, demonstrations, slice_steps))
    published = duration / slice_steps * PUBLISHED_STEPS
    (ours,), one = timed(lambda: our_inversion(options.pretrained, [task], options.steps))
    _, ten = timed(lambda: our_inversion(options.pretrained, [task, *others[:9]], options.steps))

    concepts, weights = model.training_embeddings[:2], torch.full((2,), OMEGA)
    shape = (1, model.config.horizon, model.config.state_dim)
    singles = 3

    def one_at_a_time() -> None:
        for seed in range(singles):
            noise = functools.partial(torch.randn, shape, generator=generator("cpu", seed))
            ddpm(lambda x, t: branch_by_branch(model, x, t, concepts, weights), noise, model.alpha_bar, 100, TEMPERATURE)

    single = timed(one_at_a_time)[1] / singles * 500
    draws = [generator("cpu", task) for task in range(10)]
    _, batch = timed(lambda: model.sample([Composition(concepts, weights)] * 10, 50, SAMPLING, draws))
    _, generation = timed(lambda: domain.source(None).split("train", 920, 0))

    found: dict[str, dict[str, object]] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "capability": torch.backends.cpu.get_cpu_capability(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
        },
        "seconds": {
            f"published inversion, one concept{'' if options.full else ' (scaled from a slice)'}": round(published, 1),
            "our inversion, one concept": round(one, 1),
            "our inversion, ten concepts": round(ten, 1),
            "sampling 500 states one at a time (scaled)": round(single, 1),
            "sampling 500 states in one batch": round(batch, 2),
            "drawing the training set": round(generation, 2),
        },
        "ratio": {
            "inversion, one concept": round(published / one, 1),
            "inversion, ten concepts": round(10 * published / ten, 1),
            "sampling": round(single / batch, 1),
        },
    }
    if options.full:
        found["accuracy"] = {
            "task": task,
            "published inversion": accuracy(model, task, theirs, their_weights),
            "our inversion": accuracy(model, task, ours.embeddings, ours.weights),
        }
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
