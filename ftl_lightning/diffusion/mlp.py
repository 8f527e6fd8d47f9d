"""The MLP denoiser of the paper's object rearrangement domain."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.concepts.branches import Context
from ftl_lightning.diffusion.conditions import condition_encoder, turned
from ftl_lightning.diffusion.denoiser import Sizes, sinusoidal_embedding
from ftl_lightning.errors import UserError
from ftl_lightning.processes import Dropout
from ftl_lightning.ranges import expect_range

FEW = 8
"""Rows that are multiplied at least: of fewer, libraries add up in another order."""


class MLPDenoiser(nn.Module):
    """Estimates noise from the noisy plan, the timestep, the concept and, where there is something, what is observed.

    Timestep and concept scale and shift every hidden layer (FiLM, Perez et al., 2018), which gives inversion more to hold on
    to than a concept that is only concatenated to the input. Hidden layers are residual.

    Args:
        sizes: of plans, concepts and observed features.
        hidden_dim: width.
        depth: hidden layers.
        condition_dim: features of the concept. A wide path from the concept matters: inversion has no other handle.
        time_dim: features of the timestep; even.
        dropout: of the hidden layers, in training.
        initial_encoder: ``'flat'`` (the paper's), ``'joint'``, ``'entities'``, ``'set'`` or ``'points'``,
            see :mod:`ftl_lightning.diffusion.conditions`.
        initial_dim: features of what is observed.

    Raises:
        UserError: for a size out of its range.
    """

    over_time = False

    def __init__(
        self,
        sizes: Sizes,
        hidden_dim: int = 512,
        depth: int = 4,
        condition_dim: int = 384,
        time_dim: int = 64,
        dropout: float = 0.0,
        initial_encoder: str = "flat",
        initial_dim: int = 64,
    ) -> None:
        super().__init__()
        if time_dim < 4 or time_dim % 2:
            raise UserError(f"denoiser_args.time_dim: expected an even number from 4 up, found {time_dim}")
        for name, value in (
            ("hidden_dim", hidden_dim),
            ("depth", depth),
            ("condition_dim", condition_dim),
            ("initial_dim", initial_dim),
        ):
            expect_range(f"denoiser_args.{name}", value, 1)
        expect_range("denoiser_args.dropout", dropout, 0, 1)
        self.time_dim, self.plane = time_dim, sizes.plane
        self.time = nn.Sequential(nn.Linear(time_dim, time_dim), nn.SiLU(), nn.Linear(time_dim, time_dim), nn.SiLU())
        self.concept = nn.Sequential(nn.Linear(sizes.concept_dim, condition_dim), nn.SiLU())
        plan = sizes.horizon * sizes.state_dim
        self.initial = condition_encoder(initial_encoder, sizes, initial_dim)
        inputs = [plan + (initial_dim if sizes.vector_dim else 0)] + [hidden_dim] * (depth - 1)
        self.layers = nn.ModuleList(nn.Linear(width, hidden_dim) for width in inputs)
        self.time_film = nn.Linear(time_dim, 2 * hidden_dim * depth)
        self.concept_film = nn.Linear(condition_dim, 2 * hidden_dim * depth, bias=False)
        self.dropout = Dropout(dropout)
        self.head = nn.Linear(hidden_dim, plan)

    def observe(self, vector: Tensor | None) -> Context:
        """What is read once a plan of the observed vectors ``(batch, m)``, normalised; nothing where there are none."""
        return () if self.initial is None or vector is None else self.initial.observe(vector)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimated noise ``(batch, horizon, state)``.

        What depends on the concept alone, two thirds of the arithmetic, is computed once for each row of ``concepts``.

        Args:
            x: noisy plan ``(batch, horizon, state)``, normalised.
            t: ``(batch,)`` int64.
            concepts: ``(concept, 1, n)``, the different concepts in the batch, in the model's concept space: of one knot, as a
                plan of this network has no times.
            index: ``(batch,)`` int64, each sample's row of ``concepts``.
            context: what :meth:`observe` read.
        """
        concepts = concepts.flatten(1)
        film = self._film(t, concepts, index)
        direction = None if self.initial is None else self.initial.direction(context, concepts[index])
        if direction is not None:
            x = turned(x, direction, self.plane, back=False)
        hidden = x.flatten(1)
        if self.initial is not None:
            hidden = torch.cat((hidden, self.initial.attend(context, concepts[index])), dim=-1)
        for depth, layer in enumerate(self.layers):
            scale, shift = film(2 * depth).add_(1), film(2 * depth + 1)
            # In place wherever no gradient needs what was there: memory costs nearly as much time as the products.
            changed = layer(hidden) * scale if torch.is_grad_enabled() else layer(hidden).mul_(scale)
            update = self.dropout(functional.silu(changed.add_(shift)))
            hidden = update.add_(hidden) if depth else update
        out: Tensor = self.head(hidden).unflatten(-1, x.shape[1:])
        return out if direction is None else turned(out, direction, self.plane, back=True)

    def _film(self, t: Tensor, concepts: Tensor, index: Tensor) -> Callable[[int], Tensor]:
        """What timestep and concept make of hidden layers: by number, scale and shift of each layer one after another, a fresh
        ``(batch, hidden_dim)`` in single precision.

        While sampling, all plans are at one timestep, and in judging a loss there are few: what a pair of timestep and concept
        makes is then computed once, and the plans of the pair take it. While concepts are learned together they share timesteps,
        and what a timestep makes is computed once. The numbers are the same to the bit.

        Args:
            t: ``(batch,)`` int64.
            concepts: ``(concept, n)``.
            index: each sample's row of ``concepts`` ``(batch,)``.
        """
        # In single precision whatever the products are in: these are few, and their gradients are summed over many plans.
        with torch.autocast(t.device.type, enabled=False):
            of_concepts = self._by_layer(self.concept_film(self.concept(concepts.float())))
            if len(t) <= 2 * FEW or (torch.is_grad_enabled() and self.time_film.weight.requires_grad):
                of_each = self.time_film(self.time(sinusoidal_embedding(t, self.time_dim))).chunk(len(of_concepts), dim=-1)
                # Summed layer by layer: all layers at once would not fit into the processor's cache.
                return lambda part: of_concepts[part].index_select(0, index).add_(of_each[part])
            times, own = t.unique(return_inverse=True)
            few = times[:1].expand(max(FEW - len(times), 0))
            every = self.time_film(self.time(sinusoidal_embedding(torch.cat((times, few)), self.time_dim)))
            of_times = self._by_layer(every[: len(times)])
        if len(times) * len(concepts) <= len(t) and not torch.is_grad_enabled():
            pairs = [(time[:, None] + concept).flatten(0, 1) for time, concept in zip(of_times, of_concepts, strict=True)]
            pair = own * len(concepts) + index
            return lambda part: pairs[part].index_select(0, pair)
        return lambda part: of_concepts[part].index_select(0, index).add_(of_times[part].index_select(0, own))

    def _by_layer(self, film: Tensor) -> tuple[Tensor, ...]:
        """Scales and shifts of all layers ``(row, 2 * depth * hidden_dim)`` one after another, each without gaps in memory, which
        rows are taken from in a third of the time.
        """
        return film.unflatten(-1, (2 * len(self.layers), -1)).transpose(0, 1).contiguous().unbind()
