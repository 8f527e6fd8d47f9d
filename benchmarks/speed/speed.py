"""Speed-up of batched inversion and sampling over the published procedure, each ratio measured in a single run.

    python benchmarks/speed/speed.py [--pretrained pretrained/object_rearrangement] [--out results/speed.json] [--full]

The published inversion processes single noised demonstrations, accumulates two, and evaluates the K + 1 branches sequentially, for
5 x 10,000 optimiser steps per concept. A slice of its steps is timed and scaled up. Its accuracy by number of steps is computed
by the same arithmetic for all concepts in a batch, without timing. ``--full`` also runs it to its end for a single concept and
takes the time of a step from that run.

Ours learns with the shipped settings: nine concepts of the validation suite one at a time (mean), and ten together. Accuracy is the
mean over the nine; rings are excluded, as a single set of embeddings does not represent them.
"""

import argparse
import functools
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median
from typing import Any, TypeVar

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import ACCURACY
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import denoising_loss
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.samplers import Sampling, ddpm
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.reporting.measurements import ONE, PUBLISHED, TEN, Measured, reached
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import read_model

DOMAIN, SUITE = "object_rearrangement", "validation"
PUBLISHED_STEPS = 50_000
PUBLISHED_AT = (200, 500, 1000, 1500, 2000, 3000, 4000, 6000, 8000, 11_000, 15_000, 20_000, 28_000, 38_000, PUBLISHED_STEPS)
"""Steps after which the published procedure is judged."""
OURS_AT = (10, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 400)
"""Steps after which ours is."""
ACCUMULATED = 2
"""Noised demonstrations of a step of the published procedure, one after another."""
K, OMEGA = 2, 1.2
SAMPLES = 50
"""Plans of each concept that are judged."""
SAMPLING = Sampling("ddpm", 100, 0.1)

Result = TypeVar("Result")


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """A result, and the seconds it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def branch_by_branch(model: GenerativeModel, x: Tensor, t: Tensor, concepts: Tensor, weights: Tensor) -> Tensor:
    """Eq. 2 as the published code evaluates it: one call of the network for each branch."""
    empty: Tensor = model.denoiser(x, t, model.empty[None, None], torch.zeros_like(t))
    total = empty
    for concept, weight in zip(concepts, weights, strict=True):
        total = total + weight * (model.denoiser(x, t, concept[None, None], torch.zeros_like(t)) - empty)
    return total


def drawn(model: GenerativeModel, states: Tensor, draw: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """What is random in a step of the published procedure for one concept.

    Args:
        model: whose timesteps they are.
        states: of its demonstrations ``(demo, horizon, state)``, normalised.
        draw: of all of it.

    Returns:
        Demonstrations ``(ACCUMULATED, horizon, state)``, timesteps ``(ACCUMULATED,)`` and noise like the first.
    """
    clean = states[torch.randint(len(states), (ACCUMULATED,), generator=draw)]
    t = torch.randint(len(model.alpha_bar), (ACCUMULATED,), generator=draw)
    return clean, t, torch.randn(clean.shape, generator=draw)


def published(model: GenerativeModel, demonstrations: Tensor, steps: int, draw: torch.Generator) -> Composition:
    """What the published procedure has learned of one concept after so many optimiser steps.

    Args:
        model: frozen.
        demonstrations: ``(demo, horizon, state)`` in the domain's units.
        steps: of the optimiser.
        draw: of the start, demonstrations, timesteps and noise.
    """
    states = model.normalization.encode(demonstrations)
    concepts = torch.randn(K, model.config.concept_dim, generator=draw).requires_grad_()
    weights = torch.full((K,), OMEGA)
    optimiser = torch.optim.Adam([concepts], lr=2e-4)
    for _ in range(steps):
        optimiser.zero_grad()
        for clean, t, noise in zip(*(part.split(1) for part in drawn(model, states, draw)), strict=True):
            loss = denoising_loss(lambda x, t: branch_by_branch(model, x, t, concepts, weights), clean, noise, t, model.alpha_bar)
            (loss.mean() / ACCUMULATED).backward()
        optimiser.step()
    return Composition(concepts.detach()[:, None], weights)


def published_together(
    model: GenerativeModel, demonstrations: Sequence[Tensor], draws: Sequence[torch.Generator], at: Sequence[int]
) -> dict[int, list[Composition]]:
    """What :func:`published` learns of several concepts after so many steps, from the same draws and by the same arithmetic in one
    batch, up to rounding.

    Args:
        model: frozen.
        demonstrations: of each concept ``(demo, horizon, state)``.
        draws: of each.
        at: numbers of steps, rising.
    """
    states = [model.normalization.encode(own) for own in demonstrations]
    starts = [torch.randn(K, model.config.concept_dim, generator=draw) for draw in draws]
    concepts = torch.stack(starts)[:, :, None].requires_grad_()
    weights = torch.full((len(starts), K), OMEGA)
    together = Composition(concepts, weights)
    optimiser = torch.optim.Adam([concepts], lr=2e-4)
    found = {}
    with bar("published procedure, all concepts", at[-1]) as advance:
        for step in range(1, at[-1] + 1):
            parts = [drawn(model, own, draw) for own, draw in zip(states, draws, strict=True)]
            clean, t, noise = (torch.cat(part) for part in zip(*parts, strict=True))
            losses = denoising_loss(
                lambda x, t: composed_epsilon(model.denoiser, x, t, together, model.empty), clean, noise, t, model.alpha_bar
            )
            optimiser.zero_grad()
            (losses.sum() / ACCUMULATED).backward()
            optimiser.step()
            advance()
            if step in at:
                found[step] = [Composition(own, weight) for own, weight in zip(concepts.detach().clone(), weights, strict=True)]
    return found


@dataclass(frozen=True)
class Judge:
    """Judges what was learned.

    Attributes:
        model: that plans are generated with.
        tasks: names of the concepts that are judged.
    """

    model: GenerativeModel
    tasks: tuple[str, ...]

    def accuracy(self, learned: Mapping[str, Composition]) -> float:
        """Share of :data:`SAMPLES` plans of each concept that show it, mean over the concepts."""
        draws = [generator("cpu", 0, task_key(task)) for task in self.tasks]
        plans = self.model.sample([learned[task] for task in self.tasks], SAMPLES, SAMPLING, draws)
        metric = self.model.domain.metrics[ACCURACY].measure
        return mean(float(metric(task, own, None).float().mean()) for task, own in zip(self.tasks, plans, strict=True))


def ours(
    model: GenerativeModel,
    groups: Sequence[Demonstrations],
    settings: InversionSettings,
    steps: int,
    repeats: int,
) -> tuple[dict[str, Composition], float, float]:
    """What ``invert`` learns in so many steps or, with a tolerance, less.

    Args:
        model: frozen.
        groups: demonstrations of the concepts that are learned together.
        settings: how.
        steps: at most.
        repeats: runs, of whose times the median is told.

    Returns:
        Every concept's composition by its name, the mean number of steps of a group, and the mean seconds.
    """
    found: dict[str, Composition] = {}
    made, seconds = [], []
    for group in groups:
        losses: list[float] = []
        runs = [timed(functools.partial(invert, model, group, settings, steps, losses.append)) for _ in range(repeats)]
        found |= {name: concept.composition for name, concept in runs[0][0].items()}
        made.append(len(losses) / repeats)
        seconds.append(median(one for _, one in runs))
    return found, mean(made), mean(seconds)


def our_curve(
    name: str, judge: Judge, groups: Sequence[Demonstrations], settings: InversionSettings, most: int, repeats: int
) -> list[Measured]:
    """Accuracy and seconds of ours after some numbers of steps, and at its end."""
    curve: list[Measured] = []
    at = [steps for steps in OURS_AT if steps < most] + [most]
    with bar(name, len(at)) as advance:
        for steps in at:
            learned, made, seconds = ours(judge.model, groups, settings, steps, repeats)
            if curve and round(made, 1) == curve[-1].steps:  # all have stopped before
                break
            curve.append(Measured(name, round(made, 1), round(seconds, 4), round(judge.accuracy(learned), 4)))
            advance(1, f"{steps} steps")
    return curve


def sampling(model: GenerativeModel, singles: int = 3) -> tuple[float, float]:
    """Seconds of 500 plans with K = 2: one at a time, scaled from ``singles``, and in one batch."""
    concepts, weights = model.training_embeddings[:K], torch.full((K,), OMEGA)
    shape = (1, model.config.horizon, model.config.state_dim)

    def one_at_a_time() -> None:
        for seed in range(singles):
            noise = functools.partial(torch.randn, shape, generator=generator("cpu", seed))
            ddpm(lambda x, t: branch_by_branch(model, x, t, concepts, weights), noise, model.alpha_bar, 100, SAMPLING.temperature)

    single = timed(torch.no_grad()(one_at_a_time))[1] / singles * 500
    draws = [generator("cpu", task) for task in range(10)]
    return single, timed(lambda: model.sample([Composition(concepts[:, None], weights)] * 10, 50, SAMPLING, draws))[1]


def ratios(curves: Mapping[str, Sequence[Measured]]) -> dict[str, Any]:
    """How many times as long the published procedure takes for the same number of concepts: to the end, and until it first
    reaches the accuracy that both reach.
    """
    target = reached(curves)
    found: dict[str, Any] = {"to equal accuracy": {"accuracy": round(target, 4)}, "ratio": {}}
    theirs = curves[PUBLISHED]
    for name, own in curves.items():
        first = next(point for point in own if point.accuracy >= target)
        found["to equal accuracy"][name] = {"steps": first.steps, "seconds": first.seconds}
        if name == PUBLISHED:
            continue
        count = 10 if name == TEN else 1
        theirs_first = next(point for point in theirs if point.accuracy >= target)
        found["ratio"][f"{name}, to the end"] = round(count * theirs[-1].seconds / own[-1].seconds, 1)
        found["ratio"][f"{name}, to equal accuracy"] = round(count * theirs_first.seconds / first.seconds, 1)
    return found


def main() -> None:
    """Everything, one after another."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default=f"pretrained/{DOMAIN}")
    parser.add_argument("--config", default=f"conf/{DOMAIN}.yaml", help="of invert, whose settings ours learns with")
    parser.add_argument("--out", default="results/speed.json")
    parser.add_argument("--steps", type=int, help="of our inversion, at most, in place of the configuration's")
    parser.add_argument("--tolerance", type=float, help="likewise")
    parser.add_argument("--samples", type=int, help="likewise")
    parser.add_argument("--seed", type=int, default=0, help="of demonstrations and learning")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs of ours, whose median is told")
    parser.add_argument("--slice", type=int, default=300, help="timed steps of the published inversion")
    parser.add_argument("--learned", help="an earlier run's file to take from what the published procedure has learned by then")
    parser.add_argument("--full", action="store_true", help="run the published inversion of one concept to its end")
    options = parser.parse_args()
    model, tuned = read_model(GenerativeModel, options.pretrained), ModelSettings.read(options.config)
    changes = {key: value for key in ("tolerance", "samples") if (value := getattr(options, key)) is not None}
    settings = tuned.inversion.changed(seed=options.seed, modes=1, **changes)
    most = options.steps or tuned.learning_steps
    domain = load_domain(model.config.domain)
    suite = domain.concepts.suites[SUITE]
    judged = tuple(name for name in suite.learned if "right of" in name or "above" in name or "antidiagonal" in name)
    ring = next(name for name in suite.learned if name not in judged)
    judge = Judge(model, judged)
    data = InversionData(domain.name, suite=SUITE, seed=options.seed).demonstrations
    alone = [data.select(name) for name in judged]
    together = [concatenate([*alone, data.select(ring)])]

    # First, since torch loads much when it is first used.
    curves: dict[str, list[Measured]] = {}
    states = [own.states for own in alone]
    if options.learned:
        known = json.loads(Path(options.learned).read_text(encoding="utf-8"))["curves"]
        accuracies = {point["steps"]: point["accuracy"] for point in known if point["curve"] == PUBLISHED}
    else:
        learned = published_together(model, states, [_draw(options.seed, name) for name in judged], PUBLISHED_AT)
        accuracies = {at: round(judge.accuracy(dict(zip(judged, own, strict=True))), 4) for at, own in learned.items()}
    published(model, states[0], 20, _draw(options.seed, judged[0]))
    steps = PUBLISHED_STEPS if options.full else options.slice
    first, duration = timed(lambda: published(model, states[0], steps, _draw(options.seed, judged[0])))
    curves[PUBLISHED] = [Measured(PUBLISHED, at, round(duration / steps * at, 2), accuracy) for at, accuracy in accuracies.items()]
    ours(model, alone[:1], settings, 10, 1)
    curves[ONE] = our_curve(ONE, judge, alone, settings, most, options.repeats)
    curves[TEN] = our_curve(TEN, judge, together, settings, most, options.repeats)
    single, batch = sampling(model)
    _, generation = timed(lambda: domain.source(None).split("train", 920, 0))
    compared = ratios(curves)
    found: dict[str, Any] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "capability": torch.backends.cpu.get_cpu_capability(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
        },
        "settings": {
            "samples": settings.budget.samples,
            "tolerance": settings.budget.tolerance,
            "steps": most,
            "seed": options.seed,
        },
        "seconds": {
            f"{PUBLISHED}{'' if options.full else f' (scaled from {steps} steps)'}": round(curves[PUBLISHED][-1].seconds, 1),
            ONE: round(curves[ONE][-1].seconds, 3),
            TEN: round(curves[TEN][-1].seconds, 3),
            "sampling 500 states one at a time (scaled)": round(single, 1),
            "sampling 500 states in one batch": round(batch, 2),
            "drawing the training set": round(generation, 2),
        },
        "to equal accuracy": compared["to equal accuracy"],
        "ratio": compared["ratio"] | {"sampling": round(single / batch, 1)},
        "curves": [asdict(point) for curve in curves.values() for point in curve],
    }
    if options.full:
        one = Judge(model, judged[:1])
        found["run to its end"] = {"task": judged[0], "accuracy": one.accuracy({judged[0]: first})}
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


def _draw(seed: int, concept: str) -> torch.Generator:
    return generator("cpu", seed, 4, task_key(concept))


if __name__ == "__main__":
    main()
