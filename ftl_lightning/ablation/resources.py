"""What a cell asks of the machine that runs it, in the words of Ray and of Slurm."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ftl_lightning.errors import UserError, shown

CPUS, GPUS, MEMORY = "cpus", "gpus", "memory_gb"
"""Names that every cluster knows; others are a Ray cluster's own."""
GIGABYTE = 10**9
_NAME = re.compile(r"[A-Za-z][\w.-]{0,63}")


@dataclass(frozen=True)
class Resources:
    """What one cell books.

    Attributes:
        cpus: processors; whole, or a fraction below 1.
        gpus: likewise.
        memory_gb: gigabytes of 10^9 bytes; 0 for no wish. Ray books them and does not watch them, Slurm does.
        custom: a Ray cluster's own resources by name, such as ``{'big': 1}`` of nodes started with that resource.
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
        """Whether a node of a Ray cluster has room when nothing else runs on it.

        Args:
            node: what it has, in Ray's names (memory in bytes).
        """
        needs = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory_gb * GIGABYTE, **self.custom}
        return all(node.get(name, 0) >= amount for name, amount in needs.items())

    def __str__(self) -> str:
        booked = {CPUS: self.cpus, GPUS: self.gpus, MEMORY: self.memory_gb, **self.custom}
        return ", ".join(f"{name} {amount:g}" for name, amount in booked.items() if amount) or "nothing"


def read_resources(asked: Mapping[str, Any], key: str = "resources") -> Resources:
    """Resources as a configuration names them.

    Args:
        asked: amounts by name.
        key: where they stand, for messages.

    Raises:
        UserError: for a name that is none, or an amount that cannot be booked.
    """
    for name, amount in asked.items():
        if not _NAME.fullmatch(name):
            raise UserError(f"{key}: expected {CPUS}, {GPUS}, {MEMORY} or a resource of the cluster's own, found {shown(name)}")
        number = isinstance(amount, int | float) and not isinstance(amount, bool) and math.isfinite(amount) and amount >= 0
        if not number or (name != MEMORY and amount > 1 and amount % 1):
            expected = "a number of 0 or more" if name == MEMORY else "a whole number of 0 or more, or a fraction of 1"
            raise UserError(f"{key}.{name}: expected {expected}, found {shown(amount)}")
    own = {name: amount for name, amount in asked.items() if name not in (CPUS, GPUS, MEMORY)}
    return Resources(asked.get(CPUS, 1), asked.get(GPUS, 0), asked.get(MEMORY, 0), own)
