"""What a learned concept is made of, in the words of the training concepts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

ROUNDING = 1e-4
"""Weights below this share of the largest are rounding and the penalty's doing."""
MOST_TOLD = 12
"""Parts of a combination that are told one by one, the largest."""
RIDGE = 1e-4
"""Penalty of weights, as a share of the training embeddings' largest singular value: well above their rounding (1e-7 of that value
in float32) and well below the singular values of what tells concepts apart (2e-2 of it and more in the shipped models).
"""


@dataclass(frozen=True)
class Explanation:
    """An embedding in words.

    Attributes:
        nearest: training concepts with the cosine of their angle to the embedding, the nearest first.
        combination: the non-negative combination of training concepts that is nearest to the embedding, with the smallest weights:
            those with a weight, the largest first.
        explained: share of the embedding's squared length that the combination holds, from 0 to 1. The combination is the nearest
            point of a cone, so what is left is at right angles to it and the two squared lengths add up to the embedding's.
    """

    nearest: tuple[tuple[str, float], ...]
    combination: tuple[tuple[str, float], ...]
    explained: float

    @property
    def unexplained(self) -> float:
        """Share of the embedding's squared length that no non-negative combination of training concepts holds."""
        return 1 - self.explained

    def __str__(self) -> str:
        near = ", ".join(f"{text} ({cosine:.2f})" for text, cosine in self.nearest)
        told = [f"{weight:.2f} {text}" for text, weight in self.combination[:MOST_TOLD]]
        rest = len(self.combination) - len(told)
        parts = " + ".join([*told, *([f"{rest} smaller ones"] if rest else [])]) or "nothing"
        return (
            f"nearest: {near}; best combination: {parts} (explains {self.explained:.2f}); not explained: "
            f"{100 * self.unexplained:.0f} % of its squared length, which no non-negative combination of training concepts holds"
        )


def explain(embedding: Tensor, names: Sequence[str], training: Tensor, nearest: int = 3) -> Explanation:
    """An embedding in terms of the training concepts.

    The combination minimises ``|B^T w - c|^2`` over ``w >= 0``, with the training embeddings as the rows of B. Only the nearest
    point ``B^T w`` is unique, not ``w``: the concept space's origin is the mean of the training concepts, so ``1^T B = 0``, and
    adding a constant to all weights changes nothing. Of the equivalent weights the smallest are taken, those of least ``|w|``.
    They are the limit of the minimisers of ``|B^T w - c|^2 + r^2 |w|^2`` as r goes to 0, which are unique for r > 0; r is
    :data:`RIDGE` times B's largest singular value. Where the sum of all rows is their only dependence, this subtracts the
    smallest weight from all weights, so that at least one concept has none.

    Args:
        embedding: ``(n,)`` in a model's concept space, whose origin is the mean of the training concepts.
        names: of the training concepts.
        training: their embeddings ``(training concept, n)``.
        nearest: how many of the nearest are told.
    """
    from scipy.optimize import nnls  # half a second of import, for what is explained later

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
