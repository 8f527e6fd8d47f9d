import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.data.normalization import Normalization


@settings(max_examples=50, deadline=None)
@given(
    rows=st.integers(1, 6),
    columns=st.integers(1, 5),
    constant=st.integers(0, 4),
    scale=st.floats(1e-2, 1e4),
    seed=st.integers(0, 2**31),
)
def test_round_trip_and_range_survive_constant_columns(rows: int, columns: int, constant: int, scale: float, seed: int) -> None:
    states = scale * torch.randn((rows, 2, columns), generator=torch.Generator().manual_seed(seed))
    states[..., constant % columns] = 3.25
    normalization = Normalization.fit(states)
    normalised = normalization.encode(states)
    assert normalised.isfinite().all()
    assert normalised.abs().max() <= 1 + 1e-5
    assert (normalised[..., constant % columns] == 0).all()
    assert torch.allclose(normalization.decode(normalised), states, rtol=1e-4, atol=1e-4 * scale)


def test_it_is_kept_with_a_model() -> None:
    fitted = Normalization.fit(torch.tensor([[0.0, 1.0], [2.0, 1.0]]))
    other = Normalization(torch.zeros(2), torch.zeros(2))
    other.load_state_dict(fitted.state_dict())
    assert torch.equal(other.encode(torch.tensor([[1.0, 1.0]])), torch.tensor([[0.0, 0.0]]))


def test_exchangeable_entities_share_their_extremes() -> None:
    states = torch.tensor([[0.0, 5.0, -2.0, 7.0], [1.0, 6.0, 0.0, 7.5]])
    found = Normalization.fit(states, shared=((0, 1), (2, 3)))
    assert found.low.tolist() == [-2, 5, -2, 5]
    assert found.high.tolist() == [1, 7.5, 1, 7.5]


def test_columns_can_share_another_scale() -> None:
    found = Normalization.fit(torch.tensor([[0.0, 5.0, 7.0], [1.0, 6.0, 7.0]]))
    found.share((2, 0), Normalization.fit(torch.tensor([[0.0, -1.0], [8.0, 3.0]])))
    assert found.low.tolist() == [-1, 5, 0]
    assert found.high.tolist() == [3, 6, 8]


def test_what_varies_by_rounding_alone_is_constant() -> None:
    states = torch.tensor([[0.1020, 1.0], [0.1021, 2.0]])
    found = Normalization.fit(states, resolution=1e-3)
    assert found.encode(torch.tensor([0.1021, 1.5])).tolist() == [0, 0]
    assert found.decode(torch.zeros(2)).tolist() == pytest.approx([0.102, 1.5])
    assert Normalization.fit(states).encode(states[1]).tolist() == pytest.approx([1, 1])  # unless a domain says so, it varies
    large = torch.tensor([[1e6, 1e6], [1e6 + 0.25, 1e6 + 4]])  # of which float32 holds no more than a tenth
    assert Normalization.fit(large).encode(large[1]).tolist() == [0, 1]
