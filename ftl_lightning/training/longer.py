"""Note about demonstrations that are longer than a model's training window."""

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.training.concept_model import ConceptModel


def longer_than_plans(demonstrations: Demonstrations, model: ConceptModel) -> str:
    """Note about the use of demonstrations that are longer than the model's plans.

    Empty if demonstrations are not longer, or in closed-loop domains with observations at every time, where a plan may start at
    any time.

    Args:
        demonstrations: demonstrations to learn from.
        model: pretrained model.
    """
    window, plans = model.window, model.domain.plans
    longest, shortest = int(demonstrations.lengths.max()), int(demonstrations.lengths.min())
    if longest <= window:
        return ""
    start = f"demonstrations of {'' if longest == shortest else 'up to '}{longest} steps are"
    if first := set(demonstrations.observed) - set(demonstrations.per_step):
        names = ", ".join(map(repr, sorted(first)))
        return (
            f"{start} cut to the model's horizon of {window}: the first {window} steps are learned from, "
            f"as {names} is known at the first time alone"
        )
    if demonstrations.observed and model.domain.closed_loop is not None and plans.exponent(window) == 1:
        return ""
    # The same exponent decides where windows start, see Demonstrations.starts.
    where = "anywhere" if plans.exponent(window) == 1 else "anywhere, mostly early"
    return (
        f"{start} longer than the model's horizon of {window}: they are learned from in stretches of {window} steps, which start "
        f"{where}; a plan has {model.config.horizon} steps"
    )
