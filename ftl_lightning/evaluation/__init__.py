"""Judging what is generated and executed: the evaluator callback, closed loop, reference lines, and the results file.

The evaluator is imported when it is asked for: executing plans and drawing animations do not need Lightning.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ftl_lightning.evaluation.evaluator import Evaluator

__all__ = ["Evaluator"]


def __getattr__(name: str) -> Any:
    if name == "Evaluator":
        from ftl_lightning.evaluation.evaluator import Evaluator

        return Evaluator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
