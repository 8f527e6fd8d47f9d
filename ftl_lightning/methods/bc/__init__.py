"""Goal-conditioned behaviour cloning (paper, 'Baselines' and 'Implementation Details')."""

from typing import Any

from ftl_lightning.domains.comparison import WITH_MODES
from ftl_lightning.training.method import Form, Method, check_present_or_moment


def _model() -> type[Any]:
    from ftl_lightning.methods.bc.model import CloningModel

    return CloningModel


def _pretraining() -> type[Any]:
    from ftl_lightning.methods.bc.pretraining import CloningPretraining

    return CloningPretraining


METHOD = Method(
    name="BC",
    kind="bc",
    model=_model,
    pretraining=_pretraining,
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/bc",
    suits=check_present_or_moment,
)
