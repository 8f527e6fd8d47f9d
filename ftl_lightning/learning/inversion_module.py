"""Inversion as a LightningModule: curves, checkpoints that resume exactly, and evaluation at the end."""

from dataclasses import fields
from typing import Any, Literal

import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.domains.paper import FINE_TUNED, WITH_ADAPTER, WITH_KNOTS, WITH_MODES
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.learning.adaptation import Adaptation
from ftl_lightning.learning.baselines.additive import AdditiveModel
from ftl_lightning.learning.checkpoint import check_parameters, check_restored, check_signature, sign
from ftl_lightning.learning.generative_model import GenerativeModel
from ftl_lightning.learning.inversion import Inversion, check_settings
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.ranges import expect_factor
from ftl_lightning.tensor_file import expect_finite

OWN = "inversion."
"""Names of all that a checkpoint holds begin so."""


class InversionModule(Adaptation):
    """Learns K embeddings and their weights for every concept of an :class:`~ftl_lightning.domains.data.InversionData`.

    Its only parameters are those of an :class:`~ftl_lightning.learning.inversion.Inversion`. The pretrained model is frozen and
    not part of a checkpoint.

    Args:
        pretrained: folder of the pretrained model.
        components, omega, initial_omega, off_span: see :class:`~ftl_lightning.learning.inversion_settings.InversionSettings`.
        initial_spread, restarts, learning_rate, weight_learning_rate, samples: likewise.
        mode_samples, modes, tolerance, knots, guidance_scale, adapter, adapter_learning_rate, adapter_scope: likewise.
        loss, timestep_power, seed: likewise.
        training_omega: guidance weight of training concepts composed with a learned one; ``None`` for the paper's rule: the fixed
            omega, or 1 when weights are learned.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.
    """

    adapts = (GenerativeModel, AdditiveModel)
    learns = True
    strict_loading = False

    def __init__(
        self,
        pretrained: str,
        components: int = 2,
        omega: float | Literal["learned"] = 1.2,
        initial_omega: float = 1.0,
        off_span: float = 1.0,
        initial_spread: float = 0.05,
        restarts: int = 1,
        learning_rate: float = 0.1,
        weight_learning_rate: float = 3e-3,
        samples: int = 32,
        mode_samples: int = 8,
        modes: int | Literal["each", "auto"] = 1,
        tolerance: float | None = None,
        knots: int = 1,
        guidance_scale: float = 1.0,
        adapter: int = 0,
        adapter_learning_rate: float = 1e-3,
        adapter_scope: Literal["concept", "all"] = "concept",
        loss: str = "epsilon",
        timestep_power: float = 1.0,
        training_omega: float | None = None,
        output: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(pretrained, 1.0 if omega == "learned" else omega, output)
        self.save_hyperparameters()
        if training_omega is not None:
            expect_factor("model.training_omega", training_omega)
        self.settings = InversionSettings(**{field.name: self.hparams[field.name] for field in fields(InversionSettings)})
        check_settings(self.model, self.settings)
        self.inversion: Inversion
        self._from = 0

    @property
    def method(self) -> str:
        """The paper's form has one set of embeddings, alike at all times; other forms stand beside it in tables."""
        if self.settings.adapter and self.settings.adapter_scope == "all":
            return FINE_TUNED
        modes, knots, adapter = (self.settings.modes != 1, self.settings.knots > 1, self.settings.adapter > 0)
        forms = [name for name, has in ((WITH_MODES, modes), (WITH_KNOTS, knots), (WITH_ADAPTER, adapter)) if has]
        return "".join((super().method, *forms))

    @property
    def variant(self) -> str:
        off_span, weight = self.settings.off_span, self.hparams["training_omega"]
        form = {1.0: "free", 0.0: "span"}.get(off_span, f"near span {off_span:g}")
        modes = [] if self.settings.modes in (1, "auto") else [f"modes: {self.settings.modes}"]
        knots = [f"{self.settings.knots} knots"] if self.settings.knots > 1 else []
        scaled = self.settings.omega == "learned" and self.settings.guidance_scale != 1
        scale = [f"guidance {self.settings.guidance_scale:g}"] if scaled else []
        adapter = [f"rank {self.settings.adapter}"] if self.settings.adapter else []
        training = [] if weight is None else [f"training weight {weight:g}"]
        return ", ".join([*self.model.traits, form, *modes, *knots, *scale, *adapter, *training])

    def configure_model(self) -> None:
        """Create the parameters once the demonstrations are known. Does nothing the second time."""
        if "inversion" not in self._modules:
            with torch.device("cpu"):  # where the demonstrations are; Lightning moves the parameters afterwards
                super().configure_model()
                self.inversion = Inversion(self.model, self.demonstrations, self.settings)

    def on_train_start(self) -> None:
        """Look at what was restored, if anything."""
        check_restored(self, self._from)

    def training_step(self, step: int) -> Tensor:
        losses = self.inversion.step_losses(self.global_step)
        self.log("train/loss", losses.detach().mean(), prog_bar=True)
        # A sum over runs: each run's gradient is what it would be if it were learned alone.
        return losses.sum()

    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        """Make no step where a checkpoint is resumed in which every concept had stopped."""
        stopping = self.inversion.stopping
        return None if stopping is None or stopping.going.any() else -1

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        """Take note of every step, and stop when no concept gains any more.

        Here and not at the end of the batch, when a checkpoint may have been written that would not know of the step.
        """
        step = self.global_step
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if not self.inversion.stepped(step):
            self.trainer.should_stop = True

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam with cosine decay; weights have a rate of their own."""
        optimizer, decay = self.inversion.optimizer(int(self.trainer.estimated_stepping_batches))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": decay, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Sign the checkpoint and leave the frozen model out; its folder is a hyper-parameter."""
        sign(self, checkpoint, self._signature())
        own = {key: value for key, value in checkpoint["state_dict"].items() if key.startswith(OWN)}
        checkpoint["state_dict"] = own
        parameters = dict(self.inversion.named_parameters())
        expect_finite(parameters, f"inversion: step {self.global_step}", "nothing was saved of it; lower model.learning_rate")

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another module, model, concepts or kind of weights."""
        check_signature(self, checkpoint, self._signature())
        with_knots(checkpoint, self.inversion.embeddings.shape)
        check_parameters(checkpoint["state_dict"], self, OWN)
        self._found, self._from = {}, checkpoint["global_step"]

    def _signature(self) -> dict[str, Any]:
        """Settings that must match before a checkpoint is loaded."""
        return {
            "pretrained": self.model.hash,
            "demonstrations": self.demonstrations.hash,
            "components": self.settings.components,
            "restarts": self.settings.restarts,
            **({} if self.settings.modes == 1 else {"modes": self.settings.modes}),
            **({} if self.settings.knots == 1 else {"knots": self.settings.knots}),
            **({} if self.settings.adapter == 0 else {"adapter": self.settings.adapter}),
            **({} if self.settings.tolerance is None else {"tolerance": self.settings.tolerance}),
            "omega": self.settings.omega,
        }

    def learned(self) -> dict[str, Concept]:
        return self.inversion.learned()

    def training_weight(self, task: EvaluationTask) -> float:
        omega = self.hparams["training_omega"] if task.learned else None
        return super().training_weight(task) if omega is None else omega


def with_knots(checkpoint: dict[str, Any], shape: torch.Size) -> None:
    """Give embeddings of a checkpoint the shape ``(run, K, knots, n)`` where an older version wrote ``(run, K, knots * n)``: the
    parameter, what the rule of stopping keeps of it, and the state of its optimiser, which is that of the first parameter.
    """
    flat = (*shape[:2], shape[2] * shape[3])
    held = dict.fromkeys((f"{OWN}embeddings", f"{OWN}stopping.embeddings", f"{OWN}stopping._sums"), checkpoint["state_dict"])
    for optimizer in checkpoint.get("optimizer_states", ()):
        match optimizer:
            case {"state": {0: dict() as moments}}:
                held |= dict.fromkeys(("exp_avg", "exp_avg_sq"), moments)
    for name, tensors in held.items():
        if isinstance(value := tensors.get(name), Tensor) and value.shape == flat:
            tensors[name] = value.reshape(shape)
