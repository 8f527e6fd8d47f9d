"""The MLP denoiser."""

import pytest
import torch

from ftl_lightning.diffusion import MLPDenoiser
from ftl_lightning.diffusion.denoiser import Sizes


@pytest.mark.parametrize("batch", [1, 3, 4, 9, 60])
@pytest.mark.parametrize("timesteps", [1, 2, 5])
def test_films_once_a_timestep_and_concept_have_the_same_bits_as_once_a_sample(batch: int, timesteps: int) -> None:
    torch.manual_seed(0)
    net = MLPDenoiser(Sizes(horizon=2, state_dim=5, concept_dim=7), hidden_dim=64, depth=2, condition_dim=16).eval()
    x, concepts = torch.randn(batch, 2, 5), torch.randn(3, 7)
    t, index = 17 * torch.arange(batch) % timesteps, torch.arange(batch) % 3
    each = net(x, t, concepts, index)
    with torch.no_grad():
        together = net(x, t, concepts, index)
    torch.testing.assert_close(together, each, rtol=0, atol=0)
