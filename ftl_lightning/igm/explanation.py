"""Explanation of a learned concept by training concepts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

ROUNDING = 1e-4
"""Smallest reported weight, as a share of the largest; smaller weights come from rounding and the penalty."""
MOST_TERMS = 12
"""Maximum number of listed parts of a combination."""
RIDGE = 1e-4
"""Penalty of weights, relative to the largest singular value of the training embeddings: well above float32 rounding (1e-7) and
well below the singular values that distinguish concepts (2e-2 and more in the shipped models).
"""


@dataclass(frozen=True)
class Explanation:
    """Explanation of an embedding.

    Attributes:
        nearest: training concepts with their cosine similarity to the embedding, the nearest first.
        combination: best non-negative combination of training concepts with minimal weights: concepts with non-zero weights, the
            largest first.
        explained: share of the embedding's squared length that the combination explains, 0 to 1. The combination is a projection
            onto a cone: the residual is orthogonal to it and their squared lengths add up to the embedding's.
    """

    nearest: tuple[tuple[str, float], ...]
    combination: tuple[tuple[str, float], ...]
    explained: float

    @property
    def unexplained(self) -> float:
        """Share of the embedding's squared length outside all non-negative combinations of training concepts."""
        return 1 - self.explained

    def __str__(self) -> str:
        near = ", ".join(f"{text} ({cosine:.2f})" for text, cosine in self.nearest)
        terms = [f"{weight:.2f} {text}" for text, weight in self.combination[:MOST_TERMS]]
        rest = len(self.combination) - len(terms)
        parts = " + ".join([*terms, *([f"{rest} smaller ones"] if rest else [])]) or "nothing"
        return (
            f"nearest: {near}; best combination: {parts} (explains {self.explained:.2f}); not explained: "
            f"{100 * self.unexplained:.0f} % of its squared length, which no non-negative combination of training concepts holds"
        )


def formula(embeddings: Tensor, weights: Tensor, names: Sequence[str], training: Tensor) -> str:
    """Weighted sum of training concepts, such as ``'0.53 red + 0.55 blue'``; empty if an embedding is not a training concept's.

    Args:
        embeddings, weights: of a concept, ``(K, knots, n)`` and ``(K,)``.
        names, training: training concepts and their embeddings ``(training concept, n)``.
    """
    apart = (embeddings[:, :1] - training).abs().amax(dim=2)
    if embeddings.shape[1] != 1 or not bool((apart.amin(dim=1) == 0).all()):
        return ""
    terms = sorted(zip(weights.tolist(), apart.argmin(dim=1).tolist(), strict=True), key=lambda term: -abs(term[0]))
    text = "".join(f" {'-' if weight < 0 else '+'} {abs(weight):.2f} {names[row]}" for weight, row in terms)
    return text.removeprefix(" + ").removeprefix(" ")


def explain(embedding: Tensor, names: Sequence[str], training: Tensor, nearest: int = 3) -> Explanation:
    """Explain an embedding by training concepts.

    The combination minimises ``|B^T w - c|^2`` over ``w >= 0``, with the training embeddings as the rows of B. Only the projection
    ``B^T w`` is unique, not ``w``: the concept space's origin is the mean of the training concepts, so ``1^T B = 0``, and adding a
    constant to all weights changes nothing. The weights of minimal norm ``|w|`` are chosen. They are the limit of the minimisers of
    ``|B^T w - c|^2 + r^2 |w|^2`` as r goes to 0, which are unique for r > 0; r is :data:`RIDGE` times B's largest singular value.
    If ``1^T B = 0`` is the only dependence of the rows, the smallest weight is 0.

    Args:
        embedding: ``(n,)`` in a model's concept space, whose origin is the mean of the training concepts.
        training: embeddings of the training concepts ``(training concept, n)``.
    """
    from scipy.optimize import nnls  # slow import

    target, basis = embedding.double().numpy(), training.double().numpy()
    lengths = np.linalg.norm(basis, axis=1) * np.linalg.norm(target)
    cosines = basis @ target / np.where(lengths > 0, lengths, 1)
    ridge = RIDGE * np.linalg.norm(basis, 2) * np.eye(len(basis))
    weights, _ = nnls(np.concatenate((basis.T, ridge)), np.concatenate((target, np.zeros(len(basis)))))
    residual = basis.T @ weights - target
    by_angle, by_weight = np.argsort(-cosines)[:nearest], np.argsort(-weights)
    return Explanation(
        nearest=tuple((names[row], float(cosines[row])) for row in by_angle),
        combination=tuple((names[row], float(weights[row])) for row in by_weight if weights[row] > ROUNDING * weights.max()),
        explained=float(1 - residual @ residual / (target @ target)) if target.any() else 1.0,
    )
