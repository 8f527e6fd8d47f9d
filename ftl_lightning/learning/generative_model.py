"""The conditional generative model: denoiser, schedule, normalisation and concept space, and the folder it is kept in."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from ftl_lightning import diffusion
from ftl_lightning.concepts.composition import composed_epsilon
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion.denoiser import Sizes
from ftl_lightning.diffusion.prediction import PREDICTIONS, Prediction
from ftl_lightning.diffusion.samplers import Sampler
from ftl_lightning.diffusion.schedule import cosine_alpha_bar
from ftl_lightning.domains.domain import View, load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import FORMAT, bytes_hash, file_hash, load_tensors, save_tensors, serialise, write_text

KIND = "generative model"
CONFIG, WEIGHTS = "config.json", "model.safetensors"


@dataclass(frozen=True, kw_only=True)
class ModelConfig(Sizes):
    """What is needed to build a model before its weights are read, beside the sizes.

    Attributes:
        domain: name of the domain.
        training_concepts: texts, in the order of the model's table of training embeddings.
        encoder: identity of the text encoder.
        denoiser: name of a class of :mod:`ftl_lightning.diffusion`.
        denoiser_args: its arguments other than the sizes.
        diffusion_steps: T.
        prediction: what the network puts out, ``'epsilon'`` (the paper's), ``'v'``, ``'clean'`` or ``'displacement'``.
        view: name of the domain's view that the model sees behaviour with; empty for as it is.
        perturb: the present is perturbed while learning, see :class:`~ftl_lightning.domains.domain.View`.
        state_columns: columns of the initial state that hold the state a plan starts from.
        training: how it was trained, for the record.
    """

    domain: str
    training_concepts: tuple[str, ...]
    encoder: str
    denoiser: str = "MLPDenoiser"
    denoiser_args: Mapping[str, Any] = field(default_factory=dict)
    diffusion_steps: int = 100
    prediction: str = "epsilon"
    view: str = ""
    perturb: bool = False
    state_columns: tuple[int, ...] = ()
    training: Mapping[str, Any] = field(default_factory=dict)


def load_view(domain: str, name: str) -> View | None:
    """A domain's view by its name; ``None`` for the empty one.

    Raises:
        UserError: for a name that is none.
    """
    if not name:
        return None
    views = load_domain(domain).views
    if name not in views:
        raise UserError(f"model.view: expected one of {', '.join(map(repr, ('', *views)))}, found {name!r}")
    return views[name]


def build_denoiser(config: ModelConfig) -> nn.Module:
    """A fresh denoiser of the configured class and size.

    Raises:
        UserError: for a class that :mod:`ftl_lightning.diffusion` does not have, or arguments it does not take.
    """
    if config.denoiser not in diffusion.__all__:
        raise UserError(f"denoiser: expected one of {', '.join(diffusion.__all__)}, found {config.denoiser!r}")
    if config.prediction not in PREDICTIONS:
        raise UserError(f"prediction: expected one of {', '.join(PREDICTIONS)}, found {config.prediction!r}")
    kind: type[nn.Module] = getattr(diffusion, config.denoiser)
    try:
        denoiser = kind(config, **config.denoiser_args)
    except TypeError as error:
        raise UserError(f"denoiser_args: {config.denoiser} does not take them ({error})") from error
    if config.prediction == "epsilon":
        return denoiser
    return Prediction(denoiser, config.prediction, config.diffusion_steps, config.state_columns)


class GenerativeModel(nn.Module):
    """A denoiser with everything that is needed to go from words and states to states.

    The model's concept space is the encoder's, centred on the training concepts and scaled to unit mean square: language
    models put a large common part into all embeddings, which hides what tells two concepts apart.

    Args:
        config: sizes and names.
        normalization: of states.
        embeddings: the encoder's embeddings ``(1 + training concepts, n)``, the empty text first.
        initial_normalization: of initial states, where the domain has them.
    """

    alpha_bar: Tensor
    centre: Tensor
    spread: Tensor
    empty: Tensor
    training_embeddings: Tensor

    def __init__(
        self,
        config: ModelConfig,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.view = load_view(config.domain, config.view)
        if config.perturb and (self.view is None or self.view.perturb is None):
            raise UserError(f"model.perturb: expected a view that can perturb the present, found {config.view!r}")
        self.denoiser = build_denoiser(config)
        self.normalization = normalization
        self.initial_normalization = initial_normalization
        self.register_buffer("alpha_bar", cosine_alpha_bar(config.diffusion_steps))
        training = embeddings[1:]
        self.register_buffer("centre", training.mean(dim=0))
        self.register_buffer("spread", (training - self.centre).square().mean().sqrt())
        self.register_buffer("empty", self.standardise(embeddings[0]))
        self.register_buffer("training_embeddings", self.standardise(training))

    def standardise(self, embeddings: Tensor) -> Tensor:
        """The encoder's embeddings ``(..., n)`` to the model's concept space."""
        return (embeddings - self.centre) / self.spread

    def concept(self, text: str) -> Tensor:
        """The embedding ``(n,)`` of a training concept.

        Raises:
            UserError: for a text that is none.
        """
        if text not in self.config.training_concepts:
            raise UserError(
                f"concept {text!r}: expected a training concept of the model: {'; '.join(self.config.training_concepts)}"
            )
        return self.training_embeddings[self.config.training_concepts.index(text)]

    def named_embeddings(self) -> dict[str, Tensor]:
        """The training concepts' embeddings ``(n,)`` by text, and the empty one's."""
        return {"(empty)": self.empty} | dict(zip(self.config.training_concepts, self.training_embeddings, strict=True))

    def check(self, concept: Concept, path: str | Path) -> None:
        """Refuse a learned concept that belongs to another model.

        Raises:
            UserError: if encoder, domain or pretrained model differ.
        """
        mine = {"encoder": self.config.encoder, "domain": self.config.domain, "pretrained": self.hash}
        for key, expected in mine.items():
            if (found := getattr(concept.origin, key)) != expected:
                raise UserError(
                    f"{path}: key {key!r}: expected {expected!r} (the pretrained model's), found {found!r}; learn it again"
                )

    def perturbed(self, states: Tensor, initial_states: Tensor | None, draw: torch.Generator) -> tuple[Tensor, Tensor | None]:
        """What to learn from: behaviour and initial states with another present, if the model's configuration says so."""
        if not self.config.perturb:
            return states, initial_states
        assert self.view is not None
        assert self.view.perturb is not None
        assert initial_states is not None
        noise = torch.randn((len(states), 2), generator=draw, device=draw.device)
        return self.view.perturb(states, initial_states, noise)

    def encode(self, states: Tensor, initial_states: Tensor | None) -> Tensor:
        """Behaviour ``(sample, horizon, state)`` in the domain's units to what the denoiser sees."""
        if self.view is not None:
            assert initial_states is not None
            states = self.view.encode(states, initial_states)
        return self.normalization.encode(states)

    def decode(self, normalised: Tensor, initial_states: Tensor | None) -> Tensor:
        """The inverse of :meth:`encode`."""
        states = self.normalization.decode(normalised)
        if self.view is not None:
            assert initial_states is not None
            states = self.view.decode(states, initial_states)
        return states

    def encode_initial(self, initial_states: Tensor | None) -> Tensor | None:
        """Initial states ``(batch, m)`` as the denoiser sees them, or ``None`` for a model that is not conditioned on any.

        Raises:
            UserError: if the model needs them and there are none, or their size is another.
        """
        if self.initial_normalization is None:
            return None
        seen = self.view.observe(initial_states) if self.view and initial_states is not None else initial_states
        expected = self.config.initial_state_dim
        if seen is None or seen.shape[-1] != expected:
            found = "none" if seen is None else str(seen.shape[-1])
            raise UserError(f"key 'initial_states': expected {expected} numbers each (the pretrained model's), found {found}")
        return self.initial_normalization.encode(seen)

    @torch.no_grad()
    def sample(
        self,
        concepts: Sequence[Tensor],
        weights: Sequence[Tensor],
        count: int,
        sampler: Sampler,
        steps: int,
        temperature: float,
        generators: Sequence[torch.Generator],
        initial_states: Tensor | None = None,
    ) -> Tensor:
        """Generate behaviour of several compositions in one batch.

        Args:
            concepts: for each composition ``(K, n)``; K may differ between them.
            weights: for each composition ``(K,)``.
            count: samples of each.
            sampler, steps, temperature: see :mod:`ftl_lightning.diffusion.samplers`.
            generators: of the noise, one for each composition, so that its samples do not depend on what is sampled beside it.
            initial_states: ``(composition * count, initial state)`` in the domain's units, or ``None``.

        Returns:
            ``(composition, count, horizon, state)`` in the domain's units.
        """
        # Compositions with fewer components are padded with empty ones of weight zero, which add nothing.
        embeddings = nn.utils.rnn.pad_sequence(list(concepts), batch_first=True)
        omega = nn.utils.rnn.pad_sequence(list(weights), batch_first=True)
        s0 = self.encode_initial(initial_states)

        def epsilon(x: Tensor, t: Tensor) -> Tensor:
            return composed_epsilon(self.denoiser, x, t, embeddings, omega, self.empty, s0)

        shape = (count, self.config.horizon, self.config.state_dim)

        def noise() -> Tensor:
            # Drawn on the generators' device, so that a seed gives the same samples wherever the model runs.
            drawn = [torch.randn(shape, generator=one, device=one.device) for one in generators]
            return torch.cat(drawn).to(self.alpha_bar.device)

        plans = sampler(epsilon, noise, self.alpha_bar, steps, temperature)
        return self.decode(plans, initial_states).unflatten(0, (len(concepts), count))

    @property
    def hash(self) -> str:
        """Hash of the weights, the same as :func:`~ftl_lightning.tensor_file.file_hash` of the saved file."""
        return bytes_hash(serialise(KIND, self._stored(), {"domain": self.config.domain}))

    def _stored(self) -> dict[str, Tensor]:
        """What the file holds: the denoiser's weights in half precision, everything else as it is."""
        return {name: value.half() if name.startswith("denoiser.") else value for name, value in self.state_dict().items()}

    def save(self, folder: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``, each whole or not at all; weights in half precision."""
        folder = Path(folder)
        save_tensors(folder / WEIGHTS, KIND, self._stored(), {"domain": self.config.domain})
        write_text(folder / CONFIG, json.dumps({"format": FORMAT, "hash": self.hash, **asdict(self.config)}, indent=2) + "\n")

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a folder written by :meth:`save`; the model is frozen and in evaluation mode.

        Raises:
            UserError: naming the file, if it is missing, damaged, or the two files do not belong together.
        """
        path = Path(folder) / CONFIG
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            expected_hash = content.pop("hash")
            if content.pop("format") != FORMAT:
                raise ValueError(f"format is not {FORMAT}")
            for key in ("training_concepts", "entities", "looks", "state_columns"):
                content[key] = tuple(tuple(one) if isinstance(one, list) else one for one in content.get(key, ()))
            config = ModelConfig(**content)
        except OSError as error:
            raise UserError(
                f"{path}: expected a pretrained model, found {error.strerror}; run: python -m ftl_lightning fit"
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path}: expected the configuration of a pretrained model, found something else ({error})") from error
        weights = Path(folder) / WEIGHTS
        tensors, _ = load_tensors(weights, KIND)
        if (found := file_hash(weights)) != expected_hash:
            raise UserError(
                f"{weights}: expected the hash {expected_hash} that {CONFIG} names, found {found}; copy both files again"
            )
        blank = torch.zeros(config.state_dim)
        initial = torch.zeros(config.initial_state_dim)
        model = cls(
            config,
            Normalization(blank, blank),
            torch.zeros(1 + len(config.training_concepts), config.concept_dim),
            Normalization(initial, initial) if config.initial_state_dim else None,
        )
        try:
            model.load_state_dict(tensors)
        except RuntimeError as error:
            raise UserError(f"{weights}: does not fit {CONFIG} ({str(error).splitlines()[-1].strip()})") from error
        return model.requires_grad_(False).eval()
