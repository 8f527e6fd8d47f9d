"""Inversion as a LightningModule whose only parameters are concept embeddings and weights."""

import itertools
from contextlib import nullcontext
from typing import Literal

import torch

from ftl_lightning.domains.comparison import CHOSEN, FINE_TUNED, OURS, WITH_ADAPTER, WITH_MODES
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms.choice import first_settings
from ftl_lightning.igm.inversion import Inversion
from ftl_lightning.igm.settings import (
    ADAPTED,
    AUTO,
    COMBINED,
    INVERSION,
    MIXED,
    MODES,
    NOT_LEARNED,
    AdapterOptions,
    BudgetOptions,
    EmbeddingOptions,
    InversionSettings,
    Loss,
    ModeOptions,
    WeightOptions,
)
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.progress import bar
from ftl_lightning.services.validation import flat, groups_of
from ftl_lightning.training.adaptation import Adaptation, Labels, LearnerAdaptation
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.in_processes import learned_in_processes
from ftl_lightning.training.method import Method

_USUAL = InversionSettings()
FORMS = {
    **{AUTO: CHOSEN, MODES: WITH_MODES, ADAPTED: WITH_ADAPTER, MIXED: f"{WITH_MODES}, {WITH_ADAPTER}", COMBINED: COMBINED},
    **{form: f"{form}, not learned" for form in NOT_LEARNED},
}
"""Names in tables of forms that override modes and adapter."""


class InversionModule(Adaptation):
    """Learn K embeddings and their weights for every concept of an :class:`~ftl_lightning.training.data.InversionData`.

    The parameters are those of :attr:`inversion`. A single training step makes all gradient steps by
    :meth:`~ftl_lightning.training.concept_model.ConceptModel.learn_concepts`, as the Python API and other processes do.

    Args:
        pretrained: folder of the pretrained model.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.
        components, omega, embeddings, weights, modes, adapter, budget, loss, seed, form: see
            :class:`~ftl_lightning.igm.settings.InversionSettings`. An empty form is ``auto`` if demonstrations come from a file
            without options for modes and adapter, else ``paper``.
    """

    learns = True
    inversion: Inversion

    def __init__(
        self,
        pretrained: str,
        components: int = 2,
        omega: float | Literal["learned"] = 1.2,
        embeddings: EmbeddingOptions = _USUAL.embeddings,
        weights: WeightOptions = _USUAL.weights,
        modes: ModeOptions = _USUAL.modes,
        adapter: AdapterOptions = _USUAL.adapter,
        budget: BudgetOptions = _USUAL.budget,
        loss: Loss = _USUAL.loss,
        output: str | None = None,
        seed: int = 0,
        form: str = "",
    ) -> None:
        super().__init__(pretrained, 1.0 if omega == "learned" else omega, output)
        groups = {name: value for name, value in locals().items() if name in groups_of(INVERSION)}
        self.save_hyperparameters(ignore=list(groups))
        self.save_hyperparameters(flat(groups, INVERSION))
        self.settings = InversionSettings(components=components, omega=omega, seed=seed, form=form, **groups)
        self.model.check_settings(self.settings)

    @property
    def labels(self) -> Labels:
        """Labels of the settings, whose form is selected for a user's demonstrations."""
        settings, method, decided = self.settings, self.model.method, FORMS.get(self.settings.form)
        embeddings, weights, adapter = settings.embeddings, settings.weights, settings.adapter
        fine_tuned = adapter.rank > 0 and adapter.scope == "all"
        form = method.form({**self.hparams, **({"modes": 1, "adapter": 0} if decided else {})})
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
            method.name if not fine_tuned else FINE_TUNED if method.name == OURS else f"{method.name}, {FINE_TUNED}",
            "" if fine_tuned else ", ".join(word for word in (form, decided) if word),
            ", ".join([*self.model.traits, span, *(text for text, applies in parts.items() if applies)]),
        )

    @classmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        return model.invertible

    @usual_modes()
    def configure_model(self) -> None:
        """Create the parameters once the demonstrations are known, and only once."""
        if "inversion" not in self._modules:
            with torch.device("cpu"):  # with the demonstrations; Lightning moves the parameters afterwards
                super().configure_model()
                if self._of_user:
                    self.settings = self.settings.for_own(self.model.chooses_form)
                self.inversion = Inversion(self.model, self.demonstrations, first_settings(self.settings))

    def learn(self) -> dict[str, Concept]:
        steps, count = int(self.trainer.datamodule.hparams["steps"]), itertools.count(1)  # type: ignore[attr-defined]
        if self.processes > 1:
            place = self.hparams["pretrained"], self.device
            return learned_in_processes(*place, self.demonstrations, self.settings, steps, self.processes)
        shown, interval = self.trainer.progress_bar_callback is not None, getattr(self.trainer, "log_every_n_steps", 50)
        with bar("invert", steps) if shown else nullcontext(lambda *_: None) as advance:

            def tell(loss: float) -> None:
                """Show the loss of a gradient step, and log it every ``trainer.log_every_n_steps`` steps."""
                advance(1, f"loss {loss:.3g}")
                if (step := next(count)) % interval == 0:
                    for logger in self.trainer.loggers:
                        logger.log_metrics({"train/loss": loss}, step)

            return self.model.learn_concepts(self.demonstrations, self.settings, steps, tell, start=self.inversion)

    def training_weight(self, task: EvaluationTask) -> float:
        omega = self.settings.weights.training if task.learned else None
        return super().training_weight(task) if omega is None else omega


def adaptation_of(method: Method) -> type[Adaptation]:
    """The LightningModule of ``invert`` for a method's models."""
    if method.adaptation is not None:
        return method.adaptation()
    return InversionModule if method.model is None or method.model().invertible else LearnerAdaptation
