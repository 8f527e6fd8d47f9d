"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer prompted with demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed, moved
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.bases import StepConfig, unroll
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.validation import LARGEST, check_range
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_config import Prepared


@dataclass(frozen=True, kw_only=True)
class InContextConfig(StepConfig):
    """Configuration of the transformer; ``concept_dim`` is the size of an encoded demonstration.

    Attributes:
        tokens: number of initial transitions of a demonstration in the prompt.
        bins: number of bins per value of a transition.
        width: embedding size of a token.
        layers, heads: number of layers and heads of encoder and decoder.
    """

    tokens: int = 16
    bins: int = 20
    width: int = 128
    layers: int = 4
    heads: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("tokens", "bins", "width", "heads"):
            check_range(f"model.{name}", getattr(self, name), 1, LARGEST)
        check_range("model.layers", self.layers, 1, 100)


class InContextModel(ConceptModel):
    """Predicts the next state from the observation and a few demonstrations, its concepts.

    The encoder reads transitions, with a zero vector between demonstrations. The decoder reads the current observation (the paper's
    window of 1) and predicts probabilities of bins over [-1, 1] for each value of the next state.

    Raises:
        UserError: for a width that is not a multiple of the heads.
    """

    kind = "in-context"
    Config = InContextConfig
    config: InContextConfig
    start: Tensor

    def __init__(self, prepared: Prepared[InContextConfig]) -> None:
        super().__init__(prepared)
        config = prepared.config
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
        self.register_buffer("start", torch.zeros(config.state_dim))  # first state of transitions

    @property
    def window(self) -> int:
        return self.config.window

    def prompts(self, demonstrations: Demonstrations, perturbed: bool = False) -> Tensor:
        """Encode demonstrations as prompts ``(demo, n)``; ``UserError`` if features are observed only at the first time.

        Args:
            demonstrations: demonstrations with features observed at every time.
            perturbed: apply the view's perturbation, if configured.
        """
        if not demonstrations.per_step or not set(self.domain.observed) <= set(demonstrations.per_step):
            raise UserError("key 'per_step': expected every feature to be observed at each time, found others")
        tokens, stride = self.config.tokens, self.config.stride
        rows = torch.arange(len(demonstrations)).repeat_interleave(tokens)
        starts = (stride * torch.arange(tokens)).repeat(len(demonstrations))
        states, observed = demonstrations.windows(rows, starts.minimum(demonstrations.lengths[rows] - 1), self.window)
        features: Observed = moved(observed, self.device)
        states = states.to(self.device)
        if perturbed and self._perturb is not None:
            states, features = self._perturb(states, features, None)
        states_read = torch.cat((self.present_vector(features), self.encode(states[:, ::stride], features)[:, -1]), dim=-1)
        return states_read.unflatten(0, (-1, tokens)).flatten(1).cpu()

    def present_vector(self, observed: Observed) -> Tensor:
        """Normalised observation ``(batch, m)``, see :meth:`vector`; ``UserError`` for a domain without observed features."""
        if (vector := self.vector(observed)) is None:
            raise UserError(
                f"domain: expected a domain with observed features, found {self.domain.name}: there is no present to go on from"
            )
        return vector

    def read(self, prompts: Tensor, given: Tensor) -> Tensor:
        """Encode ``prompts (group, K, n)`` to memory ``(group, K (tokens + 1), width)``, with mask ``given (group, K)``."""
        tokens = functional.pad(prompts.unflatten(-1, (self.config.tokens, -1)), (0, 0, 0, 1))
        memory: Tensor = self.encoder((self.token(tokens) + self.place).flatten(1, 2), src_key_padding_mask=self._missing(given))
        return memory

    def _missing(self, given: Tensor) -> Tensor:
        return ~given.repeat_interleave(self.config.tokens + 1, dim=1)

    def follow(self, memory: Tensor, given: Tensor, observed: Tensor) -> Tensor:
        """Logits ``(group, query, state, bin)`` of the states after ``observed (group, query, m)``; queries are independent."""
        others = ~torch.eye(observed.shape[1], dtype=torch.bool, device=observed.device)
        out = self.decoder(self.present(observed), memory, tgt_mask=others, memory_key_padding_mask=self._missing(given))
        return self.head(out).unflatten(-1, (self.config.state_dim, self.config.bins))

    def bins(self, normalised: Tensor) -> Tensor:
        """Bin of each value."""
        return ((normalised + 1) / 2 * self.config.bins).long().clamp(0, self.config.bins - 1)

    def read_concepts(self, demonstrations: Demonstrations) -> dict[str, Concept]:
        """Encode demonstrations as concepts; ``UserError`` for features observed only at the first time."""
        concepts = {}
        for name in dict.fromkeys(demonstrations.concepts):
            prompts = self.prompts(demonstrations.select(name))
            origin = self.origin(demonstrations, name, "fixed", 0.0)
            concepts[name] = Concept(prompts[:, None], torch.ones(len(prompts)), origin)
        return concepts

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Sample plans. The temperature scales the bins' logits; 0 selects the most probable bin.

        Weights, sampler and steps are ignored.

        Raises:
            UserError: for a concept with weight on some columns only.
        """
        if any(composition.columns is not None for composition in compositions):
            raise UserError("compose: expected concepts without '@' for a model that reads demonstrations, found groups of columns")
        prompts = batched(compositions, count, generators)[0].embeddings.flatten(2)
        temperature = sampling.temperature
        counts = torch.tensor([len(composition.weights) for composition in compositions], device=self.device)
        given = torch.arange(prompts.shape[1], device=self.device) < counts[:, None]
        memory = self.read(prompts, given)
        middles = (torch.arange(self.config.bins, device=self.device) + 0.5) / self.config.bins * 2 - 1
        shape = (count, self.config.state_dim, self.config.bins)

        def predict(vector: Tensor | None) -> Tensor:
            present = torch.zeros(len(compositions) * count, 0, device=self.device) if vector is None else vector
            logits = self.follow(memory, given, present.unflatten(0, (len(compositions), count)))
            if temperature:
                drawn = [torch.rand(shape, generator=draw, device=draw.device) for draw in generators]
                gumbel = -(-torch.stack(drawn).clamp(1e-9, 1 - 1e-7).log()).log()
                logits = logits / temperature + gumbel.to(self.device)
            following = middles[logits.argmax(dim=-1)].flatten(0, 1)
            return torch.stack((self.start.expand_as(following), following), dim=1)

        return unroll(self, self.config, predict, observed or {}).unflatten(0, (len(compositions), count))
