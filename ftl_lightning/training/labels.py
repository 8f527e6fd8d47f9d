"""Labels of an inversion's rows in tables: method, form and variant."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ftl_lightning.domains.comparison import CHOSEN, FINE_TUNED, WITH_ADAPTER, WITH_MODES
from ftl_lightning.igm.settings import ADAPTED, AUTO, COMBINED, MIXED, MODES, NOT_LEARNED, InversionSettings
from ftl_lightning.training.method import Method

FORMS = {
    **{AUTO: CHOSEN, MODES: WITH_MODES, ADAPTED: WITH_ADAPTER, MIXED: f"{WITH_MODES} {WITH_ADAPTER}", COMBINED: COMBINED},
    **{form: f"{form}, not learned" for form in NOT_LEARNED},
}
"""Names in tables of forms that override modes and adapter."""


class Labels(NamedTuple):
    """Labels of rows.

    Attributes:
        method: name of the method.
        form: form of the concepts; empty for the paper's form, a single set of embeddings constant over time.
        variant: parametrisation of the embeddings and other options, separated by commas.
    """

    method: str
    form: str
    variant: str


def labels(method: Method, traits: Sequence[str], settings: InversionSettings, hparams: Mapping[str, Any]) -> Labels:
    """Labels of an inversion.

    Args:
        traits: suffixes of the model's name, see :attr:`~ftl_lightning.training.concept_model.ConceptModel.traits`.
        hparams: options by flat name, see :data:`~ftl_lightning.igm.settings.INVERSION`.
    """
    embeddings, weights, adapter = settings.embeddings, settings.weights, settings.adapter
    fine_tuned = adapter.rank > 0 and adapter.scope == "all"
    decided = FORMS.get(settings.form)
    form = method.form({**hparams, **({"modes": 1, "adapter": 0} if decided else {})})
    span = {1.0: "free", 0.0: "span"}.get(embeddings.off_span, f"near span {embeddings.off_span:g}")
    sets = 1 if decided else settings.modes.sets
    parts = {
        f"modes: {sets}": sets not in (1, "auto"),
        f"{embeddings.knots} knots": embeddings.knots > 1,
        f"guidance {weights.scale:g}": settings.omega == "learned" and weights.scale != 1,
        f"rank {adapter.rank}": adapter.rank > 0,
        f"training weight {weights.training or 0:g}": weights.training is not None,
    }
    return Labels(
        FINE_TUNED if fine_tuned else method.name,
        "" if fine_tuned else " ".join(word for word in (form, decided) if word),
        ", ".join([*traits, span, *(text for text, applies in parts.items() if applies)]),
    )
