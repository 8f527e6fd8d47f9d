"""The MLP denoiser of the paper's object rearrangement domain."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.networks.conditions import Context, Sizes, condition_encoder, sinusoidal_embedding, turned
from ftl_lightning.services.errors import require
from ftl_lightning.services.randomness import Dropout
from ftl_lightning.services.validation import check_range

FEW = 8
"""Minimum number of rows of a matrix product: with fewer rows, BLAS sums in another order."""


class MLPDenoiser(nn.Module):
    """Denoiser of the noisy plan, conditioned on the timestep, the concept and any observed features.

    Timestep and concept scale and shift every hidden layer (FiLM, Perez et al., 2018), which inversion favours over a concept that
    is only concatenated to the input. Hidden layers are residual.

    Args:
        sizes: sizes of plans, concepts and observed features.
        hidden_dim: width of the hidden layers.
        depth: number of hidden layers.
        condition_dim: number of concept features. Wide, as inversion only changes the concept.
        time_dim: number of timestep features; even.
        dropout: dropout of the hidden layers, in training.
        initial_encoder: ``'flat'`` (the paper's), ``'joint'``, ``'entities'``, ``'set'`` or ``'points'``,
            see :mod:`ftl_lightning.networks.conditions`.
        initial_dim: number of features of the observation.

    Raises:
        UserError: for a size out of range.
    """

    over_time = False
    by_sample = ("layers", "head")
    """Linear layers whose rows are the samples of a batch, which low-rank adapters modify."""

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
        require(time_dim >= 4 and time_dim % 2 == 0, "denoiser_args.time_dim", "an even number from 4 up", time_dim)
        counts = {"hidden_dim": hidden_dim, "depth": depth, "condition_dim": condition_dim, "initial_dim": initial_dim}
        for name, value in counts.items():
            check_range(f"denoiser_args.{name}", value, 1)
        check_range("denoiser_args.dropout", dropout, 0, 1)
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
        """Encode the normalised observed vectors ``(batch, m)`` once per plan; empty without vectors."""
        return () if self.initial is None or vector is None else self.initial.observe(vector)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimated noise ``(batch, horizon, state)``.

        Computations that depend only on the concept, two thirds of the arithmetic, are done once per row of ``concepts``.

        Args:
            x: noisy plan ``(batch, horizon, state)``, normalised.
            t: ``(batch,)`` int64.
            concepts: ``(concept, 1, n)``, the distinct concepts of the batch, in the model's concept space, with a single knot.
            index: ``(batch,)`` int64, row of ``concepts`` for each sample.
            context: output of :meth:`observe`.
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
            # In place unless a gradient needs the value: memory traffic costs nearly as much time as the products.
            changed = layer(hidden) * scale if torch.is_grad_enabled() else layer(hidden).mul_(scale)
            update = self.dropout(functional.silu(changed.add_(shift)))
            hidden = update.add_(hidden) if depth else update
        out: Tensor = self.head(hidden).unflatten(-1, x.shape[1:])
        return out if direction is None else turned(out, direction, self.plane, back=True)

    def _film(self, t: Tensor, concepts: Tensor, index: Tensor) -> Callable[[int], Tensor]:
        """FiLM parameters for every hidden layer, as a function of ``2 * layer`` (scale) or ``2 * layer + 1`` (shift).

        The function returns a new ``(batch, hidden_dim)`` in single precision. Sampling and evaluating losses have few timesteps:
        parameters are computed once per pair of timestep and concept. Learning several concepts shares timesteps: the timestep's
        part is computed once per timestep. All variants are bitwise equal.
        """
        # Single precision regardless of autocast: these products are few, and their gradients are summed over many plans.
        with torch.autocast(t.device.type, enabled=False):
            of_concepts = self._by_layer(self.concept_film(self.concept(concepts.float())))
            if len(t) <= 2 * FEW or (torch.is_grad_enabled() and self.time_film.weight.requires_grad):
                of_each = self.time_film(self.time(sinusoidal_embedding(t, self.time_dim))).chunk(len(of_concepts), dim=-1)
                # Sum layer by layer: all layers together exceed the CPU cache.
                return lambda part: of_concepts[part].index_select(0, index).add_(of_each[part])
            times, time_index = t.unique(return_inverse=True)
            padding = times[:1].expand(max(FEW - len(times), 0))
            padded = self.time_film(self.time(sinusoidal_embedding(torch.cat((times, padding)), self.time_dim)))
            of_times = self._by_layer(padded[: len(times)])
        if len(times) * len(concepts) <= len(t) and not torch.is_grad_enabled():
            pairs = [(time[:, None] + concept).flatten(0, 1) for time, concept in zip(of_times, of_concepts, strict=True)]
            pair = time_index * len(concepts) + index
            return lambda part: pairs[part].index_select(0, pair)
        return lambda part: of_concepts[part].index_select(0, index).add_(of_times[part].index_select(0, time_index))

    def _by_layer(self, film: Tensor) -> tuple[Tensor, ...]:
        """Split ``(row, 2 * depth * hidden_dim)`` into contiguous scales and shifts of each layer: row selection is 3x faster."""
        return film.unflatten(-1, (2 * len(self.layers), -1)).transpose(0, 1).contiguous().unbind()
