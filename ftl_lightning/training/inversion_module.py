"""Inversion as a LightningModule: curves, exact resumption from checkpoints, and final evaluation."""

from typing import Any, Literal

import torch
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from ftl_lightning.domains.paper import CHOSEN, FINE_TUNED, WITH_ADAPTER, WITH_MODES
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.option_groups import flat, groups_of
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.forms import first_settings, formed
from ftl_lightning.training.in_processes import learned_in_processes
from ftl_lightning.training.inversion import Inversion, check_settings, warn_of_loss
from ftl_lightning.training.inversion_settings import (
    ADAPTED,
    AUTO,
    INVERSION,
    MIXED,
    MODES,
    AdapterOptions,
    BudgetOptions,
    EmbeddingOptions,
    InversionSettings,
    LossOptions,
    ModeOptions,
    WeightOptions,
)
from ftl_lightning.training.resume import ExactResume

_USUAL = InversionSettings()
_FORMS = {AUTO: CHOSEN, MODES: WITH_MODES, ADAPTED: WITH_ADAPTER, MIXED: f"{WITH_MODES} {WITH_ADAPTER}"}
"""Names in tables of the forms that override modes and adapter."""


class InversionModule(ExactResume, Adaptation):
    """Learn K embeddings and their weights for every concept of an :class:`~ftl_lightning.training.data.InversionData`.

    The only parameters are those of an :class:`~ftl_lightning.training.inversion.Inversion`. The pretrained model is frozen and
    not part of a checkpoint.

    Args:
        pretrained: folder of the pretrained model.
        components: number of components K.
        omega: fixed guidance weight of every component, or ``'learned'``.
        embeddings: options of the embeddings.
        weights: options of the guidance weights.
        modes: options of several sets of embeddings.
        adapter: options of the denoiser's adapter.
        budget: compute budget.
        loss: options of the loss.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed of starts, noise and timesteps.
        form: form of the concepts: ``paper`` follows the other options; ``auto`` selects ``one set``, ``modes``, ``adapter`` or
            ``mixtures`` by leave-one-out error; or name a form. Empty for ``auto`` if demonstrations come from a file without
            options for modes and adapter, else for ``paper``.
    """

    learns = True
    prefix = "inversion."
    doing = "inversion"
    strict_loading = False

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
        loss: LossOptions = _USUAL.loss,
        output: str | None = None,
        seed: int = 0,
        form: str = "",
    ) -> None:
        super().__init__(pretrained, 1.0 if omega == "learned" else omega, output)
        groups = {
            "embeddings": embeddings,
            "weights": weights,
            "modes": modes,
            "adapter": adapter,
            "budget": budget,
            "loss": loss,
        }
        self.save_hyperparameters(ignore=groups_of(INVERSION))
        self.save_hyperparameters(flat(groups, INVERSION))
        self.settings = InversionSettings(
            components=components,
            omega=omega,
            embeddings=embeddings,
            weights=weights,
            modes=modes,
            adapter=adapter,
            budget=budget,
            loss=loss,
            seed=seed,
            form=form,
        )
        check_settings(self.model, self.settings)
        warn_of_loss(self.model, self.settings)
        self.inversion: Inversion
        self._formed: tuple[int, dict[str, Concept]] | None = None

    @property
    def method(self) -> str:
        """The model's method; fine-tuning with an adapter of the whole network."""
        return FINE_TUNED if self._fine_tuned else super().method

    @property
    def form(self) -> str:
        """Form in tables; empty for the paper's form, one set of embeddings constant over time."""
        if self._fine_tuned:
            return ""
        decided = _FORMS.get(self.settings.form)
        options = {**self.hparams, **({"modes": 1, "adapter": 0} if decided else {})}
        return " ".join(word for word in (self.model.method.form(options), decided) if word)

    @property
    def _fine_tuned(self) -> bool:
        return self.settings.adapter.rank > 0 and self.settings.adapter.scope == "all"

    @property
    def variant(self) -> str:
        off_span, weight = self.settings.embeddings.off_span, self.settings.weights.training
        form = {1.0: "free", 0.0: "span"}.get(off_span, f"near span {off_span:g}")
        sets = 1 if self.settings.form in _FORMS else self.settings.modes.sets
        modes = [] if sets in (1, "auto") else [f"modes: {sets}"]
        knots = [f"{self.settings.embeddings.knots} knots"] if self.settings.embeddings.knots > 1 else []
        scaled = self.settings.omega == "learned" and self.settings.weights.scale != 1
        scale = [f"guidance {self.settings.weights.scale:g}"] if scaled else []
        adapter = [f"rank {self.settings.adapter.rank}"] if self.settings.adapter.rank else []
        training = [] if weight is None else [f"training weight {weight:g}"]
        return ", ".join([*self.model.traits, form, *modes, *knots, *scale, *adapter, *training])

    def configure_model(self) -> None:
        """Create the parameters once the demonstrations are known, and only once."""
        if "inversion" not in self._modules:
            with torch.device("cpu"):  # with the demonstrations; Lightning moves the parameters afterwards
                super().configure_model()
                if self._own:
                    self.settings = self.settings.for_own(bool(self.model.adaptable()))
                self.inversion = Inversion(self.model, self.demonstrations, first_settings(self.settings))

    def training_step(self, step: int) -> Tensor:
        losses = self.inversion.step_losses(self.global_step)
        self.log("train/loss", losses.detach().mean(), prog_bar=True)
        # A sum over runs, so that runs do not affect each other's gradients.
        return losses.sum()

    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        """Skip the step if every concept had stopped in the resumed checkpoint."""
        stopping = self.inversion.stopping
        return None if stopping is None or stopping.going.any() else -1

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        """Record every step, and stop once all runs have stopped.

        Not at the end of the batch, after a checkpoint may have been written without the step.
        """
        step = self.global_step
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if not self.inversion.stepped(step):
            self.trainer.should_stop = True

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam with cosine decay and a separate learning rate for the weights."""
        optimizer, decay = self.inversion.optimizer(int(self.trainer.estimated_stepping_batches))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": decay, "interval": "step"}}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another module, model, concepts or kind of weights; the frozen model is not included."""
        super().on_load_checkpoint(checkpoint)
        self._found = {}

    def signature(self) -> dict[str, Any]:
        """Settings that must match before a checkpoint is loaded."""
        first = first_settings(self.settings)
        return {
            "pretrained": self.model.hash,
            "demonstrations": self.demonstrations.hash,
            "components": first.components,
            "restarts": first.budget.restarts,
            **({} if first.modes.sets == 1 else {"modes": first.modes.sets}),
            **({} if first.embeddings.knots == 1 else {"knots": first.embeddings.knots}),
            **({} if first.adapter.rank == 0 else {"adapter": first.adapter.rank}),
            **({} if first.budget.tolerance is None else {"tolerance": first.budget.tolerance}),
            "omega": first.omega,
        }

    def on_validation_start(self) -> None:
        """Validate the first inversion while fitting; other forms are learned once, at the end."""
        self._found = self.inversion.learned() if self.trainer.state.fn == TrainerFn.FITTING else self.learned()

    def learned(self) -> dict[str, Concept]:
        if self.processes > 1:
            return self._found or self._in_processes()
        if self._formed is None or self._formed[0] != self.global_step:
            first = self.inversion.learned()
            self._formed = self.global_step, formed(self.model, self.demonstrations, self.settings, self._steps, first)
        return self._formed[1]

    def _in_processes(self) -> dict[str, Concept]:
        devices = [torch.device(self.device.type, number) for number in range(torch.cuda.device_count())]
        return learned_in_processes(
            self.hparams["pretrained"],
            self.demonstrations,
            self.settings,
            self._steps,
            self.processes,
            devices if self.device.type == "cuda" else [self.device],
        )

    @property
    def _steps(self) -> int:
        """Maximum number of gradient steps."""
        return int(self.trainer.datamodule.hparams["steps"])  # type: ignore[attr-defined]

    def training_weight(self, task: EvaluationTask) -> float:
        omega = self.settings.weights.training if task.learned else None
        return super().training_weight(task) if omega is None else omega
