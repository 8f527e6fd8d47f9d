"""Functions imported when called."""

import importlib
from collections.abc import Callable
from typing import Any


def deferred(reference: str) -> Callable[..., Any]:
    """Function imported at its first call, such as a plot: importing matplotlib takes half a second.

    Args:
        reference: ``'package.module:function'``.
    """
    module, _, name = reference.partition(":")
    return lambda *arguments: getattr(importlib.import_module(module), name)(*arguments)
