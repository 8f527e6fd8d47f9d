"""Count the operations, moved bytes, calls, and bytes saved for the backward pass of a computation.

Operations are torch's count (``FlopCounterMode``). On the meta device, computations that exceed the memory can be counted too.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from operator_time import Call, call
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

NEAR = 2**20
"""Bytes that a call may touch to count as near: a core's own cache holds them."""
PRODUCTS = ("aten.mm", "aten.addmm", "aten.bmm", "aten.baddbmm")
BENT = (
    "mish",
    "silu",
    "sigmoid",
    "tanh",
    "exp",
    "sin",
    "cos",
    "log",
    "softmax",
    "normal",
    "random",
    "uniform",
    "group_norm",
    "softplus",
)
"""Parts of the names of operators that take more time to compute than to move."""


@dataclass(frozen=True)
class Counted:
    """What a computation costs.

    Attributes:
        products: floating-point operations of matrix products.
        convolutions: of convolutions forward.
        gradients: of convolutions backward.
        near: bytes read and written by all other calls, of those that touch at most :data:`NEAR`.
        far: of the others.
        read: bytes read and written by products.
        kernels: by convolutions, whose weights are put into another order at each call.
        calls: of operators that compute something.
        recorded: of these, those that autograd takes note of.
        backward: those of the backward pass.
        saved: bytes kept for the backward pass, parameters apart.
        heavy: products, convolutions and calls of :data:`BENT`, how often each.
    """

    products: float
    convolutions: float
    gradients: float
    near: float
    far: float
    read: float
    kernels: float
    calls: int
    recorded: int
    backward: int
    saved: int
    heavy: Mapping[Call, int]

    @property
    def operations(self) -> float:
        """All floating-point operations that torch counts."""
        return self.products + self.convolutions + self.gradients

    @property
    def moved(self) -> float:
        """All bytes read and written."""
        return self.near + self.far + self.read + self.kernels


class _Calls(TorchDispatchMode):
    """Counts calls and the bytes they touch; views touch none."""

    def __init__(self) -> None:
        super().__init__()
        self.near = self.far = self.read = self.kernels = 0.0
        self.calls = self.recorded = self.backward = 0
        self.heavy = Counter[Call]()

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: tuple[Any, ...] = (), options: Mapping[str, Any] | None = None
    ) -> Any:
        found = function(*arguments, **(options or {}))
        returns = function._schema.returns
        view = any(one.alias_info is not None and not one.alias_info.is_write for one in returns)
        if view or function is torch.ops.aten._unsafe_view.default:
            return found
        tensors = [*_tensors(arguments), *_tensors((options or {}).values()), *_tensors([found])]
        size = sum(one.numel() * one.element_size() for one in tensors)
        name = str(function)
        self.calls += 1
        if torch._C._current_graph_task_id() >= 0:
            self.backward += 1
        elif torch.is_grad_enabled():
            self.recorded += 1
        if name.startswith(PRODUCTS):
            self.read += size
        elif "convolution" in name:
            self.kernels += size
        elif size <= NEAR:
            self.near += size
        else:
            self.far += size
        if name.startswith(PRODUCTS) or "convolution" in name or any(word in name for word in BENT):
            self.heavy[call(function, arguments, options or {})] += 1
        return found


def _tensors(values: Iterable[Any]) -> list[Tensor]:
    """Those among arguments or results, also in lists."""
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, list | tuple):
            found += _tensors(value)
    return found


def counted(work: Callable[[], Any], parameters: Iterable[Tensor] = ()) -> Counted:
    """What a computation costs.

    Args:
        work: it, with its backward pass if it has one. It is run once.
        parameters: that are no activations where they are kept for the backward pass.
    """
    known = {parameter.untyped_storage()._cdata for parameter in parameters}
    kept: dict[int, tuple[Any, int]] = {}  # storages stay alive, or an address could come twice

    def keep(value: Tensor) -> Tensor:
        storage = value.untyped_storage()
        if storage._cdata not in known:
            kept[storage._cdata] = storage, storage.nbytes()
        return value

    with FlopCounterMode(display=False) as operations, _Calls() as calls, saved_tensors_hooks(keep, lambda value: value):
        work()
    by_name = {str(name): float(count) for name, count in operations.get_flop_counts().get("Global", {}).items()}
    backward = sum(count for name, count in by_name.items() if "convolution_backward" in name)
    forward = sum(count for name, count in by_name.items() if "convolution" in name) - backward
    return Counted(
        products=sum(by_name.values()) - forward - backward,
        convolutions=forward,
        gradients=backward,
        near=calls.near,
        far=calls.far,
        read=calls.read,
        kernels=calls.kernels,
        calls=calls.calls,
        recorded=calls.recorded,
        backward=calls.backward,
        saved=sum(size for _, size in kept.values()),
        heavy=calls.heavy,
    )


def told(count: Counted) -> dict[str, float]:
    """For a file."""
    numbers = {field.name: getattr(count, field.name) for field in fields(count) if field.name != "heavy"}
    return {name: round(value) for name, value in numbers.items()}
