"""Importing what is large, quickly."""

import gc
import importlib
import sys
from types import ModuleType


def imported(name: str) -> ModuleType:
    """A module that imports large libraries, imported without looking for garbage between their objects.

    Modules, classes and functions stay until the process ends. Python would look through all of them again and again while their
    number grows, which takes a sixth of the time that Lightning takes to import, and again in every full collection afterwards.

    Args:
        name: of the module; one that is imported already is returned as it is.
    """
    if name in sys.modules:
        return sys.modules[name]
    was = gc.isenabled()
    gc.disable()
    try:
        found = importlib.import_module(name)
        gc.freeze()
    finally:
        if was:
            gc.enable()
    return found
