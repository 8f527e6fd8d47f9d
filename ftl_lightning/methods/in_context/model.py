"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer reads demonstrations and goes on as they do."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.concepts.composition import Composition, batched
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import Observed, moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.prepared import Prepared
from ftl_lightning.learning.transitions import StepConfig, unroll
from ftl_lightning.methods.in_context import METHOD
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
        prepared: what it is built for.

    Raises:
        UserError: for a width that is no multiple of the heads.
    """

    method = METHOD
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
        self.register_buffer("start", torch.zeros(config.state_dim))  # the present, as transitions begin with it

    @property
    def window(self) -> int:
        return self.config.window

    def prompts(self, demonstrations: Demonstrations, perturbed: bool = False) -> Tensor:
        """Each demonstration as the model reads it ``(demo, n)``.

        Args:
            demonstrations: with features observed at every time.
            perturbed: as the model's view perturbs them, where its configuration says so.

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
        if perturbed and self._perturb is not None:
            states, seen = self._perturb(states, seen, None)
        read = torch.cat((self.present_vector(seen), self.encode(states[:, ::stride], seen)[:, -1]), dim=-1)
        return read.unflatten(0, (-1, tokens)).flatten(1).cpu()

    def present_vector(self, observed: Observed) -> Tensor:
        """What is observed ``(batch, m)`` as the network sees it, see :meth:`vector`.

        Raises:
            UserError: where nothing is observed.
        """
        vector = self.vector(observed)
        if vector is None:
            raise UserError(
                f"domain: expected one with observed features, found {self.domain.name}: there is no present to go on from"
            )
        return vector

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
            present = torch.zeros(len(compositions) * count, 0, device=self.device) if vector is None else vector
            logits = self.follow(memory, given, present.unflatten(0, (len(compositions), count)))
            if temperature:
                drawn = [torch.rand(shape, generator=one, device=one.device) for one in generators]
                gumbel = -(-torch.stack(drawn).clamp(1e-9, 1 - 1e-7).log()).log()
                logits = logits / temperature + gumbel.to(self.device)
            following = middles[logits.argmax(dim=-1)].flatten(0, 1)
            return torch.stack((self.start.expand_as(following), following), dim=1)

        return unroll(self, self.config, predict, observed or {}).unflatten(0, (len(compositions), count))
