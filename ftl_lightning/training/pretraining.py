"""Pretraining of a concept-conditioned model on a domain's demonstrations, for any method."""

import copy
import functools
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import lightning.pytorch as pl
import torch
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import READ, Feature, Observed, take
from ftl_lightning.data.kinds import LINEAR
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.data.places import feature_of, frames_of, places, shift
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Point
from ftl_lightning.networks.image_encoder import ImageEncoders
from ftl_lightning.networks.text_encoder import EMPTY
from ftl_lightning.services.errors import UserError, note, require, short
from ftl_lightning.services.modes import single_precision
from ftl_lightning.services.randomness import generator, mean, rows_of
from ftl_lightning.services.tensor_file import check_finite
from ftl_lightning.services.text import say
from ftl_lightning.services.validation import LARGEST_FACTOR, LARGEST_RATE, check_factor, check_range, groups_of
from ftl_lightning.training.checkpoint import (
    SIGNATURE,
    Random,
    apply_rates,
    changed_options,
    check_parameters,
    check_restored,
    check_signature,
    data_hash,
)
from ftl_lightning.training.concept_model import ConceptModel, joined_vectors
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.method import class_path
from ftl_lightning.training.model_config import ModelConfig, Prepared, find_view, width_of
from ftl_lightning.training.model_folder import save_model

M = TypeVar("M", bound=ConceptModel)
_DATA = "data"
"""Key of the training data's hash in a checkpoint's signature."""


class Pretraining(pl.LightningModule, ABC, Generic[M]):
    """Base module that fits a method's model to a domain's demonstrations.

    ``model`` holds the exponential moving average (EMA) of the weights and is validated, exported and adapted; ``raw`` holds the
    raw weights, which the published code uses. A resumed run ends with the bytes of an unbroken run. Layers are built once the data
    module, which decides sizes, is attached.

    Args:
        learning_rate: learning rate of AdamW, after a linear warm-up and before a cosine decay to 0 at ``trainer.max_steps``.
        warmup_steps: steps of the warm-up; 0 for none.
        weight_decay: weight decay of AdamW.
        ema_decay: decay of the EMA; it starts lower.
        guidance: guidance weight omega of training concepts in evaluation.
        view: name of the domain's view, see :class:`ftl_lightning.domains.domain.View`; empty for data as in files.
        perturb: perturb the present state by the view, here and in inversion.
        output: folder for the trained model; ``None`` for ``pretrained`` in the log folder.
        seed: seed of the initial weights, and of the loss's noise as a function of the step.
        image_encoder: arguments of the image encoders, see :class:`~ftl_lightning.networks.image_encoder.ImageEncoder`; its
            defaults for ``None``.
        feature_dropout: dropout probability of observed vectors by name; none for ``None``. The published code hides the end
            effector's pose with 0.4.
        privileged: loss weights by name: image encoders are trained to predict privileged information of training
            demonstrations, see :class:`~ftl_lightning.domains.domain.Privileged`; none for ``None``.
        unencoded: share of each step's windows whose image encoding is replaced by privileged information, which costs a fraction
            of encoding the image.

    Raises:
        UserError: at construction, for a value out of its range.
    """

    model: M
    raw: M
    flat: ClassVar[Mapping[str, str]] = {}
    """Grouped options ``'group.option'`` by flat name, see :func:`ftl_lightning.services.validation.groups_of`."""
    form: str = ""
    """Suffix of the method's name in tables, if it has several forms."""
    framed: ClassVar[bool] = False
    """Whether plans are learned relative to observed places, see :class:`~ftl_lightning.data.places.Frames`."""
    variant: str = ""
    """Variant of the method in tables."""
    concepts: tuple[str, ...] = ()
    """Names of learned concepts; pretraining learns none."""
    unused: Tensor | None
    """Dummy parameter for a model without learnable parameters."""
    stride: int = 1
    """Stride between the states of a window."""
    resumed_from = 0
    """Step of the loaded checkpoint; 0 for none."""

    def __init__(
        self,
        learning_rate: float = 6e-4,
        warmup_steps: int = 200,
        weight_decay: float = 0.01,
        ema_decay: float = 0.999,
        guidance: float = 1.0,
        view: str = "",
        perturb: bool = False,
        output: str | None = None,
        seed: int = 0,
        image_encoder: Mapping[str, Any] | None = None,
        feature_dropout: Mapping[str, float] | None = None,
        privileged: Mapping[str, float] | None = None,
        unencoded: float = 0.0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=groups_of(self.flat))
        for name, value, most in (
            ("learning_rate", learning_rate, LARGEST_RATE),
            ("warmup_steps", warmup_steps, math.inf),
            ("weight_decay", weight_decay, LARGEST_FACTOR),
            ("ema_decay", ema_decay, 1),
            ("seed", seed, math.inf),
        ):
            check_range(f"model.{name}", value, 0, most)
        check_factor("model.guidance", guidance)
        self.image_encoder, self.feature_dropout = dict(image_encoder or {}), dict(feature_dropout or {})
        for name, share in self.feature_dropout.items():
            check_range(f"model.feature_dropout.{name}", share, 0, 1)
        self.teaching = _Teaching(privileged or {}, unencoded)
        self.seed = seed
        self.guidance = guidance
        self.register_parameter("unused", None)
        self._validated = False
        self._random: Random | None = None

    @abstractmethod
    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> M:
        """Build the method's model with initial weights.

        Args:
            prepared: configuration and text embeddings; a method adds options of its network by
                :meth:`~ftl_lightning.training.model_config.Prepared.configured`.
        """

    @abstractmethod
    def losses(self, model: M, batch: Batch, draw: torch.Generator) -> Tensor:
        """Losses ``(batch,)`` of a perturbed batch; ``model`` is in training mode while fitting."""

    def _perturbed_losses(self, model: M, batch: Batch, draw: torch.Generator) -> tuple[Tensor, Batch]:
        states, observed = model.perturbed(batch.states, batch.observed, draw, pretraining=True)
        perturbed = batch._replace(states=states, observed=dict(observed))
        return self.losses(model, perturbed, draw), perturbed

    def configure_model(self) -> None:
        """Build the layers, once, when the data are known."""
        if "model" not in self._modules:
            with torch.device("cpu"):  # with the data; Lightning moves the layers afterwards
                self._configure()

    @single_precision()
    def _configure(self) -> None:
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, PretrainingData):
            raise UserError(f"data.class_path: expected a domain's pretraining data, found {type(data).__name__}")
        concepts = data.domain.concepts.training
        embeddings = data.encoder((EMPTY, *concepts))
        check_different(concepts, embeddings[1:])
        name, known = self.hparams["view"] or data.view, self._places(data)
        view = find_view(data.domain, name)
        features = data.domain.observed if view is None else view.features
        placed = {feature_of(place, features) for place in known}  # frames see places, networks do not
        features = {name: feature for name, feature in features.items() if name not in placed}
        observed: Observed
        frames = None
        if known:
            order = list(dict.fromkeys(data.training.concepts))
            frames = frames_of(data.training, data.horizon, known)[[order.index(text) for text in concepts]]
        if view is None and frames is None:
            states, observed = data.training.states, data.training.every_observation
        else:
            windows = data.every_window()
            states, observed = windows.states, windows.observed
            if frames is not None:
                states = states - shift(frames[windows.concepts], known, observed, states.shape[2])
            states = states[:, :: self.stride]
            if view is not None:
                states, observed = view.encode(states, observed), view.observe(observed)
        with torch.device("meta"):  # for its size alone
            image_dim = ImageEncoders(features, self.image_encoder).size
        config = ModelConfig(
            domain=data.domain_name,
            horizon=data.horizon,
            state_dim=width_of(data.domain, view),
            observed=dict(features),
            concept_dim=embeddings.shape[-1],
            training_concepts=concepts,
            encoder=data.encoder.identity,
            view=name,
            perturb=self.hparams["perturb"],
            image_dim=image_dim,
            image_encoder=self.image_encoder,
            feature_dropout=check_dropout(self.feature_dropout, features),
            plane=view.plane if view else (),
            places=known,
            metrics=dict(data.metrics),
            training={
                "model": {key: value for key, value in self.hparams.items() if key != "output" and not key.startswith("_")},
                # The folder of recordings does not affect the model.
                "data": {key: value for key, value in data.hparams.items() if key != "root" and not key.startswith("_")},
                "max_steps": self.trainer.max_steps,
            },
        )
        # The initial weights depend on the seed alone.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            resolution = data.domain.plans.resolution
            normalization = Normalization.fit(states, view.scales if view else (), resolution, config.plane)
            vectors = None
            if config.measured_dim:
                vectors = Normalization.fit(joined_vectors(observed, features), config.entities, resolution)
                if config.state_columns and (view is None or view.same_columns):  # else plans have another scale
                    vectors.share(config.state_columns, normalization)
            self.model = self.build(Prepared(config, data.domain, normalization, embeddings, vectors, frames), data)
            self.model.examples = data.examples
            self.teaching.check_taught(self.domain, self.model.images)
        self.raw = copy.deepcopy(self.model)
        self.teaching.attach(self.raw.images)
        if not any(parameter.requires_grad for parameter in self.raw.parameters()):
            # A model that memorises: the optimiser still needs a parameter to count steps.
            self.unused = torch.nn.Parameter(torch.zeros(()))
        self.model.requires_grad_(False).eval()

    def _places(self, data: PretrainingData) -> dict[str, tuple[int, ...]]:
        """Observed places of a user's data that plans follow in linear columns, as long as a plan is a whole demonstration.

        Beside images there are none: what images show is to be related to places by the network.
        """
        if not self.framed or data.examples is None or int(data.training.lengths.max()) > data.horizon:
            return {}
        if data.training.per_step or any(feature.kind == "image" for feature in data.domain.observed.values()):
            return {}
        kinds = dict(enumerate(data.domain.plans.kinds))
        known = places(data.training, data.horizon)
        return {name: columns for name, columns in known.items() if {kinds.get(column, LINEAR) for column in columns} == {LINEAR}}

    def train(self, mode: bool = True) -> Self:
        """Switch modes; the EMA model is always in evaluation mode."""
        super().train(mode)
        if "model" in self._modules:
            self.model.eval()
        return self

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Restore the global generators, which dropout uses, so that a resumed run equals an unbroken run.

        Not earlier, since starting to iterate a loader draws from them too.
        """
        self._validated = False
        if self._random is not None:
            self._random.restore(self.device)
            self._random = None

    def on_validation_start(self) -> None:
        """Record that later checkpoints follow a validation."""
        self._validated = True

    def on_train_start(self) -> None:
        """Check the restored state."""
        check_restored(self, self.resumed_from)

    @single_precision()
    def training_step(self, batch: Batch) -> Tensor:
        with rows_of(self.trainer.global_rank, self.trainer.world_size):
            return self._training_loss(batch)

    def _training_loss(self, batch: Batch) -> Tensor:
        draw = generator(self.device, self.seed, self.global_step)
        with_images, without_images = self.teaching.split(self.domain, batch)
        losses, perturbed = self._perturbed_losses(self.raw, with_images, draw)
        if without_images is not None:
            states, observed = self.raw.perturbed(without_images.states, without_images.observed, draw, pretraining=True)
            privileged = without_images._replace(states=states, observed=self.teaching.simulated(self.domain, observed, draw))
            losses = torch.cat((losses, self.losses(self.raw, privileged, draw)))
        require(losses.dim() == 1, f"{class_path(type(self))}.losses", "losses (batch,)", tuple(losses.shape))
        loss = losses.mean()
        whole = mean(loss)
        if not whole.isfinite():
            raise UserError(
                f"training: the loss became {whole.item()} at step {self.global_step}; the last checkpoint before it is kept; "
                "lower model.learning_rate"
            )
        self.log("train/loss", whole, prog_bar=True)
        for name, error in self.teaching.errors(self.domain, perturbed.observed).items():
            self.log(f"train/{name}", mean(error))
            loss = loss + self.teaching.weights[name] * error
        return loss if self.unused is None else loss + 0 * self.unused

    def optimizer_step(self, *arguments: Any, **options: Any) -> None:
        """Step and update the EMA, so that no checkpoint falls between the two."""
        super().optimizer_step(*arguments, **options)
        decay = min(self.hparams["ema_decay"], self.global_step / (self.global_step + 10))
        if self.unused is None:
            with torch.no_grad():
                # No public name: a single call for all parameters.
                torch._foreach_lerp_(list(self.model.parameters()), list(self.raw.parameters()), 1 - decay)

    @single_precision()
    def _evaluation_step(self, batch: Batch, name: str) -> None:
        # Fixed noise, so that the curve shows the model alone. Each process evaluates the whole set.
        loss = self._perturbed_losses(self.model, batch, generator(self.device, self.seed))[0].mean()
        self.log(name, loss, prog_bar=True, batch_size=len(batch.states), sync_dist=True)

    def validation_step(self, batch: Batch) -> None:
        self._evaluation_step(batch, "val/loss")

    def test_step(self, batch: Batch) -> None:
        self._evaluation_step(batch, "test/loss")

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW with warm-up and cosine decay."""
        total = int(self.trainer.estimated_stepping_batches)
        warmup = max(min(self.hparams["warmup_steps"], total // 10), 1)
        optimizer = torch.optim.AdamW(
            self.raw.parameters() if self.unused is None else [self.unused],
            lr=self.hparams["learning_rate"],
            weight_decay=self.hparams["weight_decay"],
            fused=True,
        )

        def factor(step: int) -> float:
            return min(1.0, (step + 1) / warmup) * 0.5 * (1 + math.cos(math.pi * min(step / total, 1.0)))

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_fit_end(self) -> None:
        """Write the EMA model for ``invert`` and ``sample``."""
        folder = self.hparams["output"] or Path(self.trainer.log_dir or self.trainer.default_root_dir) / "pretrained"
        if self.trainer.is_global_zero:
            save_model(self.model, folder)

    @property
    def method(self) -> str:
        """The method's name in tables."""
        return self.model.method.name

    @property
    def domain(self) -> Domain:
        """The model's domain."""
        return self.model.domain

    def composition(self, task: EvaluationTask) -> Composition | None:
        """Composition for a task; ``None`` if it needs a learned concept."""
        if task.learned:
            return None
        parts = [self.guidance * self.model[text] for text in task.texts]
        parts += [WITHOUT_WEIGHT * self.model[text] for text in task.without]
        return functools.reduce(operator.add, parts)

    def demonstrated(self, concept: str) -> Demonstrations | None:
        """Demonstrations of a learned concept: ``None`` in pretraining."""
        return None

    def concept_points(self) -> list[Point]:
        """All embeddings, for the projector."""
        return self.model.points()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Sign the checkpoint and store the global generators' states.

        Raises:
            UserError: if a parameter is not finite; an existing checkpoint is kept.
        """
        checkpoint[SIGNATURE] = self.signature() | {_DATA: self._data_hash}
        place = f"training: step {self.global_step}"
        check_finite(checkpoint["state_dict"], place, "nothing was saved of it; lower the learning rate")
        # No public name: whether a validation follows, which draws a random number before the next step.
        loop = self.trainer.fit_loop
        validates = not self._validated and loop.epoch_loop._should_check_val_fx(loop._data_fetcher)  # type: ignore[arg-type]
        Random.now(self.device, int(validates) + int(self.trainer.is_last_batch)).write(checkpoint)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another module or model configuration, or to go on with other training data.

        Other hyper-parameters of the run replace those of the checkpoint, with a note.
        """
        own = dict(checkpoint.get(SIGNATURE, {}))
        known = own.pop(_DATA, None)
        check_signature(self.signature(), checkpoint | {SIGNATURE: own})
        check_parameters(checkpoint["state_dict"], self)
        if self.trainer.state.fn == TrainerFn.FITTING:
            self._go_on(checkpoint, known)
        elif known != self._data_hash:
            say("note: ckpt_path: the checkpoint was trained on other data than these", error=True)
        self.resumed_from = checkpoint["global_step"]
        self._random = Random.read(checkpoint)

    def signature(self) -> dict[str, Any]:
        """Configuration that decides the shapes and meaning of a checkpoint's parameters."""
        excluded = ("training", "perturb", "metrics", "feature_dropout")
        config = {key: value for key, value in asdict(self.model.config).items() if key not in excluded}
        plans = self.domain.plans
        return {"module_class": type(self).__name__, **config, "columns": plans.columns, "units": plans.units, "kinds": plans.kinds}

    @functools.cached_property
    def _data_hash(self) -> str:
        """Hash of the training data."""
        return data_hash(self.trainer.datamodule.training)  # type: ignore[attr-defined]

    def _go_on(self, checkpoint: Mapping[str, Any], data: object) -> None:
        """Compare the run with the checkpoint that it goes on from."""
        hparams = self.trainer.datamodule.hparams  # type: ignore[attr-defined]
        of_data = changed_options(checkpoint.get("datamodule_hyper_parameters"), hparams, "data", {})
        of_model = changed_options(checkpoint.get("hyper_parameters"), self.hparams, "model", self.flat)
        if data != self._data_hash:
            changes = "".join(f", {name} {change}" for name, change in of_data.items())
            expected = f"the training data of the checkpoint (hash {short(str(data))})"
            reason = "their scale and concepts would stay those of the checkpoint; start again without --ckpt_path"
            raise UserError(f"ckpt_path: expected {expected}, found others (hash {self._data_hash}{changes[:80]}): {reason}")
        if {"model.learning_rate", "model.weight_decay"} & of_model.keys():
            apply_rates(checkpoint, self.hparams["learning_rate"], self.hparams["weight_decay"])
        if changes := ", ".join(f"{name} {change}" for name, change in (of_model | of_data).items()):
            note(f"ckpt_path: from step {checkpoint['global_step']} on, {changes}")


class _Teaching:
    """Auxiliary losses of image encodings, and replacement of encodings by privileged information.

    Args:
        weights: loss weights by name, see :class:`~ftl_lightning.domains.domain.Privileged`; empty for none.
        share: share of each step's windows without encoded images.

    Raises:
        UserError: for a weight or share out of its range, or a share with several names or none.
    """

    def __init__(self, weights: Mapping[str, float], share: float) -> None:
        self.weights, self.share = dict(weights), share
        for name, weight in self.weights.items():
            check_range(f"model.privileged.{name}", weight, 0, LARGEST_FACTOR)
        check_range("model.unencoded", share, 0, 1)
        if share == 1 or (share and len(self.weights) != 1):
            raise UserError(f"model.unencoded: expected less than 1, and one name in model.privileged, found {share}")

    def check_taught(self, domain: Domain, images: ImageEncoders | None) -> None:
        """Refuse names that the domain does not provide or the encoder of ``images`` cannot predict."""
        for name in self.weights:
            privileged = domain.recordings.privileged.get(name)
            if privileged is None or images is None:
                names = ", ".join(domain.recordings.privileged) if images is not None else "none, as no image is observed"
                raise UserError(f"model.privileged: expected {names or 'none'} (domain {domain.name}), found {short(name)!r}")
            place, expected = f"model.privileged.{name}", f"image_encoder of {privileged.feature.shape[0]} points"
            require(images.size == privileged.feature.size, place, expected, f"{images.size} outputs")
            possible = not self.share or privileged.simulate is not None
            require(possible, "model.unencoded", f"0, as the domain does not simulate encodings of {name!r}", self.share)

    def attach(self, images: ImageEncoders | None) -> None:
        """Keep the outputs of image encoders."""
        if self.weights and images is not None:
            images.register_forward_hook(self._keep)

    def _keep(self, module: torch.nn.Module, inputs: Any, read: Tensor) -> None:
        self._read = read

    def errors(self, domain: Domain, observed: Observed) -> dict[str, Tensor]:
        """Mean prediction error of the last image encodings, by name."""
        return {name: domain.recordings.privileged[name].error(self._read, observed[name]).mean() for name in self.weights}

    def split(self, domain: Domain, batch: Batch) -> tuple[Batch, Batch | None]:
        """Split a batch into windows with encoded images (not empty) and windows without images."""
        count = max(1, round((1 - self.share) * len(batch.states)))
        if count >= len(batch.states):
            return batch, None
        images = [name for name, feature in domain.observed.items() if feature.kind == "image"]
        vectors = {name: values[count:] for name, values in batch.observed.items() if name not in images}
        first = Batch(batch.states[:count], batch.concepts[:count], take(batch.observed, slice(count)))
        return first, Batch(batch.states[count:], batch.concepts[count:], vectors)

    def simulated(self, domain: Domain, observed: Observed, draw: torch.Generator) -> dict[str, Tensor]:
        """Add simulated image encodings to the observations of windows without images."""
        (name,) = self.weights
        simulate = domain.recordings.privileged[name].simulate
        assert simulate is not None
        return {**observed, READ: simulate(observed[name], draw)}


def check_dropout(shares: Mapping[str, float], features: Mapping[str, Feature]) -> dict[str, float]:
    """Check and return the probabilities; ``UserError`` for a name that is not an observed vector."""
    vectors = [name for name, feature in features.items() if feature.kind == "vector"]
    for name in shares:
        if name not in vectors:
            expected = f"one of {', '.join(vectors)}" if vectors else "nothing, as no vector is observed"
            raise UserError(f"model.feature_dropout: expected {expected}, found {name!r}")
    return dict(shares)


def check_shown(concepts: Sequence[str], shown: Sequence[str]) -> None:
    """Refuse training concepts without demonstrations, for in-context methods; ``UserError`` with the first such concept."""
    if absent := [text for text in concepts if text not in set(shown)]:
        raise UserError(
            f"data: expected a demonstration of each of {len(concepts)} training concepts, found none of {len(absent)}, such as "
            f"{absent[0]!r}; this method cannot do without"
        )


def check_different(concepts: Sequence[str], embeddings: Tensor) -> None:
    """Refuse concepts with equal text embeddings, such as texts that differ only in capitals.

    Raises:
        UserError: with two such concepts.
    """
    for number, text in enumerate(concepts):
        same = (embeddings[:number] == embeddings[number]).all(dim=1).nonzero()
        if len(same):
            first = concepts[int(same[0])]
            raise UserError(f"concepts: {first!r} and {text!r} have the same embedding of data.encoder; change a text")
