"""Randomness as a function of a key: nothing depends on what was drawn before, so a resumed run repeats the unbroken one."""

import zlib

import numpy as np
import torch

VALIDATION_SEED = 1_000_000
"""Added to the seed of held-out demonstrations."""
DEMONSTRATION_SEED = 2_000_000
"""Added to the seed of new tasks' demonstrations, so that they share no random stream with pretraining."""
EVALUATION_SEED = 3_000_000
"""Added to the seed of new initial states, so that they share no random stream with demonstrations."""
FRESH_SEED = 4_000_000
"""Added to the seed of fresh behaviour of a task, which generated behaviour is compared with: independent of all that was seen."""


def generator(device: torch.device | str, *key: int) -> torch.Generator:
    """A generator that the key alone decides, for example ``(seed, step)``.

    Args:
        device: where it draws.
        key: non-negative integers. They are mixed, since torch keeps 32 bits of a seed on CPUs.
    """
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    return torch.Generator(device=device).manual_seed(seed)


def task_key(task: str) -> int:
    """A task as part of a key: the same number on every machine, and hardly ever another task's."""
    return zlib.crc32(task.encode())
