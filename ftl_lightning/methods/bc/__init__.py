"""Goal-conditioned behaviour cloning (paper, 'Baselines' and 'Implementation Details')."""

from ftl_lightning.domains.comparison import WITH_MODES
from ftl_lightning.training.method import Form, Method

METHOD = Method(
    name="BC",
    kind="bc",
    model="ftl_lightning.methods.bc.model:CloningModel",
    pretraining="ftl_lightning.methods.bc.pretraining:CloningPretraining",
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/bc",
    suits="ftl_lightning.training.transitions:check_present_or_moment",
)
