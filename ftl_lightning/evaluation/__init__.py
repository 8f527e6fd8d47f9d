"""Evaluation: the evaluator callback, closed-loop execution, reference lines, and results files.

The evaluator is imported lazily: executing plans and drawing animations do not need Lightning.
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
