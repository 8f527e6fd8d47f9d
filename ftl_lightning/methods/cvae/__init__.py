"""A conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the concepts it is paired with."""

from ftl_lightning.methods.method import Method

METHOD = Method(
    name="CVAE",
    kind="cvae",
    model="ftl_lightning.methods.cvae.model:VAEModel",
    pretraining="ftl_lightning.methods.cvae.pretraining:VAEPretraining",
    configurations="conf/cvae",
)
