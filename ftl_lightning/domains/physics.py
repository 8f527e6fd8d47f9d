"""pybullet, the physics of several domains."""

import functools
import importlib
import os
from typing import Any


@functools.cache
def pybullet() -> Any:
    """The simulator's module, imported when it is asked for first, without the line that this writes to standard error."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        return importlib.import_module("pybullet")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class Simulator:
    """pybullet's functions, each for one simulator of its own without a display.

    pybullet's own class for that prints a line for every simulator.
    """

    def __init__(self) -> None:
        self._id = pybullet().connect(pybullet().DIRECT)
        if self._id < 0:
            raise pybullet().error("no connection")

    def __getattr__(self, name: str) -> Any:
        return functools.partial(getattr(pybullet(), name), physicsClientId=self._id)
