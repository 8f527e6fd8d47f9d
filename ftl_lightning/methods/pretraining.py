"""Pretraining of the baselines (paper, 'Baselines' and 'Implementation Details')."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.features import moved
from ftl_lightning.methods.bases import check_window
from ftl_lightning.methods.bc import CloningConfig, CloningModel
from ftl_lightning.methods.cvae import VAEConfig, VAEModel
from ftl_lightning.methods.in_context import InContextConfig, InContextModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.validation import check_range
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.method import check_present
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.training.pretraining import Pretraining, check_shown


class CloningPretraining(Pretraining[CloningModel]):
    """Fits the policy to transitions of a domain's pairs of behaviour and concept.

    Args:
        hidden_dim, members: see :class:`CloningConfig`.
        plan_horizon: states in an unrolled plan; ``None`` for the domain's.
        stride: see :class:`~ftl_lightning.methods.bases.StepConfig`; ``data.horizon`` is ``stride + 1``, or 1.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    def __init__(
        self, hidden_dim: int = 512, members: int = 1, plan_horizon: int | None = None, stride: int = 1, **options: Any
    ) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        check_range("model.hidden_dim", hidden_dim, 1)
        if plan_horizon is not None:
            check_range("model.plan_horizon", plan_horizon, 1)
        self.stride = stride

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> CloningModel:
        sizes = {name: self.hparams[name] for name in ("hidden_dim", "members", "stride")}
        horizon = self.hparams["plan_horizon"] or data.domain.plans.horizon
        policy = prepared.configured(CloningConfig, horizon=horizon, **sizes)
        check_window(policy.config, data)
        return CloningModel(policy)

    def losses(self, model: CloningModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Squared error of transitions."""
        states, seen = batch.states, batch.observed
        return model.errors(states, seen, model.training_embeddings[batch.concepts])


class VAEPretraining(Pretraining[VAEModel]):
    """Fits encoder and decoder to a domain's behaviour; a training concept is the encoding of its first demonstration.

    Args:
        latent_dim: size of z.
        hidden_dim: see :class:`VAEConfig`.
        beta: weight of the divergence from the prior, per value of the behaviour, relative to the squared error.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    def __init__(self, latent_dim: int = 20, hidden_dim: int = 512, beta: float = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        check_range("model.latent_dim", latent_dim, 1)
        check_range("model.hidden_dim", hidden_dim, 1)
        check_range("model.beta", beta, 0)

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> VAEModel:
        latent = self.hparams["latent_dim"]
        check_shown(prepared.config.training_concepts, data.training.concepts)
        self._first = data.first_windows()
        networks = prepared.configured(VAEConfig, concept_dim=latent, hidden_dim=self.hparams["hidden_dim"])
        return VAEModel(networks.embedded(torch.zeros(len(prepared.embeddings), latent)))

    def losses(self, model: VAEModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Negative evidence lower bound per value of the behaviour (Kingma & Welling, 2014)."""
        states, seen = batch.states, batch.observed
        mean, log_variance = model.posterior(states, seen)
        noise = drawn(len(mean), lambda n: torch.randn((n, *mean.shape[1:]), generator=draw, device=mean.device))
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        numbers = model.config.horizon * model.config.state_dim
        errors = model.errors(states, seen, mean + (0.5 * log_variance).exp() * noise)
        return errors + self.hparams["beta"] * divergence / numbers

    def _represent(self) -> None:
        model = self.model
        states, _, seen = self._first
        with torch.no_grad():
            mean, _ = model.posterior(states.to(self.device), moved(seen, self.device))
        model.training_embeddings.copy_(mean)

    def on_validation_start(self) -> None:
        super().on_validation_start()
        self._represent()

    def on_test_start(self) -> None:
        self._represent()

    def on_fit_end(self) -> None:
        self._represent()
        super().on_fit_end()


class InContextPretraining(Pretraining[InContextModel]):
    """Fits the transformer to predict transitions, prompted with demonstrations of the same concept (negative log-likelihood).

    Args:
        tokens, bins, width, layers, heads: see :class:`InContextConfig`.
        prompts: maximum number of demonstrations in a prompt; the number is drawn per step and concept.
        plan_horizon: number of states in an unrolled plan; ``None`` for the domain's.
        stride: see :class:`~ftl_lightning.methods.bases.StepConfig`; ``data.horizon`` is ``stride + 1``.
        images: folder of a trained model of any method with frozen image encoders for observed images, as demonstrations are
            encoded before training.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.

    Raises:
        UserError: for a value out of range, or a model without images in ``images``.
    """

    def __init__(
        self,
        tokens: int = 16,
        bins: int = 20,
        width: int = 128,
        layers: int = 4,
        heads: int = 4,
        prompts: int = 5,
        plan_horizon: int | None = None,
        stride: int = 1,
        images: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        if images is not None:
            source = load_model(images)
            if source.images is None:
                raise UserError(f"model.images: expected a model that observes images, found {images}, which does not")
            self.image_encoder, self._images = dict(source.config.image_encoder), source.images.state_dict()
        if prompts < 1:
            raise UserError(f"model.prompts: expected 1 or more, found {prompts}")
        self.stride = stride

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> InContextModel:
        config = prepared.config
        check_present(data.domain)
        if config.image_dim and self.hparams["images"] is None:
            raise UserError("model.images: expected the folder of a model that reads these images, found none")
        sizes = {name: self.hparams[name] for name in ("tokens", "bins", "width", "layers", "heads", "stride")}
        size = sizes["tokens"] * (config.vector_dim + config.state_dim)
        horizon = self.hparams["plan_horizon"] or data.domain.plans.horizon
        transformer = prepared.configured(InContextConfig, concept_dim=size, horizon=horizon, **sizes)
        check_window(transformer.config, data)
        model = InContextModel(transformer.embedded(torch.zeros(len(prepared.embeddings), size)))
        if model.images is not None:
            take_images(model.images, self._images, self.hparams["images"])
        self._prompts = model.prompts(data.training)
        # Perturb whole prompts, half of the time, like observations.
        self._perturbed = model.prompts(data.training, perturbed=True) if config.perturb else self._prompts
        texts = data.training.concepts
        check_shown(config.training_concepts, texts)
        self._rows = [[row for row, text in enumerate(texts) if text == concept] for concept in config.training_concepts]
        model.training_embeddings.copy_(self._prompts[[rows[0] for rows in self._rows]])
        windows = data.first_windows()
        model.start.copy_(model.encode(windows.states[:, :: self.stride], windows.observed)[:, 0].mean(dim=0))
        return model

    def losses(self, model: InContextModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Negative log-likelihood of the next state's bins."""
        states, seen = batch.states, batch.observed
        observed = model.present_vector(seen)
        target = model.bins(model.encode(states[:, :: self.stride], seen)[:, -1])
        most, groups = self.hparams["prompts"], len(self._rows)
        rows = [[demos[int(u * len(demos))] for u in torch.rand(most, generator=draw, device=draw.device)] for demos in self._rows]
        counts = torch.randint(1, most + 1, (groups, 1), generator=draw, device=draw.device) if model.training else most
        given = torch.arange(most, device=draw.device).expand(groups, most) < counts
        perturbed = torch.rand((groups, 1, 1), generator=draw, device=draw.device) < 0.5
        plain, altered = (prompts[torch.tensor(rows)].to(draw.device) for prompts in (self._prompts, self._perturbed))
        memory = model.read(torch.where(perturbed, altered, plain), given)
        # Each row of the batch holds the queries of a concept, padded to the longest.
        queries = [(batch.concepts == group).nonzero()[:, 0] for group in range(groups)]
        index = nn.utils.rnn.pad_sequence(queries, batch_first=True, padding_value=-1)
        logits = model.follow(memory, given, observed[index])[index >= 0]
        return functional.cross_entropy(logits.movedim(-1, 1), target[index[index >= 0]], reduction="none").mean(dim=1)


def take_images(encoders: nn.Module, weights: Mapping[str, Tensor], folder: str) -> None:
    """Load image encoders from a trained model and freeze the weights; ``UserError`` for a model that observes other images."""
    try:
        encoders.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(f"model.images: expected a model that observes the same images, found {folder}") from error
    encoders.requires_grad_(False)
