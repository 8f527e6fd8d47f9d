"""Check of demonstrations against the scale of pretraining."""

from collections.abc import Iterator

import torch
from torch import Tensor

from ftl_lightning.data.check import Finding
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import moved
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.training.concept_model import ConceptModel

MARGIN = 0.05
"""Tolerated excess, as a share of half a column's pretraining range."""
MANY, FAR = 0.25, 3.0
"""Warning thresholds: share of values outside the range, and maximum normalised value."""


@torch.no_grad()
def scale_findings(model: ConceptModel, demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """Warn if many values of states or observed vectors are outside the pretraining range, or some are far outside.

    Args:
        model: pretrained model.
        demonstrations: demonstrations that fit the model.
    """
    return tuple(_scale(model, demonstrations))


def outside(model: ConceptModel, demonstrations: Demonstrations) -> Tensor:
    """Normalised states ``(state, time)``, in consecutive windows from each demonstration's start."""
    rows, starts = [], []
    for row, length in enumerate(demonstrations.lengths.tolist()):
        first = set(demonstrations.observed) - set(demonstrations.per_step)
        begins = [0] if first else list(range(0, max(length - model.window, 0) + 1, max(model.window, 1)))
        rows += [row] * len(begins)
        starts += begins
    states, observed = demonstrations.windows(torch.tensor(rows), torch.tensor(starts), model.window)
    encoded: Tensor = model.encode(states.to(model.device), moved(observed, model.device))
    return encoded.flatten(0, 1).T.cpu()


def _scale(model: ConceptModel, demonstrations: Demonstrations) -> Iterator[Finding]:
    columns, view = model.domain.plans.columns, model.view
    values = outside(model, demonstrations).abs()
    named = view is None or view.same_columns
    names = columns if named and len(columns) == len(values) else [f"{column} of the model's view" for column in range(len(values))]
    yield from _range_finding("states", values, names)
    if model.initial_normalization is not None:
        try:
            seen = model.vector(moved(demonstrations.initial_states.observed, model.device))
        except UserError:  # reported elsewhere
            return
        if seen is not None:
            size = len(model.initial_normalization.low)
            vectors = seen[:, :size].abs().T.cpu()
            yield from _range_finding("observed vectors", vectors, [f"number {number}" for number in range(size)])
    if named and len(columns) == len(values):
        low, high = model.normalization.low.cpu(), model.normalization.high.cpu()
        every = torch.cat([states[:length] for states, length in zip(demonstrations.states, demonstrations.lengths, strict=True)])
        resolution = max(model.domain.plans.resolution, 1e-3)
        differs = (every - low).abs().amax(dim=0) > resolution * low.abs().clamp(min=1)
        lost = [name for name, hidden in zip(columns, ((high <= low) & differs).tolist(), strict=True) if hidden]
        if lost:
            text = short(", ".join(lost), 60)
            yield Finding(f"scale: what is different here was constant in pretraining, so the model does not see it: {text}")


def _range_finding(what: str, values: Tensor, names: "list[str] | tuple[str, ...]") -> Iterator[Finding]:
    beyond = values > 1 + MARGIN
    share, worst = float(beyond.float().mean()), beyond.float().mean(dim=1)
    column = int(worst.argmax()) if float(values.max()) <= FAR else int(values.amax(dim=1).argmax())
    most = float(values[column].max())
    message = f"scale: {100 * share:.0f} % of the {what} are outside of the range seen in pretraining"
    if beyond.any():
        message += f", most in {short(names[column], 40)} ({100 * float(worst[column]):.0f} %, up to {most:.1f} times the range)"
    yield Finding(message, "warning" if share > MANY or most > FAR else "note")
