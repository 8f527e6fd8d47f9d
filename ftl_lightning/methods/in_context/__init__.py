"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer prompted with demonstrations."""

from typing import TYPE_CHECKING, Any

from ftl_lightning.training.method import Method, check_present

if TYPE_CHECKING:
    from ftl_lightning.training.concept_model import ConceptModel
    from ftl_lightning.training.pretraining import Pretraining


def _model() -> "type[ConceptModel]":
    from ftl_lightning.methods.in_context.model import InContextModel

    return InContextModel


def _pretraining() -> "type[Pretraining[Any]]":
    from ftl_lightning.methods.in_context.pretraining import InContextPretraining

    return InContextPretraining


METHOD = Method(
    name="in-context",
    kind="in-context",
    model=_model,
    pretraining=_pretraining,
    configurations="conf/in_context",
    suits=check_present,
)
