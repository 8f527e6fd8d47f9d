"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer reads demonstrations and goes on as they do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.concepts.composition import Composition, batched
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import Observed, moved
from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion.denoiser import Sizes
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.data import Batch, PretrainingData
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError
from ftl_lightning.learning.baselines.transitions import StepConfig, expect_window, unroll
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.learning.pretraining import Pretraining, expect_shown
from ftl_lightning.ranges import LARGEST, expect_range


@dataclass(frozen=True, kw_only=True)
class InContextConfig(StepConfig):
    """What the transformer needs to be built; ``concept_dim`` is the size of one demonstration as it reads it.

    Attributes:
        tokens: transitions of a demonstration that are read, from its first.
        bins: of each number of a transition.
        width: features of a token.
        layers, heads: of encoder and decoder.
    """

    tokens: int = 16
    bins: int = 20
    width: int = 128
    layers: int = 4
    heads: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("tokens", "bins", "width", "heads"):
            expect_range(f"model.{name}", getattr(self, name), 1, LARGEST)
        expect_range("model.layers", self.layers, 1, 100)


class InContextModel(ConceptModel):
    """What follows the present, from a few demonstrations; its 'concepts' are those demonstrations.

    The encoder reads transitions, demonstrations apart by a zero vector; the decoder is given the present (the paper's window of 1)
    and puts out, for each number of what follows, probabilities of bins over [-1, 1].

    Args:
        config, domain, normalization, embeddings, initial_normalization: see :class:`ConceptModel`.
    """

    kind = "in-context"
    name = "in-context"
    Config = InContextConfig
    config: InContextConfig
    start: Tensor

    def __init__(
        self,
        config: InContextConfig,
        domain: Domain,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        super().__init__(config, domain, normalization, embeddings, initial_normalization)
        if config.width % config.heads:
            raise UserError(f"model.width: expected a multiple of {config.heads} (model.heads), found {config.width}")
        numbers = config.vector_dim + config.state_dim
        self.token = nn.Linear(numbers, config.width)
        self.place = nn.Parameter(0.02 * torch.randn(config.tokens + 1, config.width))
        self.present = nn.Linear(config.vector_dim, config.width)
        form = {"dim_feedforward": 2 * config.width, "dropout": 0.0, "batch_first": True, "norm_first": True}
        layer = nn.TransformerEncoderLayer(config.width, config.heads, **form)  # type: ignore[arg-type]
        self.encoder = nn.TransformerEncoder(layer, config.layers, enable_nested_tensor=False)
        self.decoder = nn.TransformerDecoder(
            nn.TransformerDecoderLayer(config.width, config.heads, **form),  # type: ignore[arg-type]
            config.layers,
            nn.LayerNorm(config.width),
        )
        self.head = nn.Linear(config.width, config.state_dim * config.bins)
        self.register_buffer("start", torch.zeros(config.state_dim))  # the present, as transitions begin with it

    @property
    def window(self) -> int:
        return self.config.window

    def prompts(self, demonstrations: Demonstrations, hide: bool = False) -> Tensor:
        """Each demonstration as the model reads it ``(demo, n)``.

        Args:
            demonstrations: with features observed at every time.
            hide: without what a new task will not show, if the model's view can hide that.

        Raises:
            UserError: where features are observed for the first time alone.
        """
        if not demonstrations.per_step or not set(self.domain.observed) <= set(demonstrations.per_step):
            raise UserError("key 'per_step': expected every feature to be observed at each time, found others")
        tokens, stride = self.config.tokens, self.config.stride
        rows = torch.arange(len(demonstrations)).repeat_interleave(tokens)
        starts = (stride * torch.arange(tokens)).repeat(len(demonstrations))
        states, own = demonstrations.windows(rows, starts.minimum(demonstrations.lengths[rows] - 1), self.window)
        seen: Observed = moved(own, self.device)
        states = states.to(self.device)
        if hide:
            assert self.view is not None
            assert self.view.perturb is not None
            states, seen = self.view.perturb(states, seen, None)
        observed = self.vector(seen)
        assert observed is not None
        read = torch.cat((observed, self.encode(states[:, ::stride], seen)[:, -1]), dim=-1)
        return read.unflatten(0, (-1, tokens)).flatten(1).cpu()

    def read(self, prompts: Tensor, given: Tensor) -> Tensor:
        """Memory ``(group, K (tokens + 1), width)`` of the demonstrations ``prompts (group, K, n)`` where ``given (group, K)``."""
        tokens = functional.pad(prompts.unflatten(-1, (self.config.tokens, -1)), (0, 0, 0, 1))
        memory: Tensor = self.encoder((self.token(tokens) + self.place).flatten(1, 2), src_key_padding_mask=self._missing(given))
        return memory

    def _missing(self, given: Tensor) -> Tensor:
        return ~given.repeat_interleave(self.config.tokens + 1, dim=1)

    def follow(self, memory: Tensor, given: Tensor, observed: Tensor) -> Tensor:
        """Logits ``(group, query, state, bin)`` of what follows ``observed (group, query, m)``; queries do not see each other."""
        apart = ~torch.eye(observed.shape[1], dtype=torch.bool, device=observed.device)
        out = self.decoder(self.present(observed), memory, tgt_mask=apart, memory_key_padding_mask=self._missing(given))
        return self.head(out).unflatten(-1, (self.config.state_dim, self.config.bins))

    def bins(self, normalised: Tensor) -> Tensor:
        """The bin of each number."""
        return ((normalised + 1) / 2 * self.config.bins).long().clamp(0, self.config.bins - 1)

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Concepts are demonstrations; the temperature sharpens the bins' probabilities, 0 takes the most probable.

        Weights, sampler and steps do not matter.

        Raises:
            UserError: for a concept whose weight is on some columns alone.
        """
        if any(one.columns is not None for one in compositions):
            raise UserError("compose: expected concepts without '@' for a model that reads demonstrations, found groups of columns")
        prompts = batched(compositions, count, generators)[0].embeddings.flatten(2)
        temperature = sampling.temperature
        counts = torch.tensor([len(one.weights) for one in compositions], device=self.device)
        given = torch.arange(prompts.shape[1], device=self.device) < counts[:, None]
        memory = self.read(prompts, given)
        middles = (torch.arange(self.config.bins, device=self.device) + 0.5) / self.config.bins * 2 - 1
        shape = (count, self.config.state_dim, self.config.bins)

        def predict(vector: Tensor | None) -> Tensor:
            assert vector is not None
            logits = self.follow(memory, given, vector.unflatten(0, (len(compositions), count)))
            if temperature:
                drawn = [torch.rand(shape, generator=one, device=one.device) for one in generators]
                gumbel = -(-torch.stack(drawn).clamp(1e-9, 1 - 1e-7).log()).log()
                logits = logits / temperature + gumbel.to(self.device)
            following = middles[logits.argmax(dim=-1)].flatten(0, 1)
            return torch.stack((self.start.expand_as(following), following), dim=1)

        return unroll(self, predict, observed or {}).unflatten(0, (len(compositions), count))


class InContextPretraining(Pretraining):
    """Fits the transformer to go on as demonstrations of the same training concept do (negative log-likelihood of bins).

    Args:
        tokens, bins, width, layers, heads: see :class:`InContextConfig`.
        prompts: most demonstrations that are given; each step and concept draws one to so many.
        plan_horizon: states in a plan that is unrolled; ``None`` for the domain's.
        stride: see :class:`~ftl_lightning.learning.baselines.transitions.StepConfig`; ``data.horizon`` is one more.
        images: folder of a trained model of any method, whose image encoders are used as they are, where images are observed:
            demonstrations are read before training.
        options: see :class:`~ftl_lightning.learning.pretraining.Pretraining`.
    """

    method = "in-context"

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

    def build(
        self,
        shared: Mapping[str, Any],
        data: PretrainingData,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None,
    ) -> InContextModel:
        if not shared["observed"]:
            raise UserError(f"data.class_path: expected a domain with observed features, found {data.domain.name}: nothing follows")
        own = {name: self.hparams[name] for name in ("tokens", "bins", "width", "layers", "heads", "stride")}
        sizes = Sizes(**{key: shared[key] for key in ("horizon", "state_dim", "concept_dim", "observed", "image_dim")})
        if sizes.image_dim and self.hparams["images"] is None:
            raise UserError("model.images: expected the folder of a model that reads these images, found none")
        size = own["tokens"] * (sizes.vector_dim + sizes.state_dim)
        horizon = self.hparams["plan_horizon"] or data.domain.plans.horizon
        config = InContextConfig(**dict(shared) | own | {"concept_dim": size, "horizon": horizon})
        expect_window(config, data)
        model = InContextModel(config, data.domain, normalization, torch.zeros(len(embeddings), size), initial_normalization)
        if model.images is not None:
            take_images(model.images, self._images, self.hparams["images"])
        self._prompts = model.prompts(data.training)
        # Roads are hidden from whole prompts, as they are from a present in each of two windows.
        self._hidden = model.prompts(data.training, hide=True) if config.perturb else self._prompts
        texts = data.training.concepts
        expect_shown(config.training_concepts, texts)
        self._own = [[row for row, text in enumerate(texts) if text == concept] for concept in config.training_concepts]
        model.training_embeddings.copy_(self._prompts[[own[0] for own in self._own]])
        windows = data.first_windows()
        model.start.copy_(model.encode(windows.states[:, :: self.stride], windows.observed)[:, 0].mean(dim=0))
        return model

    def losses(self, model: ConceptModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Negative log-likelihood of the bins of what follows."""
        assert isinstance(model, InContextModel)
        states, seen = model.perturbed(batch.states, batch.observed, draw)
        observed = model.vector(seen)
        assert observed is not None
        target = model.bins(model.encode(states[:, :: self.stride], seen)[:, -1])
        most, groups = self.hparams["prompts"], len(self._own)
        rows = [[own[int(u * len(own))] for u in torch.rand(most, generator=draw, device=draw.device)] for own in self._own]
        counts = torch.randint(1, most + 1, (groups, 1), generator=draw, device=draw.device) if model.training else most
        given = torch.arange(most, device=draw.device).expand(groups, most) < counts
        hidden = torch.rand((groups, 1, 1), generator=draw, device=draw.device) < 0.5
        shown, other = (prompts[torch.tensor(rows)].to(draw.device) for prompts in (self._prompts, self._hidden))
        memory = model.read(torch.where(hidden, other, shown), given)
        # The queries of each concept are a row of one batch, padded to the longest.
        queries = [(batch.concepts == group).nonzero()[:, 0] for group in range(groups)]
        index = nn.utils.rnn.pad_sequence(queries, batch_first=True, padding_value=-1)
        logits = model.follow(memory, given, observed[index])[index >= 0]
        return functional.cross_entropy(logits.movedim(-1, 1), target[index[index >= 0]], reduction="none").mean(dim=1)


def take_images(encoders: nn.Module, weights: Mapping[str, Tensor], folder: str) -> None:
    """Give image encoders the weights of a trained model's, which stay as they are.

    Raises:
        UserError: for a model that observes other images.
    """
    try:
        encoders.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(f"model.images: expected a model that observes the same images, found {folder}") from error
    encoders.requires_grad_(False)
