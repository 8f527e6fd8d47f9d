"""Callback that logs the learning rate."""

import re
from typing import Any

import lightning.pytorch as pl
from torch.optim import Optimizer

TAG = "optimizer/learning rate"


class LearningRate(pl.Callback):
    """Logs the learning rate of each step.

    An optimiser with several parameter groups has a curve for each name of a group's first parameter, without numbers, since
    adapters have a group for every factor.
    """

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer) -> None:
        """Log the rates of the next step."""
        pl_module.log_dict(rates(pl_module, optimizer), on_step=True, on_epoch=False)


def rates(module: pl.LightningModule, optimizer: Optimizer) -> dict[str, float]:
    """Learning rates by tag.

    Args:
        module: module with the parameters.
        optimizer: optimiser of the parameters.
    """
    groups: list[dict[str, Any]] = optimizer.param_groups
    if len(groups) == 1:
        return {TAG: float(groups[0]["lr"])}
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    return {f"{TAG}/{_label(names.get(id(group['params'][0]), 'others'))}": float(group["lr"]) for group in groups}


def _label(name: str) -> str:
    return re.sub(r"\.\d+(?=\.|$)", "", name)
