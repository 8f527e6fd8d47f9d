"""Plans as cosines over time: the transform itself, its scales, and what it does to a model's plans."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.diffusion import Prediction
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.spectrum import Spectrum
from ftl_lightning.training.data import OwnData
from ftl_lightning.training.trainer import Trainer


def paths(count: int) -> Tensor:
    return torch.from_numpy(strokes("wave", count, 0))


def test_a_fitted_spectrum_puts_out_plans_of_the_means_and_spreads_that_it_saw_with_smoother_errors_than_in_states() -> None:
    spectrum, plans = Spectrum(40, 2), paths(200)
    spectrum.fit(plans)
    mean = spectrum(torch.zeros(1, 40, 2))[0]
    assert torch.allclose(mean, plans.mean(dim=0), atol=1e-4)
    coefficients = torch.einsum("ct,pts->pcs", spectrum.basis, plans)
    back = spectrum((coefficients - spectrum.mean) / spectrum.scale)
    assert torch.allclose(back, plans, atol=1e-4)
    drawn = spectrum(torch.randn(4000, 40, 2, generator=torch.Generator().manual_seed(0)))
    assert drawn.std(dim=0).mean() == pytest.approx(float(plans.std(dim=0).mean()), rel=0.1)
    error = torch.randn(500, 40, 2, generator=torch.Generator().manual_seed(1))

    def roughness(noise: Tensor) -> float:
        return float(noise.diff(n=2, dim=1).square().mean().sqrt() / noise.square().mean().sqrt())

    assert roughness(spectrum(error) - spectrum(torch.zeros_like(error))) < 0.2 * roughness(error)


def test_what_does_not_vary_stays_as_it_is() -> None:
    plans = torch.cat((paths(20), torch.full((20, 40, 1), 3.0)), dim=2)
    spectrum = Spectrum(40, 3)
    spectrum.fit(plans)
    assert torch.allclose(spectrum(torch.randn(5, 40, 3))[..., 2], torch.tensor(3.0), atol=1e-4)
    single = Spectrum(1, 3)
    single.fit(plans[:, :1])
    assert single(torch.ones(2, 1, 3)).isfinite().all()


def test_a_model_of_cosines_keeps_its_scales_in_its_folder() -> None:
    kinds = ("line", "wave")
    np.savez("strokes.npz", states=np.concatenate([strokes(kind, 20, 0) for kind in kinds]), concepts=np.repeat(kinds, 20))

    def fit(**options: Any) -> None:
        quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "limit_val_batches": 0}
        data = OwnData("strokes.npz", encoder="hashing", batch_size=8, steps_per_epoch=2)
        module = PretrainingModule(prediction="cosines", output="made", **options)
        Trainer(max_steps=2, accelerator="cpu", **quiet).fit(module, data)

    fit(denoiser_args={"hidden_dim": 16, "depth": 2, "condition_dim": 16})
    denoiser = FewShot.from_pretrained("made").model.denoiser
    assert isinstance(denoiser, Prediction)
    assert (denoiser.spectrum.scale[0] > 5 * denoiser.spectrum.scale[20]).all()  # slow cosines vary more than fast ones
    expected = "prediction: expected clean for TemporalUNet, whose output is smooth by itself, found cosines"
    with pytest.raises(UserError, match=expected):
        fit(denoiser="TemporalUNet", denoiser_args={"width": 8})
