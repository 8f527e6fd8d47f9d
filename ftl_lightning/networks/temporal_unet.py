"""The temporal U-Net of the paper's trajectory domains, after Decision Diffuser (Ajay et al., 2023)."""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.networks.conditions import Context, Sizes, condition_encoder, sinusoidal_embedding
from ftl_lightning.services.errors import require

MOST_CLOCK = 256
"""Maximum number of position channels: single precision does not resolve higher frequencies."""

KERNEL, GROUPS = 5, 8


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv1d(inputs, outputs, KERNEL, padding=KERNEL // 2), nn.GroupNorm(GROUPS, outputs), nn.Mish())


def over_time(knots: Tensor, times: int) -> Tensor:
    """Interpolate linearly between knots ``(batch, knot, columns)``, evenly spaced from the first time to the last.

    Returns:
        ``(batch, columns, times)``, or ``(batch, columns, 1)`` for a single knot.
    """
    values = knots.transpose(1, 2)
    if values.shape[2] == 1:
        return values
    return functional.interpolate(values, size=times, mode="linear", align_corners=True)


class ResidualBlock(nn.Module):
    """Two convolutions over time, conditioned in between.

    Args:
        inputs, outputs: channels.
        condition_dim: size of the condition.
        film: scale and shift by the condition (FiLM, Perez et al., 2018); otherwise add it, as in Decision Diffuser.
    """

    def __init__(self, inputs: int, outputs: int, condition_dim: int, film: bool) -> None:
        super().__init__()
        self.film = film
        self.first, self.second = _convolution(inputs, outputs), _convolution(outputs, outputs)
        self.condition = nn.Linear(condition_dim, 2 * outputs if film else outputs)
        self.skip = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """``x (batch, inputs, time)`` and ``condition (batch, knot, condition)`` to ``(batch, outputs, time)``."""
        hidden, modulation = self.first(x), over_time(self.condition(condition), x.shape[2])
        if self.film:
            scale, shift = modulation.chunk(2, dim=1)
            hidden = hidden * (1 + scale) + shift
        else:
            hidden = hidden + modulation
        hidden = self.second(hidden)
        out: Tensor = hidden + self.skip(x)
        return out


class Level(nn.Module):
    """Two residual blocks at the same resolution; arguments as in :class:`ResidualBlock`."""

    def __init__(self, inputs: int, outputs: int, condition_dim: int, film: bool) -> None:
        super().__init__()
        self.first = ResidualBlock(inputs, outputs, condition_dim, film)
        self.second = ResidualBlock(outputs, outputs, condition_dim, film)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """See :class:`ResidualBlock`."""
        out: Tensor = self.second(self.first(x, condition), condition)
        return out


class TemporalUNet(nn.Module):
    """Denoiser of the noisy plan, conditioned on the timestep, the concept and the observed features.

    Args:
        sizes: sizes of plans, concepts and observed features; the horizon must be a multiple of ``2 ** (levels - 1)``.
        width: channels of the first level, and size of each of the condition's three parts; 128 in the paper.
        multipliers: channels of the levels, in multiples of ``width``.
        initial_encoder: ``'flat'`` (the paper's), ``'joint'``, ``'entities'`` or ``'set'``,
            see :mod:`ftl_lightning.networks.conditions`.
        film: scale and shift channels by the condition; false for the paper's form, which adds it.
        broadcast: append the features of the observation to the input at every time; false for the paper's form.
        clock: number of channels that encode the time in the plan; even; 0 for the paper's form, in which the convolutions see the
            time only by the padding.
        smooth: number of smoothing passes over the output with weights 1/4, 1/2, 1/4; 0 for the paper's form. Removes jitter from
            predictions of behaviour; not for predictions of noise.
        skip: connect the first level directly to the output, at full resolution; false for the paper's form, in which everything
            passes the middle.

    Raises:
        UserError: for an indivisible horizon or a size out of range.
    """

    over_time = True
    clock: Tensor

    def __init__(
        self,
        sizes: Sizes,
        width: int = 32,
        multipliers: Sequence[int] = (1, 2, 4, 8),
        initial_encoder: str = "flat",
        film: bool = False,
        broadcast: bool = False,
        clock: int = 0,
        skip: bool = False,
        smooth: int = 0,
    ) -> None:
        super().__init__()
        halvings = len(multipliers) - 1
        factor = 2**halvings
        expected = f"a multiple of {factor} (the temporal U-Net halves it {halvings} times)"
        require(sizes.horizon % factor == 0, "horizon", expected, sizes.horizon)
        require(width >= GROUPS and width % GROUPS == 0, "denoiser_args.width", f"a multiple of {GROUPS}", width)
        is_clock = clock % 2 == 0 and 0 <= clock <= MOST_CLOCK
        require(is_clock, "denoiser_args.clock", f"an even number up to {MOST_CLOCK}", clock)
        expected = "points without a plane for TemporalUNet, which turns no plans"
        require(initial_encoder != "points" or not sizes.plane, "denoiser_args.initial_encoder", expected, "points with a plane")
        self.smooth, self.width, self.broadcast = smooth, width, broadcast and sizes.vector_dim > 0
        # Explicit CPU: arithmetic on the meta device makes torch import its compiler.
        rates = 2.0 ** torch.arange(-1, clock // 2 - 1, device="cpu")[:, None]
        angle = torch.linspace(0, math.pi, sizes.horizon, device="cpu") * rates
        self.register_buffer("clock", torch.cat((angle.sin(), angle.cos())), persistent=False)
        self.time = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.concept = nn.Sequential(nn.Linear(sizes.concept_dim, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.initial = condition_encoder(initial_encoder, sizes, width)
        condition = width * (3 if sizes.vector_dim else 2)
        channels = [width * multiplier for multiplier in multipliers]
        self.down = nn.ModuleList(
            Level(inputs, outputs, condition, film)
            for inputs, outputs in itertools.pairwise([sizes.state_dim + clock + (width if self.broadcast else 0), *channels])
        )
        self.shrink = nn.ModuleList(nn.Conv1d(width, width, 3, stride=2, padding=1) for width in channels[:-1])
        self.middle = Level(channels[-1], channels[-1], condition, film)
        self.up = nn.ModuleList(
            Level(2 * inputs, outputs, condition, film) for inputs, outputs in itertools.pairwise(reversed(channels))
        )
        self.grow = nn.ModuleList(nn.ConvTranspose1d(width, width, 4, stride=2, padding=1) for width in channels[-2::-1])
        self.out = nn.Sequential(_convolution(width, width), nn.Conv1d(width, sizes.state_dim, 1))
        self.skip = nn.Conv1d(width, width, 1) if skip else None
        for parameter in self.skip.parameters() if self.skip is not None else ():
            nn.init.zeros_(parameter)

    def observe(self, vector: Tensor | None) -> Context:
        """Encode the normalised observed vectors ``(batch, m)`` once per plan; empty without vectors."""
        return () if self.initial is None or vector is None else self.initial.observe(vector)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimated noise ``(batch, horizon, state)``.

        Args:
            x: noisy plan ``(batch, horizon, state)``, normalised.
            t: ``(batch,)`` int64.
            concepts: ``(concept, knots, n)``, the distinct concepts of the batch, in the model's concept space. A layer's condition
                is computed at each knot and interpolated linearly.
            index: ``(batch,)`` int64, row of ``concepts`` for each sample.
            context: output of :meth:`observe`.
        """
        knots, times = concepts.shape[1], x.shape[1]
        parts = [self.time(sinusoidal_embedding(t, self.width))[:, None].expand(-1, knots, -1), self.concept(concepts)[index]]
        if self.initial is not None:
            repeated = context if knots == 1 else tuple(part.repeat_interleave(knots, dim=0) for part in context)
            parts.append(self.initial.attend(repeated, concepts[index].flatten(0, 1)).unflatten(0, (-1, knots)))
        condition = functional.mish(torch.cat(parts, dim=-1))
        inputs = [x.transpose(1, 2), self.clock.expand(len(x), -1, -1)]
        if self.broadcast:
            inputs.append(over_time(parts[-1], times).expand(-1, -1, times))
        hidden = torch.cat(inputs, dim=1)
        kept = []
        for level, shrink in zip(self.down, [*self.shrink, nn.Identity()], strict=True):
            kept.append(level(hidden, condition))
            hidden = shrink(kept[-1])
        hidden = self.middle(hidden, condition)
        for level, grow, across in zip(self.up, self.grow, kept[:0:-1], strict=True):
            hidden = grow(level(torch.cat((hidden, across), dim=1), condition))
        if self.skip is not None:
            hidden = hidden + self.skip(kept[0])
        out: Tensor = self.out(hidden)
        for _ in range(self.smooth):
            ends = functional.pad(out, (1, 1), mode="replicate")
            out = (ends[..., :-2] + 2 * out + ends[..., 2:]) / 4
        return out.transpose(1, 2)
