"""Run time of inversion and sampling against ``diffusers`` with the same network and work, in a single run.

    python benchmarks/speed/peers.py [--pretrained pretrained/object_rearrangement] [--out results/peers.json]

Theirs is written as a user of ``diffusers`` would write it: its schedulers, its learning-rate schedule, the loop of its textual
inversion (a table of embeddings of which all rows but the new ones are put back after each step; AdamW), and guidance by one batch
of all branches, in which every plan brings its own embedding. The network is ours with its weights. The loss is Eq. 2, so that both
learn the same.

*One by one*, as in its examples: plans of a concept are sampled one after another, and learning accumulates gradients of single
noised demonstrations. *Batched* by hand: all plans of a concept, or of all concepts, at once, and all noised demonstrations of a
step; for sampling also with the concept's features computed once instead of for every plan, which changes the network's interface.

*Few steps*: DPM-Solver++ of both with the same number of steps. Equal noise gives equal plans with DDPM and DDIM, and learned
concepts have equal losses on common noise; both are in the file. CleanDiffuser is not compared, as it has no release on PyPI.

*With LoRA*: adapters of the same rank on the same weights, with the same loss; theirs by ``peft``, with a copy of the network and
textual inversion for each concept.

One thread; seconds are of processor time, medians of calls that alternate between the candidates, in both orders, with the smallest
and the largest.
"""

import argparse
import copy
import functools
import importlib.metadata
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from diffusers.optimization import get_scheduler
from peft import LoraConfig, inject_adapter_in_model
from peft.tuners.tuners_utils import BaseTunerLayer
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import InversionSettings, Loss
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import read_model

Batching = Literal["one by one", "batched"]
CONCEPTS, PLANS, DENOISING, K, GUIDANCE = 10, 50, 100, 2, 1.2
LEARNING_RATE = 0.1
"""Of ours and of theirs."""
RANK, RATE = 4, 1e-3
"""Rank and learning rate of adapters."""
FEW = 10
"""Steps of the few-step samplers."""
SINGLES, SLICE = 3, 3
"""Plans, and steps of learning, that are timed of what goes one by one, and scaled up."""
JUDGED = 512
"""Noised demonstrations on which learned concepts are compared."""


class Conditional(nn.Module):
    """Our network under the interface of those of ``diffusers``.

    Args:
        model: whose network it is; nothing is observed in its domain.
    """

    def __init__(self, model: GenerativeModel) -> None:
        super().__init__()
        self.network = model.denoiser

    def forward(self, sample: Tensor, timestep: Tensor, encoder_hidden_states: Tensor) -> SimpleNamespace:
        """``sample (batch, horizon, state)``, ``timestep`` one for all or ``(batch,)``, an embedding of each ``(batch, n)``."""
        own = torch.arange(len(sample))
        return SimpleNamespace(sample=self.network(sample, timestep.expand(len(sample)), encoder_hidden_states[:, None], own))


class Shared(Conditional):
    """The same where plans of a concept share what it makes: embeddings ``(concept, n)``, equally many plans of each in turn."""

    def forward(self, sample: Tensor, timestep: Tensor, encoder_hidden_states: Tensor) -> SimpleNamespace:
        own = torch.arange(len(encoder_hidden_states)).repeat_interleave(len(sample) // len(encoder_hidden_states))
        return SimpleNamespace(sample=self.network(sample, timestep.expand(len(sample)), encoder_hidden_states[:, None], own))


def ddpm_scheduler(model: GenerativeModel) -> Any:
    """Of ``diffusers``, with the schedule of the model."""
    return DDPMScheduler(len(model.alpha_bar), beta_schedule="squaredcos_cap_v2", clip_sample=True)


def ddim_scheduler(model: GenerativeModel) -> Any:
    """Likewise."""
    return DDIMScheduler(
        len(model.alpha_bar), beta_schedule="squaredcos_cap_v2", clip_sample=True, set_alpha_to_one=True, timestep_spacing="leading"
    )


def solver_scheduler(model: GenerativeModel) -> Any:
    """DPM-Solver++ of second order."""
    return DPMSolverMultistepScheduler(len(model.alpha_bar), beta_schedule="squaredcos_cap_v2", timestep_spacing="linspace")


def guided(estimates: Tensor, weight: float) -> Tensor:
    """Classifier-free guidance by several concepts: ``(branch * plan, ...)`` of the empty one and K others, one after another."""
    empty, *conditional = estimates.chunk(1 + K)
    return empty + weight * sum((own - empty for own in conditional), torch.zeros_like(empty))


@torch.no_grad()
def their_plans(
    network: Conditional, scheduler: Any, embeddings: Tensor, draw: torch.Generator, count: int, shape: tuple[int, int]
) -> Tensor:
    """Plans of one or several concepts in a loop of a scheduler.

    Args:
        network: under its interface.
        scheduler: with the model's schedule.
        embeddings: ``(branch, concept, n)``, the empty one first.
        draw: of all noise.
        count: of each concept's plans.
        shape: of a plan ``(horizon, state)``.

    Returns:
        ``(concept * count, horizon, state)``, normalised.
    """
    few = isinstance(scheduler, DPMSolverMultistepScheduler)
    scheduler.set_timesteps(FEW if few else DENOISING)
    latents = torch.randn((embeddings.shape[1] * count, *shape), generator=draw) * scheduler.init_noise_sigma
    prompts = (embeddings if isinstance(network, Shared) else embeddings.repeat_interleave(count, dim=1)).flatten(0, 1)
    # DDIM's noise has to follow from the clean plan after it is clipped, as with us.
    options: dict[str, Any] = {"generator": draw} if isinstance(scheduler, DDPMScheduler) else {"use_clipped_model_output": True}
    options = {} if few else options
    for t in scheduler.timesteps:
        inputs = scheduler.scale_model_input(torch.cat([latents] * len(embeddings)), t)
        estimate = guided(network(inputs, t, encoder_hidden_states=prompts).sample, GUIDANCE)
        latents = scheduler.step(estimate, t, latents, **options).prev_sample
    return latents


def their_concept(
    model: GenerativeModel,
    demonstrations: Tensor,
    samples: int,
    steps: int,
    batching: Batching,
    draw: torch.Generator,
    rank: int = 0,
) -> Composition:
    """Textual inversion of K new rows of the table of embeddings; with a rank, also LoRA in the conditional branches.

    Args:
        model: frozen.
        demonstrations: of the concept ``(demo, horizon, state)``, normalised.
        samples: noised demonstrations a step.
        steps: of the optimiser.
        batching: whether they are one batch or accumulated.
        draw: of start, demonstrations, noise and timesteps.
        rank: of adapters of all linear layers; 0 for none.
    """
    network, scheduler = Conditional(model), ddpm_scheduler(model)
    factors: list[nn.Parameter] = []
    if rank:
        network.network = copy.deepcopy(model.denoiser)
        linear = [name for name, layer in network.network.named_modules() if isinstance(layer, nn.Linear)]
        inject_adapter_in_model(LoraConfig(r=rank, lora_alpha=rank, target_modules=linear), network.network)
        factors = [parameter for parameter in network.network.parameters() if parameter.requires_grad]
    known = torch.cat((model.empty[None], model.training_embeddings))
    start = 0.05 * torch.randn(K, known.shape[1], generator=draw)
    table = nn.Embedding.from_pretrained(torch.cat((known, start)), freeze=False)
    original = table.weight.detach().clone()
    kept = torch.arange(len(original)) < len(known)
    groups: list[dict[str, Any]] = [{"params": [*table.parameters()]}, *([{"params": factors, "lr": RATE}] if rank else [])]
    optimiser = torch.optim.AdamW(groups, lr=LEARNING_RATE, weight_decay=0.0)
    rate = get_scheduler("cosine", optimizer=optimiser, num_warmup_steps=0, num_training_steps=steps)
    size = samples if batching == "batched" else 1
    for _ in range(steps):
        for _ in range(samples // size):
            clean = demonstrations[torch.randint(len(demonstrations), (size,), generator=draw)]
            noise = torch.randn(clean.shape, generator=draw)
            t = torch.randint(scheduler.config["num_train_timesteps"], (size,), generator=draw)
            noisy = scheduler.add_noise(clean, noise, t)
            tokens = torch.tensor([0, *range(len(known), len(original))]).repeat_interleave(size)
            if rank:
                adapt(network, False)
                with torch.no_grad():
                    unconditional = network(noisy, t, encoder_hidden_states=table(tokens[:size])).sample
                adapt(network, True)
                conditional = network(torch.cat([noisy] * K), t.repeat(K), encoder_hidden_states=table(tokens[size:])).sample
                estimates = torch.cat((unconditional, conditional))
            else:
                estimates = network(torch.cat([noisy] * (1 + K)), t.repeat(1 + K), encoder_hidden_states=table(tokens)).sample
            loss = functional.mse_loss(guided(estimates, GUIDANCE), noise, reduction="mean")
            (loss * size / samples).backward()
        optimiser.step()
        rate.step()
        optimiser.zero_grad()
        with torch.no_grad():
            table.weight[kept] = original[kept]
    return Composition(table.weight.detach()[-K:, None].clone(), torch.full((K,), GUIDANCE))


def adapt(network: nn.Module, enabled: bool) -> None:
    """Switch the adapters of ``peft`` on or off."""
    for layer in network.modules():
        if isinstance(layer, BaseTunerLayer):
            layer.enable_adapters(enabled)


@torch.no_grad()
def loss_of(model: GenerativeModel, own: Demonstrations, learned: Composition) -> float:
    """Eq. 2 of a concept on noise that is the same for all."""
    rows = torch.arange(JUDGED) % len(own)
    together = Composition(learned.embeddings[None], learned.weights[None])
    draws = model.draws(JUDGED, 1.0, generator("cpu", 7))
    return float(model.losses(own.states[rows], {}, together, draws, Loss()).mean())


class Timed(NamedTuple):
    """Median, smallest and largest seconds of some calls."""

    median: float
    least: float
    most: float

    def times(self, factor: float) -> "Timed":
        """Scaled up."""
        return Timed(*(factor * value for value in self))


@dataclass(frozen=True)
class Work:
    """What both do.

    Attributes:
        model: whose network it is.
        concepts: demonstrations of each.
        settings: of our inversion.
        steps: of learning.
        repeats: timed calls of each.
    """

    model: GenerativeModel
    concepts: Sequence[Demonstrations]
    settings: InversionSettings
    steps: int
    repeats: int

    def seconds(self, works: Mapping[str, Callable[[], Any]], repeats: int | None = None) -> dict[str, Timed]:
        """Processor seconds of each, after a call that is not timed, alternating."""
        calls: dict[str, list[float]] = {name: [] for name in works}
        for turn in range(1 + (repeats or self.repeats)):
            for name in list(works) if turn % 2 else reversed(list(works)):
                start = time.process_time()
                works[name]()
                if turn:
                    calls[name].append(time.process_time() - start)
        return {name: Timed(median(each), min(each), max(each)) for name, each in calls.items()}

    @functools.cached_property
    def compositions(self) -> list[Composition]:
        """What plans are made of: training concepts in pairs."""
        known, count = self.model.training_embeddings, len(self.model.training_embeddings)
        pairs = [known[[index % count, (index + 1 + index // count) % count]] for index in range(len(self.concepts))]
        return [Composition(pair[:, None], torch.full((K,), GUIDANCE)) for pair in pairs]

    @property
    def shape(self) -> tuple[int, int]:
        """Of a plan."""
        return self.model.config.horizon, self.model.config.state_dim

    def branches(self, chosen: Sequence[Composition]) -> Tensor:
        """Embeddings of the empty and all other branches ``(branch, concept, n)``."""
        own = torch.stack([composition.embeddings[:, 0] for composition in chosen], dim=1)
        return torch.cat((self.model.empty.expand(1, len(chosen), -1), own))

    def ours(self, sampler: str = "ddpm", chosen: Sequence[Composition] | None = None, steps: int = DENOISING) -> Tensor:
        """Our plans ``(concept, plan, horizon, state)``."""
        chosen = self.compositions if chosen is None else chosen
        draws = [generator("cpu", 3, index) for index in range(len(chosen))]
        return self.model.sample(chosen, PLANS, Sampling(sampler, steps, 1.0), draws)


def equality(work: Work) -> dict[str, float]:
    """Largest difference of plans from the same noise, in units of the range that the data fill, for each sampler."""
    found = {}
    for name, scheduler in (("ddpm", ddpm_scheduler(work.model)), ("ddim", ddim_scheduler(work.model))):
        chosen = work.compositions[:1]
        theirs = their_plans(Conditional(work.model), scheduler, work.branches(chosen), generator("cpu", 3, 0), PLANS, work.shape)
        own, theirs = (work.model.encode(plans, {}) for plans in (work.ours(name, chosen)[0], work.model.decode(theirs, {})))
        found[name] = float((own - theirs).abs().max()) / 2
    return found


def sampling(work: Work) -> dict[str, Timed]:
    """Seconds of all plans of all concepts."""
    scheduler, solver, chosen = ddpm_scheduler(work.model), solver_scheduler(work.model), work.compositions
    plain, shared = Conditional(work.model), Shared(work.model)

    def theirs(network: Conditional, some: Sequence[Composition], count: int = PLANS, by: Any = scheduler) -> Tensor:
        return their_plans(network, by, work.branches(some), generator("cpu", 3), count, work.shape)

    single = "theirs, as its examples do (scaled)"
    one = work.seconds({single: lambda: theirs(plain, chosen[:1], 1)}, SINGLES)[single]
    return {
        **work.seconds(
            {
                "ours": work.ours,
                "theirs, batched, a concept after another": lambda: [theirs(plain, [each]) for each in chosen],
                "theirs, batched, all concepts at once": lambda: theirs(plain, chosen),
                "theirs, batched, all at once, concepts computed once": lambda: theirs(shared, chosen),
                "ours, few steps": lambda: work.ours("dpm_solver", steps=FEW),
                "theirs, few steps, all at once, concepts computed once": lambda: theirs(shared, chosen, by=solver),
            }
        ),
        single: one.times(PLANS * len(chosen)),
    }


def learning(work: Work) -> tuple[dict[str, Timed], dict[str, Any]]:
    """Seconds of learning all concepts and one, and the losses of what was learned."""
    model, samples = work.model, work.settings.budget.samples
    normalised = [model.encode(own.states, {}) for own in work.concepts]
    every = concatenate(work.concepts)

    def theirs(index: int, steps: int, batching: Batching, rank: int = 0) -> Composition:
        return their_concept(model, normalised[index], samples, steps, batching, generator("cpu", 5, index), rank)

    def all_of_theirs() -> list[Composition]:
        return [theirs(index, work.steps, "batched") for index in range(len(normalised))]

    adapted = work.settings.changed(adapter=RANK, adapter_learning_rate=RATE)
    own = invert(model, every, work.settings, work.steps)
    other = all_of_theirs()
    losses = {
        name: (loss_of(model, one, found.composition), loss_of(model, one, composition))
        for (name, found), one, composition in zip(own.items(), work.concepts, other, strict=True)
    }
    seconds = work.seconds(
        {
            "ours, together": lambda: invert(model, every, work.settings, work.steps),
            "ours, one": lambda: invert(model, work.concepts[0], work.settings, work.steps),
            "theirs, batched, a concept after another": all_of_theirs,
            "theirs, batched, one": lambda: theirs(0, work.steps, "batched"),
            "ours, with LoRA, together": lambda: invert(model, every, adapted, work.steps),
            "theirs, with LoRA, a concept after another": lambda: [
                theirs(index, work.steps, "batched", RANK) for index in range(len(normalised))
            ],
        }
    )
    single = "theirs, as its examples do, one (scaled)"
    seconds[single] = work.seconds({single: lambda: theirs(0, SLICE, "one by one")}, 1)[single].times(work.steps / SLICE)
    seconds["theirs, as its examples do (scaled)"] = seconds[single].times(len(normalised))
    losses_of = {
        "ours, mean": round(mean(one for one, _ in losses.values()), 5),
        "theirs, mean": round(mean(one for _, one in losses.values()), 5),
        "ours over theirs, largest": round(max(one / another for one, another in losses.values()), 4),
    }
    return seconds, losses_of


def ours_like(name: str) -> str:
    """Our measurement beside one of theirs."""
    return "ours, with LoRA, together" if "LoRA" in name else "ours, one" if ", one" in name else "ours, together"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/object_rearrangement")
    parser.add_argument("--config", default="conf/object_rearrangement.yaml")
    parser.add_argument("--out", default="results/peers.json")
    parser.add_argument("--steps", type=int, default=100, help="of learning")
    parser.add_argument("--concepts", type=int, default=CONCEPTS)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    load = os.getloadavg()[0]
    model = read_model(GenerativeModel, options.pretrained)
    data = InversionData(model.config.domain, suite="validation", seed=0).demonstrations
    names = list(dict.fromkeys(data.concepts))[: options.concepts]
    tuned = ModelSettings.read(options.config).inversion
    settings = tuned.changed(tolerance=None, omega=GUIDANCE, components=K, learning_rate=LEARNING_RATE)
    work = Work(model, [data.select(name) for name in names], settings, options.steps, options.repeats)
    found: dict[str, Any] = {
        "machine": {
            "capability": torch.backends.cpu.get_cpu_capability(),
            "threads": 1,
            "torch": torch.__version__,
            **{name: importlib.metadata.version(name) for name in ("diffusers", "peft")},
        },
        "work": {
            "concepts": len(names),
            "K": K,
            "plans of each": PLANS,
            "denoising steps": DENOISING,
            "steps of learning": options.steps,
            "noised demonstrations a step": settings.budget.samples,
        },
    }
    with bar("beside diffusers", 3) as advance:
        found["same noise, largest difference of plans"] = equality(work)
        advance()
        generation = sampling(work)
        advance()
        inversion, found["loss of learned concepts"] = learning(work)
        advance()
    found["sampling, seconds"] = {name: [round(value, 3) for value in timed] for name, timed in generation.items()}
    found["learning, seconds"] = {name: [round(value, 3) for value in timed] for name, timed in inversion.items()}
    found["ratio"] = {
        "sampling": {
            name: round(timed.median / generation["ours, few steps" if "few" in name else "ours"].median, 2)
            for name, timed in generation.items()
            if "theirs" in name
        },
        "learning": {
            name: round(timed.median / inversion[ours_like(name)].median, 2)
            for name, timed in inversion.items()
            if "theirs" in name
        },
    }
    found["load"] = [round(load, 2), round(os.getloadavg()[0], 2)]
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
