"""Random generators by key: draws do not depend on earlier draws, so a resumed run repeats an unbroken run."""

import zlib

import numpy as np
import torch

VALIDATION_SEED = 1_000_000
"""Seed offset of held-out demonstrations."""
DEMONSTRATION_SEED = 2_000_000
"""Seed offset of new tasks' demonstrations, so that they share no random stream with pretraining."""
EVALUATION_SEED = 3_000_000
"""Seed offset of new initial states, so that they share no random stream with demonstrations."""
FRESH_SEED = 4_000_000
"""Seed offset of fresh behaviour of a task, for comparison with generated behaviour, independent of training data."""


def generator(device: torch.device | str, *key: int) -> torch.Generator:
    """Random generator seeded by a key, for example ``(seed, step)``.

    Args:
        device: device of the generator.
        key: non-negative integers, which are mixed, since torch keeps 32 bits of a seed on CPUs.
    """
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    return torch.Generator(device=device).manual_seed(seed)


def task_key(task: str) -> int:
    """Hash of a task for a key: equal on every machine, and collisions are rare."""
    return zlib.crc32(task.encode())
