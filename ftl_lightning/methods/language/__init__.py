"""Language (paper, 'Conditioning on Language Descriptions of New Concepts'): our model, conditioned on task descriptions."""

from ftl_lightning.methods.ftl_igm import METHOD as OURS
from ftl_lightning.training.method import Method

METHOD = Method(
    name="language",
    kind=OURS.kind,
    adaptation="ftl_lightning.methods.language.adaptation:LanguageAdaptation",
    configurations="conf",
)
