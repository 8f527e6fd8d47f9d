"""Model of our method: a conditional denoiser with its schedule, for learning and composing concepts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning import networks
from ftl_lightning.data.features import Observed
from ftl_lightning.igm.adapter import LowRank, adaptable
from ftl_lightning.igm.branches import Context
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.prediction import PREDICTIONS, Prediction, loss_weights
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.schedule import MOST_STEPS, cosine_alpha_bar, denoising_loss, timesteps
from ftl_lightning.methods.ftl_igm import METHOD
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.spectrum import Spectrum
from ftl_lightning.services.validation import check_range, from_mapping
from ftl_lightning.training.concept_model import Draws
from ftl_lightning.training.model_config import ModelConfig
from ftl_lightning.training.prepared import Prepared
from ftl_lightning.training.text_concept_model import TextConceptModel


@dataclass(frozen=True, kw_only=True)
class DiffusionConfig(ModelConfig):
    """Configuration of a diffusion model.

    Attributes:
        denoiser: name of a class of :mod:`ftl_lightning.networks`.
        denoiser_args: arguments of the denoiser other than the sizes.
        diffusion_steps: T.
        prediction: parametrisation of the output, ``'epsilon'`` (the paper's), ``'v'``, ``'clean'``, ``'displacement'`` or
            ``'cosines'``.
    """

    denoiser: str = "MLPDenoiser"
    denoiser_args: Mapping[str, Any] = field(default_factory=dict)
    diffusion_steps: int = 100
    prediction: str = "epsilon"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("diffusion_steps", self.diffusion_steps, 1, MOST_STEPS)


def build_denoiser(config: DiffusionConfig) -> nn.Module:
    """Build a denoiser of the configured class and size.

    Raises:
        UserError: for an unknown class or invalid arguments.
    """
    if config.denoiser not in networks.__all__:
        raise UserError(f"denoiser: expected one of {', '.join(networks.__all__)}, found {short(config.denoiser)!r}")
    if config.prediction not in PREDICTIONS:
        raise UserError(f"prediction: expected one of {', '.join(PREDICTIONS)}, found {short(config.prediction)!r}")
    if config.prediction in ("epsilon", "v") and config.denoiser_args.get("smooth"):
        raise UserError(f"denoiser_args.smooth: expected 0 for a network that puts out {config.prediction}, which is not smooth")
    kind: type[nn.Module] = getattr(networks, config.denoiser)
    if config.prediction == "cosines" and getattr(kind, "over_time", False):
        raise UserError(f"prediction: expected clean for {config.denoiser}, whose output is smooth by itself, found cosines")
    points = config.denoiser_args.get("initial_encoder") == "points"
    if points and config.image_dim and config.image_encoder.get("head") != "points":
        raise UserError("denoiser_args.initial_encoder: expected flat, found points: image_encoder.head reads no points")
    denoiser = from_mapping(kind, config.denoiser_args, "denoiser_args", config)
    if config.prediction == "epsilon":
        return denoiser
    if config.state_columns and len(config.state_columns) != config.state_dim:
        raise UserError(f"observed, state: expected {config.state_dim} columns, found {len(config.state_columns)}")
    spectrum = Spectrum(config.horizon, config.state_dim) if config.prediction == "cosines" else None
    return Prediction(denoiser, config.prediction, config.diffusion_steps, config.state_columns, spectrum)


class GenerativeModel(TextConceptModel):
    """Conditional diffusion model of plans.

    Args:
        prepared: configuration, domain and text embeddings.
    """

    method = METHOD
    invertible = True
    Config = DiffusionConfig
    config: DiffusionConfig
    denoiser: nn.Module
    alpha_bar: Tensor

    def __init__(self, prepared: Prepared[DiffusionConfig]) -> None:
        super().__init__(prepared)
        self.denoiser = build_denoiser(prepared.config)
        self.register_buffer("alpha_bar", cosine_alpha_bar(prepared.config.diffusion_steps))

    @property
    def traits(self) -> tuple[str, ...]:
        encoder = self.config.denoiser_args.get("initial_encoder")
        return (*super().traits, *([encoder] if encoder else []))

    @property
    def over_time(self) -> bool:
        over_time: bool = getattr(networks, self.config.denoiser).over_time
        return over_time

    def adaptable(self) -> dict[str, tuple[int, int]]:
        return adaptable(self.denoiser)

    def check_adapter(self, adapter: LowRank) -> None:
        adapter.check_fits(self.denoiser)

    @property
    def max_steps(self) -> int:
        return len(self.alpha_bar)

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws:
        """Draw noise and stratified timesteps ``T (1 - u^power)``, u uniform in [0, 1)."""
        device = draw.device
        spread = (torch.arange(samples, device=device) + torch.rand(samples, generator=draw, device=device)) / samples
        t = timesteps(spread, len(self.alpha_bar), timestep_power)[torch.randperm(samples, generator=draw, device=device)]
        return Draws(t, torch.randn((samples, self.config.horizon, self.config.state_dim), generator=draw, device=device))

    def observe(self, observed: Observed) -> Context:
        """Encode observed features once per plan."""
        context: Context = self.denoiser.observe(self.vector(observed))  # type: ignore[operator]
        return context

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        """Loss of Eq. 2 for every run and sample."""
        assert draws is not None
        runs, context = len(composition.embeddings), self.observe(observed)
        losses = denoising_loss(
            lambda x, t: composed_epsilon(self.denoiser, x, t, composition, self.empty, context),
            self.encode(states, observed),
            draws.noise.repeat(runs, 1, 1),
            draws.t.repeat(runs),
            self.alpha_bar,
        )
        return losses.unflatten(0, (runs, -1)) * loss_weights(loss, self.alpha_bar)[draws.t]

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        (together, row), seen = batched(compositions, count, generators), observed or {}
        context = self.observe(seen)

        def epsilon(x: Tensor, t: Tensor) -> Tensor:
            return composed_epsilon(self.denoiser, x, t, together, self.empty, context, row)

        shape = (count, self.config.horizon, self.config.state_dim)

        def noise() -> Tensor:
            # Draw on the generators' device: a seed gives the same samples on every device.
            drawn = [torch.randn(shape, generator=draw, device=draw.device) for draw in generators]
            return torch.cat(drawn).to(self.device)

        plans = sampling.run(epsilon, noise, self.alpha_bar)
        return self.decode(plans, seen).unflatten(0, (len(compositions), count))
