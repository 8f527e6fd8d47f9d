"""Goal-conditioned behaviour cloning (paper, 'Baselines' and 'Implementation Details')."""

from ftl_lightning.methods.method import Method

METHOD = Method(
    name="BC",
    kind="bc",
    model="ftl_lightning.methods.bc.model:CloningModel",
    pretraining="ftl_lightning.methods.bc.pretraining:CloningPretraining",
    configurations="conf/bc",
)
