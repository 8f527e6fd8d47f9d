"""Language (paper, 'Conditioning on Language Descriptions of New Concepts'): our model, conditioned on task descriptions."""

from ftl_lightning.learning.method import Method
from ftl_lightning.methods.ftl_igm import METHOD as OURS

METHOD = Method(
    name="language",
    kind=OURS.kind,
    adaptation="ftl_lightning.methods.language.adaptation:LanguageAdaptation",
    configurations="conf",
)
