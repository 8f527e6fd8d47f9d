"""Conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the paired concepts."""

from typing import TYPE_CHECKING, Any

from ftl_lightning.domains.comparison import WITH_MODES
from ftl_lightning.training.method import Form, Method

if TYPE_CHECKING:
    from ftl_lightning.training.concept_model import ConceptModel
    from ftl_lightning.training.pretraining import Pretraining


def _model() -> "type[ConceptModel]":
    from ftl_lightning.methods.cvae.model import VAEModel

    return VAEModel


def _pretraining() -> "type[Pretraining[Any]]":
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
