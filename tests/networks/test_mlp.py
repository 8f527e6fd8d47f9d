"""The MLP denoiser: where its own weights are not learned it shares what plans have in common, to the same bits."""

import pytest
import torch

from ftl_lightning.networks import MLPDenoiser
from ftl_lightning.networks.conditions import Sizes

SIZES = Sizes(1, 21, 48)


@pytest.mark.parametrize(
    ("times", "concepts", "plans", "computed"),
    [(1, 1, 1, 1), (1, 2, 3, 3), (1, 3, 50, 8), (1, 21, 600, 8), (32, 1, 32, 32), (32, 3, 100, 32), (7, 5, 9, 9), (2, 9, 17, 8)],
)
def test_plans_of_a_timestep_and_concept_share_what_these_make_to_the_bit(
    times: int, concepts: int, plans: int, computed: int
) -> None:
    torch.manual_seed(0)
    network = MLPDenoiser(SIZES, hidden_dim=256, depth=3, condition_dim=64).eval()
    calls: list[int] = []
    network.time_film.register_forward_hook(lambda layer, inputs, out: calls.append(len(out)))
    t = torch.arange(times).repeat(plans)[:plans]
    learned = torch.randn(concepts, 1, 48, requires_grad=True)
    given, seen = (torch.randn(plans, 1, 21), t, learned, torch.arange(plans) % concepts), torch.randn(plans, 1, 21)
    expected = network(*given)
    (gradient,) = torch.autograd.grad((expected * seen).sum(), [learned])
    network.requires_grad_(False)
    frozen = network(*given)
    (found,) = torch.autograd.grad((frozen * seen).sum(), [learned])
    with torch.no_grad():
        sampled = network(*given)
    assert torch.equal(frozen, expected)
    assert torch.equal(found, gradient)
    assert torch.equal(sampled, expected)
    assert calls == [plans, computed, computed]


def test_in_training_every_plan_has_its_own_dropout() -> None:
    torch.manual_seed(0)
    network = MLPDenoiser(SIZES, hidden_dim=64, depth=2, condition_dim=16, dropout=0.5).train()
    plans = torch.ones(64, 1, 21), torch.zeros(64, dtype=torch.int64), torch.ones(1, 1, 48), torch.zeros(64, dtype=torch.int64)
    with torch.no_grad():
        found = network(*plans)
    assert len(found.unique(dim=0)) == 64
