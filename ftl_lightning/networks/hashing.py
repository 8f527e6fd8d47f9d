"""Text encoder without a language model: words and pieces of words, hashed into a fixed number of columns."""

import hashlib
import itertools
import re
import unicodedata
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

DIMENSION = 384
"""Embedding size."""
PIECE = 3
"""Letters per piece of a word."""
_TOKEN = re.compile(r"\w+|[^\w\s]")


class HashingEncoder:
    """Signed feature hashing (Weinberger et al., 2009). Needs no data, no internet access and no language model.

    Features of a text are its words, pairs of neighbouring words, and the pieces of :data:`PIECE` letters of each word with marked
    ends, so that 'circle' and 'circles' are near each other. Each feature adds +1 or -1 to a column. SHA-256 decides sign and
    column, so embeddings are the same on every machine. Meanings are unknown: 'big' and 'large' have nothing in common.
    """

    @property
    def identity(self) -> str:
        """Unique name of the encoder."""
        return f"hashing-{DIMENSION}"

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Embeddings ``(text, 384)`` float32 of unit length; zeros for an empty or blank text."""
        sums = torch.zeros(len(texts), DIMENSION, dtype=torch.float64)
        for row, text in enumerate(texts):
            for feature in _features(text):
                digest = hashlib.sha256(feature.encode()).digest()
                sums[row, int.from_bytes(digest[:8], "big") % DIMENSION] += 1 if digest[8] & 1 else -1
        length = sums.norm(dim=1, keepdim=True)
        return torch.where(length > 0, sums / length.clamp(min=1e-12), 0).float()


def _features(text: str) -> Iterator[str]:
    """Words, pairs and pieces, each prefixed by its kind; case and Unicode form do not matter."""
    words = _TOKEN.findall(unicodedata.normalize("NFKC", text).casefold())
    for word in words:
        yield f"word {word}"
        marked = f"<{word}>"
        for start in range(len(marked) - PIECE + 1):
            yield f"piece {marked[start : start + PIECE]}"
    for pair in itertools.pairwise(words):
        yield f"pair {' '.join(pair)}"
