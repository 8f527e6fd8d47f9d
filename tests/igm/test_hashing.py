import torch

from ftl_lightning.networks.text_encoder import DIMENSION, HashingEncoder

ENCODER = HashingEncoder()


def test_embeddings_have_length_one_and_the_empty_text_is_zero() -> None:
    found = ENCODER(["going left", "", "  ", "?", "à gauche"])
    assert found.shape == (5, DIMENSION)
    assert found.dtype == torch.float32
    assert torch.allclose(found.norm(dim=1), torch.tensor([1.0, 0.0, 0.0, 1.0, 1.0]))
    assert ENCODER([]).shape == (0, DIMENSION)
    assert ENCODER.identity == "hashing-384"


def test_an_embedding_is_the_same_everywhere_whatever_it_is_computed_beside() -> None:
    # Learned concepts are files: this row must not change between versions, or no model fits its concepts any more.
    found = ENCODER(["go"])[0]
    assert found.nonzero().flatten().tolist() == [24, 73, 245]
    assert torch.allclose(found[[24, 73, 245]], torch.tensor([1.0, -1.0, 1.0]) / 3**0.5)
    assert torch.equal(ENCODER(["stop", "go"])[1], found)


def test_texts_that_share_words_are_nearer_than_those_that_do_not() -> None:
    circle, circles, square, order = ENCODER(["draw a circle", "draw circles", "push the red square", "circle a draw"])
    assert circle @ circles > 0.4 > circle @ square
    assert circle @ square < 0.2
    assert 0.4 < circle @ order < 0.99  # the same words in another order are not the same text
    assert torch.equal(*ENCODER(["Go LEFT", "go left"]))
