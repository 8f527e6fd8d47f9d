"""Conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the paired concepts."""

from typing import Any

from ftl_lightning.domains.comparison import WITH_MODES
from ftl_lightning.training.method import Form, Method


def _model() -> type[Any]:
    from ftl_lightning.methods.cvae.model import VAEModel

    return VAEModel


def _pretraining() -> type[Any]:
    from ftl_lightning.methods.cvae.pretraining import VAEPretraining

    return VAEPretraining


METHOD = Method(
    name="CVAE",
    kind="cvae",
    model=_model,
    pretraining=_pretraining,
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/cvae",
)
