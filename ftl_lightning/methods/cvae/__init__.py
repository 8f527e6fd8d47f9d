"""Conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the paired concepts."""

from ftl_lightning.domains.comparison import WITH_MODES
from ftl_lightning.training.method import Form, Method

METHOD = Method(
    name="CVAE",
    kind="cvae",
    model="ftl_lightning.methods.cvae.model:VAEModel",
    pretraining="ftl_lightning.methods.cvae.pretraining:VAEPretraining",
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/cvae",
)
