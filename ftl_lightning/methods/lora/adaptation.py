"""Fine-tuning the whole denoiser by a low-rank adapter."""

from dataclasses import replace
from typing import Any

from ftl_lightning.igm.settings import AdapterOptions
from ftl_lightning.training.inversion_module import InversionModule

_WHOLE = AdapterOptions(rank=4, scope="all")


class FineTuning(InversionModule):
    """Learns a concept with an adapter of every branch of a composition, including the unconditional.

    Args:
        pretrained: folder of the pretrained model.
        adapter: rank and learning rate; the scope is always ``'all'``.
        options: see :class:`~ftl_lightning.training.inversion_module.InversionModule`.
    """

    def __init__(self, pretrained: str, adapter: AdapterOptions = _WHOLE, **options: Any) -> None:
        super().__init__(pretrained, adapter=replace(adapter, scope="all"), **options)
