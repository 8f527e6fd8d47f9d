"""Steps of pretraining, inversion and sampling of any denoiser, to be counted or timed: published sizes and others.

A step is what the network, its loss and the optimiser compute. Drawing windows, perturbing presents, judging held-out noise and
logging are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from ftl_lightning.few_shot.tuned import ModelSettings, settings_of
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import add_noise, clean_from_epsilon, cosine_alpha_bar, denoising_loss
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.optimizer import Adam
from ftl_lightning.igm.samplers import sampler_timesteps
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel, build_denoiser
from ftl_lightning.networks import PAPER_SIZE
from ftl_lightning.networks.image_encoder import RESNET18, ImageEncoders
from ftl_lightning.training.model_folder import read_model

ROOT = Path(__file__).parents[2]
DOMAINS = ("object_rearrangement", "agent", "driving", "mocap", "tabletop", "strokes")
FLAN = 768
"""Columns of the paper's text encoder, flan-t5-base."""
FORM = {"width": 128, "multipliers": (1, 2, 4, 8)}
"""The paper's temporal U-Net, that of Ajay et al. (2023)."""
PAPER_BATCH, PAPER_STEPS = 32, 1_000_000
"""Of pretraining, those of Ajay et al. (2023), whose hyperparameters the paper takes over."""
PAPER_INVERSION, ACCUMULATED = 50_000, 2
"""Steps of the published inversion of a concept, and noised demonstrations of each, one after another."""
FLOAT = 4

Kind = Literal["pretraining", "inversion", "sampling", "published inversion"]


@dataclass(frozen=True)
class Step:
    """What is computed at once.

    Attributes:
        kind: of the step; the published inversion evaluates branches one after another, as often as its demonstrations
            accumulate.
        config: of the network.
        batch: windows of a step of pretraining, noised demonstrations or plans of each concept in the others.
        concepts: learned or sampled together.
        components: K.
        knots: of each embedding.
        looked_at: share of the windows whose images are looked at.
    """

    kind: Kind
    config: DiffusionConfig
    batch: int
    concepts: int = 1
    components: int = 2
    knots: int = 1
    looked_at: float = 1.0


@dataclass(frozen=True)
class Made:
    """A step that can be run as often as one likes.

    Attributes:
        compute: forward and backward.
        update: the optimiser.
        parameters: of the networks.
        learned: how many numbers are learned.
        averaged: whether a running average is kept of them.
    """

    compute: Callable[[], None]
    update: Callable[[], None]
    parameters: tuple[Tensor, ...]
    learned: int
    averaged: bool

    def __call__(self) -> None:
        """One step."""
        self.compute()
        self.update()

    @property
    def updated(self) -> int:
        """Bytes that the optimiser moves: number, gradient and two moments in, number and moments out; and those of the average."""
        return (7 + 3 * self.averaged) * FLOAT * self.learned

    @property
    def resident(self) -> dict[str, int]:
        """Bytes of parameters, and of gradients, moments and running averages."""
        held = FLOAT * sum(parameter.numel() for parameter in self.parameters)
        return {"parameters": held, "optimiser": (3 + self.averaged) * FLOAT * self.learned}


def on_paper(step: Step) -> Made:
    """A step that is only counted: without memory where its network allows that (the MLP looks at which timesteps are alike)."""
    return made(step, "cpu" if step.config.denoiser == "MLPDenoiser" else "meta")


def made(step: Step, device: str = "cpu") -> Made:
    """A step with random weights and data: cost does not depend on them."""
    config, together = step.config, step.concepts * step.batch
    with torch.device(device):
        network = build_denoiser(config)
        images = ImageEncoders(config.observed, config.image_encoder) if config.image_dim else None
        modules = nn.ModuleList([network, *([images] if images else [])]).to(device)  # constants are made on the processor
        alpha_bar = cosine_alpha_bar(config.diffusion_steps).to(device)
        clean, noise = (torch.randn(together, config.horizon, config.state_dim) for _ in range(2))
        spread = torch.arange(together) % step.batch * config.diffusion_steps // step.batch
        t = torch.full_like(spread, config.diffusion_steps // 2) if step.kind == "sampling" else spread
        vector = torch.randn(together, config.measured_dim)
        seen = max(1, round(step.looked_at * together)) if images else 0
        pictures = {
            name: torch.zeros(seen, *feature.shape, dtype=torch.uint8)
            for name, feature in config.observed.items()
            if feature.kind == "image"
        }
        told = torch.randn(together - seen, config.image_dim)
        empty, index = torch.randn(config.concept_dim), torch.arange(together)

    def observed() -> tuple[Tensor, ...]:
        if not config.observed:
            return ()
        read = [torch.cat((images(pictures), told))] if images else []
        found: tuple[Tensor, ...] = network.observe(torch.cat((vector, *read), dim=1))  # type: ignore[operator]
        return found

    parameters = tuple(modules.parameters())
    if step.kind == "pretraining":
        modules.train()
        average = [torch.zeros_like(parameter) for parameter in parameters]
        optimiser = torch.optim.AdamW(parameters, lr=0.0, fused=device != "meta")
        with torch.device(device):
            concepts = torch.randn(together if step.knots > 1 else 5, step.knots, config.concept_dim)
            index = index if step.knots > 1 else index % 5

        def fit() -> None:
            context = observed()
            losses = denoising_loss(lambda x, t: network(x, t, concepts, index, context), clean, noise, t, alpha_bar)
            optimiser.zero_grad()
            losses.mean().backward()

        def follow() -> None:
            optimiser.step()
            torch._foreach_lerp_(average, [parameter.detach() for parameter in parameters], 0.01)

        return Made(fit, follow, parameters, sum(parameter.numel() for parameter in parameters), True)
    modules.requires_grad_(False).eval()
    with torch.device(device):
        embeddings = nn.Parameter(torch.randn(step.concepts, step.components, step.knots, config.concept_dim))
        composition = Composition(embeddings, torch.ones(step.concepts, step.components))
    if step.kind == "sampling":
        context = observed()
        before, now = sampler_timesteps(config.diffusion_steps, 3)[:2]

        @torch.no_grad()
        def denoise() -> None:
            estimate = composed_epsilon(network, clean, t, composition, empty, context)
            x = clean_from_epsilon(clean, estimate, alpha_bar[now])
            torch.add(alpha_bar[before] * x, alpha_bar[now] * noise)

        return Made(denoise, lambda: None, parameters, 0, False)
    group = Adam(embeddings, 0.0)
    found: list[Tensor] = []

    def one_by_one() -> None:
        concept = embeddings[0]
        for _ in range(ACCUMULATED):
            context = observed()
            noisy = add_noise(clean, noise, alpha_bar[t])
            estimates = [network(noisy, t, one[None], torch.zeros_like(t), context) for one in (empty.expand(1, -1), *concept)]
            guided = estimates[0] + sum(estimate - estimates[0] for estimate in estimates[1:])
            found[:] = torch.autograd.grad((guided - noise).square().mean(), [embeddings])

    def invert() -> None:
        context = observed()
        losses = denoising_loss(
            lambda x, t: composed_epsilon(network, x, t, composition, empty, context), clean, noise, t, alpha_bar
        )
        found[:] = torch.autograd.grad(losses.sum() / step.batch, [embeddings])

    learn = one_by_one if step.kind == "published inversion" else invert
    return Made(learn, lambda: group.step(found[0], 0, None), parameters, embeddings.numel(), False)


@dataclass(frozen=True)
class Published:
    """A model that ships, or one of the paper's size.

    Attributes:
        domain: of :data:`DOMAINS`.
        form: ``'ours'`` or ``'the paper'``.
        pretraining, inversion, sampling: a step of each; inversion of one concept, sampling of 50 plans of one.
        pretraining_steps, learning_steps: how many; of inversion at most.
    """

    domain: str
    form: str
    pretraining: Step
    inversion: Step
    sampling: Step
    pretraining_steps: int
    learning_steps: int

    @property
    def name(self) -> str:
        return f"{self.domain}, {self.form}"


@cache
def ours(domain: str) -> Published:
    """A model that ships."""
    config = read_model(GenerativeModel, ROOT / "pretrained" / domain).config
    trained, tuned = config.training["model"], ModelSettings.read(ROOT / settings_of("own" if domain == "strokes" else domain))
    knots = int(trained.get("code_knots", 1)) if trained.get("code_share") else 1
    settings = tuned.inversion
    return Published(
        domain=domain,
        form="ours",
        pretraining=Step(
            "pretraining",
            config,
            int(config.training["data"]["batch_size"]),
            knots=knots,
            looked_at=1 - float(trained.get("told", 0.0)),
        ),
        inversion=Step(
            "inversion",
            config,
            settings.budget.samples,
            components=settings.components,
            knots=settings.embeddings.knots,
        ),
        sampling=Step("sampling", config, 50, components=settings.components, knots=settings.embeddings.knots),
        pretraining_steps=int(config.training["max_steps"]),
        learning_steps=tuned.learning_steps,
    )


@cache
def paper(domain: str) -> Published:
    """The same domain with the paper's network at its size, its text encoder, K, and numbers of steps.

    The published inversion takes one noised demonstration at a time and accumulates two.
    """
    config = ours(domain).pretraining.config
    flat = domain in ("object_rearrangement", "strokes")
    kind = "MLPDenoiser" if flat else "TemporalUNet"
    config = replace(
        config,
        denoiser=kind,
        denoiser_args=PAPER_SIZE[kind]
        if flat
        else {**FORM, "initial_encoder": "flat", "film": False, "broadcast": False, "clock": 0},
        concept_dim=FLAN,
        prediction="epsilon",
        plane=(),
    )
    if config.image_dim:
        encoder = {"network": RESNET18}
        with torch.device("meta"):
            config = replace(config, image_encoder=encoder, image_dim=ImageEncoders(config.observed, encoder).size)
    return Published(
        domain=domain,
        form="the paper",
        pretraining=Step("pretraining", config, PAPER_BATCH),
        inversion=Step("published inversion", config, 1),
        sampling=Step("sampling", config, 50),
        pretraining_steps=PAPER_STEPS,
        learning_steps=PAPER_INVERSION,
    )


def published() -> list[Published]:
    """All: the models that ship, and of the paper's five domains those of its size."""
    return [*map(ours, DOMAINS), *map(paper, DOMAINS[:5])]
