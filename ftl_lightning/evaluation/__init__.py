"""Evaluators as callbacks, and the results file."""

from ftl_lightning.evaluation.evaluator import Evaluator

__all__ = ["Evaluator"]
