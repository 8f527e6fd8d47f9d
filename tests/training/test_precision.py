"""Learning with products in bfloat16."""

from pathlib import Path

import pytest
import torch

from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.settings import BudgetOptions, InversionSettings
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import load_model


@pytest.mark.parametrize(
    "options",
    [{}, pytest.param({"modes": "each"}, marks=pytest.mark.slow), pytest.param({"adapter": 2}, marks=pytest.mark.slow)],
    ids=["one set", "modes", "adapter"],
)
def test_products_in_bfloat16_learn_the_same_concept_but_for_their_rounding(tiny: Path, options: dict[str, object]) -> None:
    model, data = load_model(str(tiny)), InversionData("object_rearrangement", suite="validation").demonstrations
    settings, steps = InversionSettings().changed(samples=16, **options), 60
    one = data.select(data.concepts[0])
    full = invert(model, one, settings, steps)[data.concepts[0]]
    losses: list[float] = []
    reduced = invert(model, one, settings.changed(precision="bf16-mixed"), steps, losses.append)[data.concepts[0]]
    start = invert(model, one, settings, 1)[data.concepts[0]]
    assert reduced.embeddings.dtype == torch.float32
    assert not torch.equal(reduced.embeddings, full.embeddings)
    moved, apart = (full.embeddings - start.embeddings).norm(), (full.embeddings - reduced.embeddings).norm()
    assert 0 < apart < moved / 5
    assert abs(reduced.origin.loss - full.origin.loss) < (start.origin.loss - full.origin.loss) / 20  # both in single precision


def test_another_precision_is_refused() -> None:
    with pytest.raises(UserError, match=r"model\.budget\.precision: expected one of 32-true, bf16-mixed, found '16'"):
        BudgetOptions(precision="16")  # type: ignore[arg-type]
