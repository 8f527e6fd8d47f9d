"""Rough codes of behaviour, from which a denoiser learns in pretraining that concepts may vary over a plan."""

import zlib
from dataclasses import dataclass

import torch
from torch import Tensor

from ftl_lightning.diffusion.schedule import MOST_STEPS
from ftl_lightning.processes import drawn, mean
from ftl_lightning.ranges import expect_count, expect_range
from ftl_lightning.seeding import generator


@dataclass(frozen=True)
class Codes:
    """Rough codes of behaviour, which are added to the texts of some samples in pretraining.

    A code is a random linear projection of the plan's states at each of several knots, with noise. It is as long as a text's
    embedding on average, and half of the samples with a code have no text.

    Attributes:
        share: of the samples that have one; of those whose text is dropped none has, so that there is an empty concept. 0 is the
            paper's form.
        knots: times.
        size: numbers of a code at a knot.
        noise: standard deviation of what is added to the numbers, which have unit variance.
        relative: codes tell how far a plan has come from its first state; otherwise where it is. Concepts of where it is lead to
            the same places from any initial state.
    """

    share: float = 0.0
    knots: int = 8
    size: int = 16
    noise: float = 0.3
    relative: bool = True

    def __post_init__(self) -> None:
        expect_range("model.codes.share", self.share, 0, 1)
        expect_range("model.codes.noise", self.noise, 0)
        expect_count("model.codes.knots", self.knots, 1, MOST_STEPS)
        expect_count("model.codes.size", self.size, 1, MOST_STEPS)

    def __call__(self, texts: Tensor, removed: Tensor, clean: Tensor, draw: torch.Generator) -> Tensor:
        """Concepts ``(batch, knots, n)``.

        Args:
            texts: ``(batch, n)``, the empty one where it was removed.
            removed: where it was ``(batch,)``.
            clean: plans ``(batch, horizon, state)``, normalised.
            draw: of what is random.
        """
        count, width, device = *texts.shape, clean.device
        times = torch.linspace(0, clean.shape[1] - 1, self.knots, device=device).round().long()
        fixed = generator("cpu", zlib.crc32(b"codes"))
        mixing = torch.randn(clean.shape[2], self.size, generator=fixed).to(device)
        directions = torch.randn(self.size, width, generator=fixed).to(device) / self.size**0.5
        shown = clean[:, times] - clean[:, :1] if self.relative else clean[:, times]
        way = shown @ mixing  # (batch, knot, size)
        numbers = way / mean(way.square().mean()).sqrt().clamp(min=1e-6)
        numbers = numbers + self.noise * drawn(count, lambda n: torch.randn((n, *way.shape[1:]), generator=draw, device=device))
        told = (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < self.share) & ~removed
        alone = told & (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < 0.5)
        text = torch.where(alone[:, None], 0, texts)  # 0 is the mean of the training concepts
        return text[:, None] + told[:, None, None] * (numbers @ directions)
