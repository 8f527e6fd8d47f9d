"""Functions that are imported when they are called."""

import importlib
from collections.abc import Callable
from typing import Any


def deferred(reference: str) -> Callable[..., Any]:
    """A function that is imported when it is called first, such as one that draws: matplotlib takes half a second to import.

    Args:
        reference: ``'package.module:function'``.
    """
    module, _, name = reference.partition(":")
    return lambda *arguments: getattr(importlib.import_module(module), name)(*arguments)
