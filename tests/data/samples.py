import torch

from ftl_lightning.data.demonstrations import Demonstrations


def demonstrations(states: torch.Tensor, **changes: object) -> Demonstrations:
    count, time, columns = states.shape
    values = {
        "states": states,
        "lengths": torch.full((count,), time),
        "domain": "object_rearrangement",
        "state_names": tuple(f"s{i}" for i in range(columns)),
        "state_units": ("m",) * columns,
        "concepts": tuple(f"task {i % 2}" for i in range(count)),
    }
    return Demonstrations(**(values | changes))  # type: ignore[arg-type]
