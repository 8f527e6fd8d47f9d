"""Fine-tuning our model by a low-rank adapter of all branches (LoRA, Hu et al., 2022), a baseline."""

from typing import Any

from ftl_lightning.domains.comparison import FINE_TUNED
from ftl_lightning.methods.ftl_igm import METHOD as OURS
from ftl_lightning.training.method import Method


def _adaptation() -> type[Any]:
    from ftl_lightning.methods.lora.adaptation import FineTuning

    return FineTuning


METHOD = Method(name=FINE_TUNED, kind=OURS.kind, adaptation=_adaptation, configurations="conf")
