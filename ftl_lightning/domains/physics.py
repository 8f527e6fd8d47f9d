"""pybullet, the physics simulator of several domains."""

import functools
import importlib
import os
from typing import Any


@functools.cache
def pybullet() -> Any:
    """Import pybullet on first use, without the line it writes to standard error."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        return importlib.import_module("pybullet")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class Simulator:
    """pybullet's functions, bound to a separate simulator without a display.

    pybullet's class for this purpose prints a line per simulator.
    """

    def __init__(self) -> None:
        self._id = pybullet().connect(pybullet().DIRECT)
        if self._id < 0:
            raise pybullet().error("no connection")

    def __getattr__(self, name: str) -> Any:
        return functools.partial(getattr(pybullet(), name), physicsClientId=self._id)
