"""Language (paper, 'Conditioning on Language Descriptions of New Concepts'): our model, conditioned on task descriptions."""

from typing import Any

from ftl_lightning.methods.ftl_igm import METHOD as OURS
from ftl_lightning.training.method import Method


def _adaptation() -> type[Any]:
    from ftl_lightning.methods.language.adaptation import LanguageAdaptation

    return LanguageAdaptation


METHOD = Method(name="language", kind=OURS.kind, adaptation=_adaptation, configurations="conf")
