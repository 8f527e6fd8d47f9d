"""Figures of concepts: a map of embeddings, and the check of demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ftl_lightning.data.check import distances
from ftl_lightning.igm.concept import Concept
from ftl_lightning.reporting.figures import COLOURS, PAPER_COLOUR
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.text import figure_text
from ftl_lightning.training.checks import Check
from ftl_lightning.training.concept_model import ConceptModel

MOST = 20  # maximum number of concepts in the figure of a check
GOOD, OUTLYING = "#3f6fb5", "#d03a3a"


@dataclass(frozen=True)
class Place:
    """An embedding in the plane; ``component`` is ``'k1'`` for a concept's first, empty for a training concept."""

    concept: str
    component: str
    x: float
    y: float

    @property
    def name(self) -> str:
        """Concept, with component in brackets."""
        return f"{self.concept} [{self.component}]" if self.component else self.concept


def concept_places(model: ConceptModel, concepts: Sequence[Concept], seed: int = 0) -> list[Place]:
    """t-SNE of training concepts and learned components (paper, figure 'tsne'; van der Maaten & Hinton, 2008), in this order. Raise
    UserError if scikit-learn is missing.
    """
    check_extra("notebooks", "concept_map")
    from sklearn.manifold import TSNE

    learned = [
        (concept.origin.name, name.replace("component ", ""), part.embedding)
        for concept in concepts
        for name, part in concept.parts().items()
        if part.mode is None  # modes would be five times as many near-copies
    ]
    embeddings = torch.cat((model.training_embeddings.cpu(), *(embedding[None] for *_, embedding in learned)))
    perplexity = min(10.0, (len(embeddings) - 1) / 3)
    points = TSNE(perplexity=perplexity, init="pca", random_state=seed).fit_transform(embeddings.numpy())
    names = [*((name, "") for name in model.config.training_concepts), *((name, part) for name, part, _ in learned)]
    return [Place(*name, float(x), float(y)) for name, (x, y) in zip(names, points, strict=True)]


def concept_map(model: ConceptModel, concepts: Sequence[Concept], seed: int = 0) -> Figure:
    """Plot training concepts and learned components; arguments and errors as in :func:`concept_places`."""
    places = concept_places(model, concepts, seed)
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots()
    kinds = (False, PAPER_COLOUR, "o", "training concepts"), (True, COLOURS[0], "^", "learned components")
    for learned, colour, mark, label in kinds:
        shown = [place for place in places if bool(place.component) == learned]
        axes.scatter([place.x for place in shown], [place.y for place in shown], color=colour, marker=mark, label=label)
    for place in places:
        axes.annotate(figure_text(place.name), (place.x, place.y), fontsize=6, xytext=(3, 3), textcoords="offset points")
    axes.set(xticks=[], yticks=[], title=figure_text(f"{model.config.domain}: concepts, t-SNE"))
    axes.legend(fontsize=8)
    return figure


def check_figure(checks: Sequence[Check]) -> Figure:
    """Plot demonstrations, distances and leave-one-out losses, outliers in red; a row for each of :data:`MOST` concepts at most."""
    shown = checks[:MOST]
    columns = 2 + 2 * any(check.left_out for check in shown)
    figure = Figure(figsize=(3.2 * columns, 3.0 * len(shown)), layout="constrained")
    for check, row in zip(shown, figure.subplots(len(shown), columns, squeeze=False), strict=True):
        outlier = {number for finding in check.warnings for number in finding.rows}
        outlier |= set() if check.left_out is None or check.left_out.outlier is None else {check.left_out.outlier}
        _behaviour(row[0], check, outlier)
        _distances(row[1], check)
        if check.left_out is not None:
            left, curve = check.left_out.left_out, check.left_out.curve
            numbers = range(1, len(left) + 1)
            row[2].bar(numbers, left, color=[OUTLYING if number - 1 in outlier else GOOD for number in numbers])
            row[2].axhline(1, color="black", linewidth=0.8, linestyle="dotted")
            row[2].set(title="loss when left out", xlabel="demonstration", ylabel="of the unconditional loss", xticks=[*numbers])
            row[3].plot([*curve], [*curve.values()], ".-", color=GOOD)
            row[3].set(title="loss of those left out", xlabel="learned from", xticks=[*curve])
        for axes in row[2:] if check.left_out is None else ():
            axes.set_axis_off()
        for axes in row:
            axes.title.set_fontsize(9)
            axes.tick_params(labelsize=7)
    return figure


def _behaviour(axes: Axes, check: Check, outlier: set[int]) -> None:
    """Paths of the first two columns for 2 or 3 columns; else distances from the start over time, or single states."""
    demos = check.demonstrations
    scale = demos.states.flatten(0, 1).std(dim=0).clamp(min=1e-12)
    for number, (states, length) in enumerate(zip(demos.states, demos.lengths.tolist(), strict=True)):
        colour = OUTLYING if number in outlier else GOOD
        if states.shape[1] in (2, 3) and length > 1:
            axes.plot(*states[:length, :2].T.numpy(), color=colour, linewidth=1)
            where = states[length - 1, :2].tolist()
        elif length > 1:  # distance from the first state, columns scaled
            moved = ((states[:length] - states[0]) / scale).square().mean(dim=1).sqrt()
            axes.plot(moved.numpy(), color=colour, linewidth=1)
            where = [length - 1, float(moved[-1])]
        else:
            centred = (states[0] - demos.states[:, 0].mean(dim=0)) / scale
            axes.plot(centred.numpy(), ".", color=colour)
            where = [len(centred) - 1, float(centred[-1])]
        axes.annotate(str(number + 1), (where[0], where[1]), fontsize=7, color=colour)
    axes.set(title=figure_text(check.name))


def _distances(axes: Axes, check: Check) -> None:
    gaps = distances(check.demonstrations)
    axes.imshow(gaps.numpy(), cmap="Blues")
    numbers = range(len(gaps)) if len(gaps) <= 12 else range(0)
    labels = [str(number + 1) for number in numbers]
    axes.set_xticks(numbers, labels)
    axes.set_yticks(numbers, labels)
    axes.set(title="distances")
