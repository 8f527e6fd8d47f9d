"""Our method (the paper's FTL-IGM): a conditional diffusion model whose concepts are learned by gradient descent."""

from typing import Any

from ftl_lightning.domains.comparison import OURS, WITH_ADAPTER, WITH_KNOTS, WITH_MODES
from ftl_lightning.training.method import Form, Method


def _model() -> type[Any]:
    from ftl_lightning.methods.ftl_igm.model import GenerativeModel

    return GenerativeModel


def _pretraining() -> type[Any]:
    from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule

    return PretrainingModule


METHOD = Method(
    name=OURS,
    kind="diffusion",
    model=_model,
    pretraining=_pretraining,
    forms=(Form(WITH_MODES, "modes", 1), Form(WITH_KNOTS, "knots", 1), Form(WITH_ADAPTER, "adapter", 0)),
    configurations="conf",
)
