"""Resources of a cell, in terms of Ray and Slurm."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ftl_lightning.services.errors import UserError, shown

CPUS, GPUS, MEMORY = "cpus", "gpus", "memory_gb"
"""Resources of every cluster; others are custom resources of Ray."""
GIGABYTE = 10**9
_NAME = re.compile(r"[A-Za-z][\w.-]{0,63}")


@dataclass(frozen=True)
class Resources:
    """Resources of a cell.

    Attributes:
        cpus: number of processors; whole, or a fraction below 1.
        gpus: number of GPUs; likewise.
        memory_gb: gigabytes of 10^9 bytes; 0 for no request. Slurm enforces the limit, Ray does not.
        custom: custom resources of a Ray cluster by name, such as ``{'big': 1}`` of nodes started with it.
    """

    cpus: float = 1
    gpus: float = 0
    memory_gb: float = 0
    custom: Mapping[str, float] = field(default_factory=dict)

    def ray(self) -> dict[str, Any]:
        """Options of a Ray task."""
        options: dict[str, Any] = {"num_cpus": self.cpus, "num_gpus": self.gpus}
        if self.memory_gb:
            options["memory"] = int(self.memory_gb * GIGABYTE)
        return options | ({"resources": dict(self.custom)} if self.custom else {})

    def fit(self, node: Mapping[str, float]) -> bool:
        """Whether an idle node of a Ray cluster has these resources.

        Args:
            node: its resources, in Ray's names (memory in bytes).
        """
        needs = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory_gb * GIGABYTE, **self.custom}
        return all(node.get(name, 0) >= amount for name, amount in needs.items())

    def __str__(self) -> str:
        booked = {CPUS: self.cpus, GPUS: self.gpus, MEMORY: self.memory_gb, **self.custom}
        return ", ".join(f"{name} {amount:g}" for name, amount in booked.items() if amount) or "nothing"


def read_resources(asked: Mapping[str, Any], key: str = "resources") -> Resources:
    """Read resources from a configuration.

    Args:
        asked: amounts by name.
        key: key of the configuration, for messages.

    Raises:
        UserError: for an invalid name or amount.
    """
    for name, amount in asked.items():
        if not _NAME.fullmatch(name):
            raise UserError(f"{key}: expected {CPUS}, {GPUS}, {MEMORY} or a resource of the cluster's own, found {shown(name)}")
        number = isinstance(amount, int | float) and not isinstance(amount, bool) and math.isfinite(amount) and amount >= 0
        if not number or (name != MEMORY and amount > 1 and amount % 1):
            expected = "a number of 0 or more" if name == MEMORY else "a whole number of 0 or more, or a fraction of 1"
            raise UserError(f"{key}.{name}: expected {expected}, found {shown(amount)}")
    custom = {name: amount for name, amount in asked.items() if name not in (CPUS, GPUS, MEMORY)}
    return Resources(asked.get(CPUS, 1), asked.get(GPUS, 0), asked.get(MEMORY, 0), custom)
