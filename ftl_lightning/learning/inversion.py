"""Inversion: learning concepts from a few demonstrations by gradient descent through the frozen model (Eq. 2 of the paper)."""

import zlib
from typing import Any, Literal

import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.diffusion.prediction import LOSSES
from ftl_lightning.domains.domain import EvaluationTask
from ftl_lightning.errors import UserError
from ftl_lightning.learning.adaptation import Adaptation
from ftl_lightning.learning.checkpoint import check_signature, sign
from ftl_lightning.learning.concept_model import TextConceptModel
from ftl_lightning.seeding import generator

FINAL_SAMPLES = 128
"""Noised demonstrations on which a learned concept is judged, the same for all restarts."""


class InversionModule(Adaptation):
    """Learns K embeddings and their weights for every concept of an :class:`InversionData`, all in one batch.

    Its only parameters are ``embeddings (run, K, n)`` and, unless omega is fixed, ``weights (run, K)``, where the runs are
    concepts times restarts. The pretrained model is frozen and not part of a checkpoint.

    Args:
        pretrained: folder of the pretrained model.
        components: K.
        omega: fixed guidance weight of every component, or ``'learned'``.
        initial_omega: where learned weights start (the paper draws them from U(0, 1)).
        off_span: how freely embeddings leave the affine span of the training embeddings: 1 is the paper's free form, 0 keeps
            them in the span, between the two the part off the span is scaled, which slows its learning down.
        initial_spread: embeddings start at the mean of the training embeddings plus so much normal noise a column.
        restarts: independent starts of each concept; the one with the lowest loss on common noise is kept.
        learning_rate: of the embeddings (Adam, cosine decay to 0).
        weight_learning_rate: of the weights; with the embeddings' rate they collapse.
        samples: noised demonstrations a step and run, spread over demonstrations and timesteps.
        loss: whose squared error is minimised, ``'epsilon'`` (Eq. 2), ``'v'`` or ``'clean'``. The others weigh noisy timesteps,
            at which the concept decides, by 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: timesteps are drawn as T (1 - u^power), u even in [0, 1). 1 spreads them evenly (the paper's); with 3 half
            of them fall in the noisiest eighth. There the concept alone tells what to do; later the plan shows it, and a concept
            that says nothing is right everywhere: a trap next to one that is wrong in a single demonstration.
        training_omega: guidance weight of training concepts composed with a learned one; ``None`` for the paper's rule: the fixed
            omega, or 1 when weights are learned.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.
        seed: decides starts, noise and timesteps.
    """

    kinds = ("diffusion", "bc", "cvae")
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
        loss: str = "epsilon",
        timestep_power: float = 1.0,
        training_omega: float | None = None,
        output: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(pretrained, 1.0 if omega == "learned" else omega, output)
        self.save_hyperparameters()
        if components < 1:
            raise UserError(f"model.components: expected 1 or more, found {components}")
        if not 0 <= off_span <= 1:
            raise UserError(f"model.off_span: expected 0 (span) to 1 (free), found {off_span}")
        if off_span < 1 and not isinstance(self.model, TextConceptModel):
            raise UserError(
                f"model.off_span: expected 1 (free) for {self.model.name}, whose concepts are no texts, found {off_span}"
            )
        if timestep_power < 1:
            raise UserError(f"model.timestep_power: expected 1 or more, found {timestep_power}")
        for name, value in (("restarts", restarts), ("samples", samples)):
            if value < 1:
                raise UserError(f"model.{name}: expected 1 or more, found {value}")
        self.restarts = restarts
        self.off_span = off_span
        self.seed = seed
        training = self.model.training_embeddings
        # Rows span the training embeddings, whose mean is the origin of the concept space.
        basis = torch.linalg.svd(training, full_matrices=False).Vh[: max(len(training) - 1, 1)]
        self.register_buffer("basis", basis, persistent=False)
        if loss not in LOSSES:
            raise UserError(f"model.loss: expected one of {', '.join(LOSSES)}, found {loss!r}")
        self.basis: Tensor
        self.embeddings: nn.Parameter
        self.weights: nn.Parameter | Tensor

    @property
    def method(self) -> str:
        """The method's name in tables."""
        return self.model.name

    @property
    def variant(self) -> str:
        form = {1.0: "free", 0.0: "span"}.get(self.off_span, f"near span {self.off_span:g}")
        weight = self.hparams["training_omega"]
        parts = [*self.model.traits, form, *([] if weight is None else [f"training weight {weight:g}"])]
        return ", ".join(parts)

    def configure_model(self) -> None:
        """Create the parameters once the demonstrations are known. Does nothing the second time."""
        if "embeddings" not in self._parameters:
            with torch.device("cpu"):  # where the demonstrations are; Lightning moves the parameters afterwards
                self._configure()

    def _configure(self) -> None:
        super().configure_model()
        components, omega = self.hparams["components"], self.hparams["omega"]
        runs = len(self.concepts) * self.restarts
        # A generator for each concept, so that its start does not depend on what is learned beside it.
        shape = (self.restarts, components, self.model.config.concept_dim)
        draws = [generator("cpu", self.seed, 0, zlib.crc32(name.encode())) for name in self.concepts]
        start = torch.cat([torch.randn(shape, generator=draw) for draw in draws])
        self.embeddings = nn.Parameter(self.hparams["initial_spread"] * start)
        if omega == "learned":
            self.weights = nn.Parameter(torch.full((runs, components), float(self.hparams["initial_omega"])))
        else:
            self.register_buffer("weights", torch.full((runs, components), float(omega)), persistent=False)

    def _rows(self, samples: int) -> Tensor:
        """Which demonstration each sample of each run uses, evenly: ``(run, samples)``."""
        texts = self.demonstrations.concepts
        rows = [[row for row, text in enumerate(texts) if text == concept] for concept in self.concepts]
        each = torch.tensor([[own[sample % len(own)] for sample in range(samples)] for own in rows])
        return each.repeat_interleave(self.restarts, dim=0)

    @property
    def parametrised(self) -> Tensor:
        """The embeddings ``(run, K, n)`` after the part off the span is scaled."""
        if self.off_span == 1:
            return self.embeddings
        inside = self.embeddings @ self.basis.T @ self.basis
        return inside + self.off_span * (self.embeddings - inside)

    def _losses(self, samples: int, draw: torch.Generator) -> Tensor:
        """The model's loss (ours is Eq. 2) for every run and sample, ``(run, samples)``. Runs share what is random in it and, as
        a share of a demonstration's length, the windows' starts.
        """
        runs = len(self.embeddings)
        noise = self.model.noise(samples, self.hparams["timestep_power"], draw)
        rows = self._rows(samples).flatten()
        share = torch.rand(samples, generator=draw, device=self.device).cpu().repeat(runs)
        starts = self.demonstrations.starts(rows, share, self.domain.start_power(self.model.window))
        states, initial = self.demonstrations.windows(rows, starts, self.model.window)
        initial = None if initial is None else initial.to(self.device)
        states, initial = self.model.perturbed(states.to(self.device), initial, draw)
        return self.model.losses(states, initial, self.parametrised, self.weights, noise, self.hparams["loss"])

    def training_step(self, step: int) -> Tensor:
        losses = self._losses(self.hparams["samples"], generator(self.device, self.seed, 1, self.global_step))
        mean = losses.detach().mean()
        if not mean.isfinite():
            raise UserError(f"inversion: the loss became {mean.item()} at step {self.global_step}; lower model.learning_rate")
        self.log("train/loss", mean, prog_bar=True)
        # A sum over runs: each run's gradient is what it would be if it were learned alone.
        return losses.mean(dim=1).sum()

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam with cosine decay; weights have a rate of their own."""
        groups: list[dict[str, Any]] = [{"params": [self.embeddings], "lr": self.hparams["learning_rate"]}]
        if isinstance(self.weights, nn.Parameter):
            groups.append({"params": [self.weights], "lr": self.hparams["weight_learning_rate"]})
        optimizer = torch.optim.Adam(groups)
        total = int(self.trainer.estimated_stepping_batches)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, total)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Sign the checkpoint and leave the frozen model out; its folder is a hyper-parameter."""
        sign(self, checkpoint, self._signature())
        own = {"embeddings", "weights"}
        checkpoint["state_dict"] = {key: value for key, value in checkpoint["state_dict"].items() if key in own}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another module, model, concepts or kind of weights."""
        check_signature(self, checkpoint, self._signature())
        self._found = {}

    def _signature(self) -> dict[str, Any]:
        """What a checkpoint's parameters mean nothing without."""
        return {
            "pretrained": self.model.hash,
            "demonstrations": self.demonstrations.hash,
            "components": self.hparams["components"],
            "restarts": self.restarts,
            "omega": self.hparams["omega"],
        }

    @torch.no_grad()
    def learned(self) -> dict[str, Concept]:
        """The concepts by name: of each, the restart with the lowest loss on common noise."""
        # Noise that is common to all runs and always the same.
        losses = self._losses(FINAL_SAMPLES, generator(self.device, self.seed, 2)).mean(dim=1).unflatten(0, (-1, self.restarts))
        best = losses.argmin(dim=1)
        embeddings = self.parametrised.detach().unflatten(0, (-1, self.restarts))
        weights = self.weights.detach().unflatten(0, (-1, self.restarts))
        found = {}
        for index, name in enumerate(self.concepts):
            kind = "learned" if self.hparams["omega"] == "learned" else "fixed"
            origin = self.origin(name, kind, losses[index, best[index]].item())
            found[name] = Concept(embeddings[index, best[index]].cpu(), weights[index, best[index]].cpu(), origin)
        return found

    def training_weight(self, task: EvaluationTask) -> float:
        omega = self.hparams["training_omega"] if task.learned else None
        return super().training_weight(task) if omega is None else omega
