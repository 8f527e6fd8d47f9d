"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer prompted with demonstrations."""

from typing import Any

from ftl_lightning.training.method import Method, check_present


def _model() -> type[Any]:
    from ftl_lightning.methods.in_context.model import InContextModel

    return InContextModel


def _pretraining() -> type[Any]:
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
