"""Coarse codes of behaviour, used in pretraining to prepare a denoiser for concepts that vary over a plan."""

import zlib
from dataclasses import dataclass

import torch
from torch import Tensor

from ftl_lightning.igm.diffusion import MOST_STEPS
from ftl_lightning.services.randomness import drawn, generator, mean
from ftl_lightning.services.validation import check_count, check_range


@dataclass(frozen=True)
class Codes:
    """Coarse codes of behaviour, added to the text embeddings of some samples in pretraining.

    A code is a random linear projection of the plan's states at several knots, with noise. Its average length is that of a text
    embedding, and half of the samples with a code have no text.

    Attributes:
        share: share of samples with a code, excluding samples with dropped text, which stay unconditional. 0 is the paper's form.
        knots: number of times.
        size: number of values per knot.
        noise: standard deviation of the noise added to the values, which have unit variance.
        relative: encode displacements from the first state; otherwise positions. Concepts of positions lead to the same places
            from any initial state.
    """

    share: float = 0.0
    knots: int = 8
    size: int = 16
    noise: float = 0.3
    relative: bool = True

    def __post_init__(self) -> None:
        check_range("model.codes.share", self.share, 0, 1)
        check_range("model.codes.noise", self.noise, 0)
        check_count("model.codes.knots", self.knots, 1, MOST_STEPS)
        check_count("model.codes.size", self.size, 1, MOST_STEPS)

    def __call__(self, texts: Tensor, removed: Tensor, clean: Tensor, draw: torch.Generator) -> Tensor:
        """Add codes to text embeddings; returns concepts ``(batch, knots, n)``.

        Args:
            texts: ``(batch, n)``, unconditional where removed.
            removed: mask of removed texts ``(batch,)``.
            clean: plans ``(batch, horizon, state)``, normalised.
        """
        count, width, device = *texts.shape, clean.device
        times = torch.linspace(0, clean.shape[1] - 1, self.knots, device=device).round().long()
        fixed = generator("cpu", zlib.crc32(b"codes"))
        mixing = torch.randn(clean.shape[2], self.size, generator=fixed).to(device)
        directions = torch.randn(self.size, width, generator=fixed).to(device) / self.size**0.5
        states = clean[:, times] - clean[:, :1] if self.relative else clean[:, times]
        path = states @ mixing  # (batch, knot, size)
        numbers = path / mean(path.square().mean()).sqrt().clamp(min=1e-6)
        numbers = numbers + self.noise * drawn(count, lambda n: torch.randn((n, *path.shape[1:]), generator=draw, device=device))
        coded = (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < self.share) & ~removed
        alone = coded & (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < 0.5)
        text = torch.where(alone[:, None], 0, texts)  # 0 is the mean of the training concepts
        return text[:, None] + coded[:, None, None] * (numbers @ directions)
