import pytest
import torch
from torch import Tensor

from ftl_lightning.methods.ftl_igm.pretraining import Codes
from ftl_lightning.services.errors import UserError

TEXTS = torch.randn(40, 24, generator=torch.Generator().manual_seed(1))
KEPT = torch.zeros(40, dtype=torch.bool)


def told(codes: Codes, clean: Tensor) -> Tensor:
    return codes(TEXTS, KEPT, clean, torch.Generator().manual_seed(0))


def plans(first: float) -> Tensor:
    """The same movements from other places."""
    way = torch.randn(40, 16, 6, generator=torch.Generator().manual_seed(2)).cumsum(dim=1)
    return way - way[:, :1] + first * torch.arange(40)[:, None, None] / 40


def test_codes_of_displacement_do_not_tell_where_a_plan_starts_and_those_of_places_do() -> None:
    assert torch.allclose(told(Codes(1.0, noise=0), plans(0)), told(Codes(1.0, noise=0), plans(3)), atol=1e-4)
    places = Codes(1.0, noise=0, relative=False)
    assert not torch.allclose(told(places, plans(0)), told(places, plans(3)), atol=0.1)
    assert told(Codes(1.0), plans(0)).shape == (40, 8, 24)


def test_a_share_of_the_texts_has_codes_and_removed_ones_have_none() -> None:
    codes = Codes(0.5, relative=False)(TEXTS, KEPT, plans(1), torch.Generator().manual_seed(0))
    plain = (codes == TEXTS[:, None]).all(dim=(1, 2))
    assert 8 < plain.sum() < 32
    removed = Codes(1.0)(torch.zeros(40, 24), ~KEPT, plans(1), torch.Generator().manual_seed(0))
    assert (removed == 0).all()
    with pytest.raises(UserError, match=r"^model\.codes\.share: expected"):
        Codes(2.0)
