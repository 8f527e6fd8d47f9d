"""Demonstrations that are longer than what a model learns from at once: what becomes of them, in words."""

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.learning.concept_model import ConceptModel


def longer_than_plans(demonstrations: Demonstrations, model: ConceptModel) -> str:
    """One sentence that says what is learned from demonstrations that are longer than the model's plans.

    Empty where they are not longer, and where that is as it should be: in domains that observe at every time and plan anew while
    they go on, a plan is a stretch of behaviour that starts anywhere.

    Args:
        demonstrations: to learn from.
        model: to learn through.
    """
    window, plans = model.window, model.domain.plans
    longest, shortest = int(demonstrations.lengths.max()), int(demonstrations.lengths.min())
    if longest <= window:
        return ""
    told = f"demonstrations of {'' if longest == shortest else 'up to '}{longest} steps are"
    if first := set(demonstrations.observed) - set(demonstrations.per_step):
        names = ", ".join(map(repr, sorted(first)))
        return (
            f"{told} cut to the model's horizon of {window}: the first {window} steps are learned from, "
            f"as {names} is known at the first time alone"
        )
    if demonstrations.observed and model.domain.closed_loop is not None and plans.exponent(window) == 1:
        return ""
    # The same exponent decides where windows start, see Demonstrations.starts.
    where = "anywhere" if plans.exponent(window) == 1 else "anywhere, mostly early"
    return (
        f"{told} longer than the model's horizon of {window}: they are learned from in stretches of {window} steps, which start "
        f"{where}; a plan has {model.config.horizon} steps"
    )
