"""What a learned concept is made of, in the words of the training concepts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from torch import Tensor

ROUNDING = 1e-6
"""Weights below this share of the largest are the solver's rounding."""


@dataclass(frozen=True)
class Explanation:
    """An embedding in words.

    Attributes:
        nearest: training concepts with the cosine of their angle to the embedding, the nearest first.
        combination: the non-negative combination of training concepts that is nearest to the embedding: those with a weight, the
            largest first.
        explained: share of the embedding's squared length that the combination holds, from 0 to 1.
    """

    nearest: tuple[tuple[str, float], ...]
    combination: tuple[tuple[str, float], ...]
    explained: float

    def __str__(self) -> str:
        near = ", ".join(f"{text} ({cosine:.2f})" for text, cosine in self.nearest)
        parts = " + ".join(f"{weight:.2f} {text}" for text, weight in self.combination) or "nothing"
        return f"nearest: {near}; best combination: {parts} (explains {self.explained:.2f})"


def explain(embedding: Tensor, names: Sequence[str], training: Tensor, nearest: int = 3) -> Explanation:
    """An embedding in terms of the training concepts.

    Args:
        embedding: ``(n,)`` in a model's concept space, whose origin is the mean of the training concepts.
        names: of the training concepts.
        training: their embeddings ``(training concept, n)``.
        nearest: how many of the nearest are told.
    """
    target, basis = embedding.double().numpy(), training.double().numpy()
    lengths = np.linalg.norm(basis, axis=1) * np.linalg.norm(target)
    cosines = basis @ target / np.where(lengths > 0, lengths, 1)
    weights, residual = nnls(basis.T, target)
    by_angle, by_weight = np.argsort(-cosines)[:nearest], np.argsort(-weights)
    return Explanation(
        nearest=tuple((names[row], float(cosines[row])) for row in by_angle),
        combination=tuple((names[row], float(weights[row])) for row in by_weight if weights[row] > ROUNDING * weights.max()),
        explained=float(1 - residual**2 / (target @ target)) if target.any() else 1.0,
    )
