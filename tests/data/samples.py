"""Demonstrations for tests, and their comparison."""

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


LENGTHS = (5, 3, 4, 5, 2, 5)


def everything(lengths: tuple[int, ...] = LENGTHS) -> Demonstrations:
    """Of different lengths, padded with the last state, with features of every kind, scenes, names and texts."""
    draw = torch.Generator().manual_seed(0)
    count, time = len(lengths), max(lengths)

    def padded(values: torch.Tensor) -> torch.Tensor:
        for row, length in enumerate(lengths):
            values[row, length:] = values[row, length - 1]
        return values

    return Demonstrations(
        padded(torch.rand(count, time, 2, generator=draw)),
        torch.tensor(lengths),
        "a domain",
        ("x", "y"),
        ("m", "m/s"),
        tuple(("go up", "go dówn")[row % 2] for row in range(count)),
        {
            "wind": padded(torch.rand(count, time, 3, generator=draw)),
            "goal": torch.rand(count, 1, generator=draw),
            "grid": torch.rand(count, 2, 3, generator=draw),
            "view": padded(torch.randint(0, 256, (count, time, 3, 4, 4), dtype=torch.uint8, generator=draw)),
        },
        ("wind", "view"),
        torch.rand(count, 4, generator=draw),
        {"generator": "a test", "seed": 0},
    )


def expect_same(found: Demonstrations, expected: Demonstrations, provenance: bool = True) -> None:
    """Every number, text and type is the same."""
    assert found.tensors.keys() == expected.tensors.keys()
    for key, values in expected.tensors.items():
        assert found.tensors[key].dtype == values.dtype, key
        assert torch.equal(found.tensors[key], values), key
    for name in ("domain", "state_names", "state_units", "concepts", "per_step", *(("provenance",) if provenance else ())):
        assert getattr(found, name) == getattr(expected, name), name
