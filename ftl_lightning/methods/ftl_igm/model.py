"""Model of our method: a conditional denoiser with its schedule, for learning and composing concepts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning import networks
from ftl_lightning.data.deformation import Pinned
from ftl_lightning.data.features import Observed, take
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import MOST_STEPS, PREDICTIONS, Context, Prediction, cosine_alpha_bar
from ftl_lightning.igm.forms.adapter import LowRank, adaptable
from ftl_lightning.igm.model import DiffusionModel, Draws
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import Loss
from ftl_lightning.networks.image_encoder import OF_OBJECTS
from ftl_lightning.services.errors import require, short
from ftl_lightning.services.spectrum import Spectrum, check_cosines
from ftl_lightning.services.validation import check_range, from_mapping
from ftl_lightning.training.concept_model import TextConceptModel
from ftl_lightning.training.model_config import ModelConfig, Prepared


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
    """Build a denoiser of the configured class and size; ``UserError`` for an unknown class or invalid arguments."""
    known, smooth = networks.__all__, config.denoiser_args.get("smooth")
    require(config.denoiser in known, "denoiser", f"one of {', '.join(known)}", repr(short(config.denoiser)))
    require(config.prediction in PREDICTIONS, "prediction", f"one of {', '.join(PREDICTIONS)}", repr(short(config.prediction)))
    rough = config.prediction in ("epsilon", "v")
    reason = f"0 for a network that predicts {config.prediction}, which is not smooth"
    require(not (rough and smooth), "denoiser_args.smooth", reason, smooth)
    kind: type[nn.Module] = getattr(networks, config.denoiser)
    over_time = config.prediction == "cosines" and getattr(kind, "over_time", False)
    require(not over_time, "prediction", f"clean for {config.denoiser}, whose output is smooth by itself", "cosines")
    points = config.denoiser_args.get("initial_encoder") == "points" and config.image_dim
    reads = config.image_encoder.get("head") in OF_OBJECTS
    require(reads or not points, "denoiser_args.initial_encoder", "flat", "points: image_encoder.head reads no points")
    denoiser = from_mapping(kind, config.denoiser_args, "denoiser_args", config)
    if config.prediction == "epsilon":
        return denoiser
    columns = len(config.state_columns)
    require(columns in (0, config.state_dim), "observed, state", f"{config.state_dim} columns", columns)
    if config.prediction == "cosines":
        check_cosines(config.horizon, "model.prediction cosines")
    spectrum = Spectrum(config.horizon, config.state_dim) if config.prediction == "cosines" else None
    return Prediction(denoiser, config.prediction, config.diffusion_steps, config.state_columns, spectrum)


class GenerativeModel(DiffusionModel, TextConceptModel):
    """Conditional diffusion model of plans."""

    kind = "diffusion"
    invertible = True
    Config = DiffusionConfig
    config: DiffusionConfig

    def __init__(self, prepared: Prepared[DiffusionConfig]) -> None:
        super().__init__(prepared)
        self.denoiser = build_denoiser(prepared.config)
        self.plan = prepared.config.horizon, prepared.config.state_dim
        self.register_buffer("alpha_bar", cosine_alpha_bar(prepared.config.diffusion_steps))

    @property
    def traits(self) -> tuple[str, ...]:
        encoder = self.config.denoiser_args.get("initial_encoder")
        return (*super().traits, *([encoder] if encoder else []))

    @property
    def over_time(self) -> bool:
        over_time: bool = getattr(networks, self.config.denoiser).over_time
        return over_time

    def adaptable(self, by_sample: bool = False) -> dict[str, tuple[int, int]]:
        return adaptable(self.denoiser, by_sample)

    def check_adapter(self, adapter: LowRank) -> None:
        adapter.check_fits(self.denoiser)

    def observe(self, observed: Observed) -> Context:
        """Encode observed features once per plan."""
        context: Context = self.denoiser.observe(self.vector(observed))  # type: ignore[operator]
        return context

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
        assert draws is not None
        context, runs = self.observe(observed), range(len(composition.weights))
        frames = None if self.frames is None else self.frames_by_plan([composition.row(run) for run in runs], len(draws.t))
        return self.composed_losses(self.encode(states, observed, frames), context, composition, draws, loss)

    def products(self, states: Tensor, observed: Observed, frames: Tensor | None, draws: Draws | None, loss: Loss) -> Tensor:
        assert draws is not None
        clean = self.encode(states, observed, frames)
        return self.branch_products(clean, self.observe(observed), self.training_embeddings, draws, loss)

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        features, shape = observed or {}, (len(compositions), count)
        known, pinned, frames = self.known_states(features), None, self.frames_by_plan(compositions, count)
        if known is not None:
            values = self.encode(known, features, frames)  # NaN where a number depends on an unknown state
            pinned = Pinned(~values.isnan(), values.nan_to_num())
        parts = [composition.uncomposed for composition in compositions]
        if any(part.made is None or part.share < 1 for part in parts):
            plans = self.composed_plans(compositions, count, sampling, generators, self.observe(features), pinned)
            states = self.decode(self._varied(plans, parts, generators, pinned), features, frames)
        else:
            states = torch.zeros(())
        if any(part.made for part in parts):
            made = self._made(parts, count, generators, features)
            if pinned is not None or any(part.variation for part in parts):
                plans = self._varied(self.encode(made, features, frames), parts, generators, pinned)
                made = self.decode(plans, features, frames)
            states = torch.where(made.isnan(), states.to(made), made)
        if known is not None:
            states = torch.where(known.isnan(), states, known)
        return states.unflatten(0, shape)

    def _varied(
        self, plans: Tensor, parts: Sequence[Composition], generators: Sequence[torch.Generator], pinned: Pinned | None
    ) -> Tensor:
        """Normalised plans with the variation of the compositions, pinned again."""
        varied = self.varied(plans, parts, generators)
        return varied if pinned is None else pinned(varied)

    def _made(self, parts: Sequence[Composition], count: int, generators: Sequence[torch.Generator], features: Observed) -> Tensor:
        """Samples ``(composition * count, horizon, state)`` of makers, as kinds of columns allow; NaN for the network."""
        made = torch.full((len(parts), count, self.horizon, len(self.domain.plans.columns)), torch.nan, device=self.device)
        for number, (part, draw) in enumerate(zip(parts, generators, strict=True)):
            if part.made is None:
                continue
            seen = take(features, slice(number * count, (number + 1) * count))
            states = part.made.sample(seen, count, draw).to(made)
            states = states if self.view is None else self.decode(self.encode(states, seen), seen)
            if part.share < 1:  # stratified: the share is exact for many samples
                place = (torch.rand(1, generator=draw) + torch.randperm(count, generator=draw)) / count
                states = states.where((place < part.share).to(self.device)[:, None, None], torch.nan)
            made[number] = states
        return made.flatten(0, 1)
