"""The few-shot learner in Python: load a pretrained model, learn a concept, sample, compose, judge, draw, execute."""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ftl_lightning.concepts.composition import Composition, Part, parse_composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.concepts.explanation import Explanation, explain
from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.demonstrations.features import Feature, InitialStates
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.execution import Execution, closed_loop_of
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.hub import card as model_card
from ftl_lightning.learning.hub import download, upload
from ftl_lightning.learning.inversion import invert
from ftl_lightning.learning.model_config import DIFFUSION
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.progress import bar
from ftl_lightning.ranges import expect_count
from ftl_lightning.seeding import EVALUATION_SEED, generator
from ftl_lightning.shipped import pretrained_folder, shipped
from ftl_lightning.tensor_file import atomic
from ftl_lightning.trust import vouching
from ftl_lightning.tuned import Tuned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Start = InitialStates | Mapping[str, ArrayLike] | ArrayLike
"""Where behaviour starts: initial states, observed features by name, or the only feature's values ``(sample, *shape)``."""


@dataclass(frozen=True, repr=False)
class LearnedConcept(Composition):
    """A learned concept; it composes with others like any composition.

    Attributes:
        concept: embeddings, weights and where they come from.
        model: it was learned through.
    """

    concept: Concept
    model: ConceptModel

    def __repr__(self) -> str:
        modes = "" if self.modes is None else f", {len(self.modes)} modes{', mixed' if self.modes.mixed else ''}"
        knots = "" if self.knots == 1 else f", {self.knots} knots"
        adapter = "" if self.concept.adapter is None else ", an adapter"
        kind = f"K = {len(self.weights)}{knots}{modes}{adapter}"
        return f"LearnedConcept({self.concept.origin.name!r}, {kind}, loss {self.concept.origin.loss:.3f})"

    def explain(self, nearest: int = 3) -> Explanation:
        """What its weighted sum is made of, in words of the training concepts; of several knots, their mean."""
        embedding = (self.concept.weights @ self.concept.embeddings).unflatten(0, (self.knots, -1)).mean(dim=0)
        return explain(embedding, self.model.config.training_concepts, self.model.training_embeddings.cpu(), nearest)

    def save(self, path: str | Path) -> None:
        """Write it to a file that every command reads."""
        self.concept.save(path)


class FewShot:
    """A pretrained model with everything that is needed to learn a concept from a few demonstrations and to use it.

    Args:
        model: frozen.
        tuned: the settings that go with it, which every method takes unless it is told others.

    Attributes:
        settings: the configuration file that they were read from; empty if none was.
    """

    def __init__(self, model: ConceptModel, tuned: Tuned) -> None:
        self.model, self.tuned = model, tuned
        self.settings = ""
        self._examples: list[Demonstrations] = [] if model.examples is None else [model.examples]

    @classmethod
    def from_pretrained(
        cls, name: str | Path, settings: str | Path | None = None, device: str = "cpu", domain: Domain | str | None = None
    ) -> Self:
        """Load a model.

        Args:
            name: of a model that ships (``'agent'``, ``'driving'``, ``'object_rearrangement'``), a folder, or ``'owner/name'`` on
                the Hugging Face Hub, which is the only case that needs a network.
            settings: configuration file of ``invert`` to take settings from; ``None`` for that of the model's domain.
            device: where to compute.
            domain: of a model of your own, the domain or its name ``'package.module:DOMAIN'``, which is imported. A folder alone
                never names code: without this, or ``settings`` that name it, its domain is one that an installed package offers.

        Raises:
            UserError: naming the place, if there is no model, or one that asks for code.
        """
        folder = pretrained_folder(name)
        if not folder.is_dir() and str(name).count("/") == 1 and not str(name).startswith((".", "~")):
            folder = download(str(name))
        with vouching([] if settings is None else Tuned.domains(settings)):
            model = load_model(folder, domain).to(device)
        if settings is None:
            group = "" if model.kind == DIFFUSION else f"baseline/{model.kind.replace('-', '_')}/"
            own = shipped(f"conf/{group}invert/{model.config.domain}.yaml")
            settings = own if own.is_file() else "conf/invert/own.yaml"
        found = cls(model, Tuned.read(settings))
        found.settings = str(settings)
        return found

    @property
    def domain(self) -> Domain:
        """Whose behaviour the model generates."""
        return self.model.domain

    @property
    def training_concepts(self) -> tuple[str, ...]:
        """Texts that ``model[text]`` knows."""
        return self.model.config.training_concepts

    def __getitem__(self, text: str) -> Composition:
        """A training concept, with weight 1.

        Raises:
            UserError: for a text that is none.
        """
        return Composition(self.model.concept(text)[None], torch.ones(1, device=self.model.device))

    def load(self, path: str | Path) -> LearnedConcept:
        """A learned concept from its file.

        Raises:
            UserError: naming the file, if it is none or belongs to another model.
        """
        concept = Concept.load(path)
        self.model.check(concept, path)
        return self._learned(concept)

    def compose(self, text: str) -> Composition:
        """``'go to red object:1.2 + other.safetensors:0.9'``: training concepts and files of learned concepts, with weights.

        After an ``@`` the groups of columns that a concept is composed on: ``'walk@legs + jumping_jacks.safetensors@arms,trunk'``.

        Raises:
            UserError: for a part that is neither, or nothing at all.
        """
        parts = [self._part(part) for part in parse_composition(text)]
        if not parts:
            raise UserError("concept, compose: expected a learned concept, training concepts or both, found neither")
        return _sum(parts)

    def _part(self, part: Part) -> Composition:
        found = part.weight * (self.load(part.concept) if part.concept.endswith(".safetensors") else self[part.concept])
        return found.on(self.domain.plans.grouped(part.groups), self.model.config.state_dim) if part.groups else found

    def _learned(self, concept: Concept) -> LearnedConcept:
        device = self.model.device
        own = concept.composition.to(device)
        parts = {field.name: getattr(own, field.name) for field in fields(Composition)}
        return LearnedConcept(**parts, concept=concept, model=self.model)

    def demonstrations(
        self,
        states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
        observed: Mapping[str, ArrayLike] | ArrayLike | None = None,
        name: str = "new concept",
    ) -> Demonstrations:
        """Demonstrations of one concept from arrays.

        Args:
            states: ``(demo, time, state)``, or one ``(time, state)`` for each demonstration, of any lengths.
            observed: features by name, or the only one, observed at every time ``(demo, time, *shape)`` or at the first time alone
                ``(demo, *shape)``; for demonstrations of different lengths, a list like the states'.
            name: of the concept.

        Raises:
            UserError: where they do not fit the model.
        """
        if isinstance(states, Demonstrations):
            return states.fitted(self.domain.observed).named(name)
        padded, lengths = _padded(states)
        if padded.dim() != 3 or padded.shape[2] != len(self.domain.plans.columns):
            expected = f"(demo, time, {len(self.domain.plans.columns)})"
            raise UserError(f"states: expected shape {expected}, found {tuple(padded.shape)}")
        features, per_step = {}, []
        for key, values in _by_name(observed, self.domain.observed).items():
            feature = self.domain.observed[key]
            found = _padded(values)[0]
            if found.dim() == len(feature.shape) + 2:
                per_step.append(key)
            features[key] = found.float() if feature.kind == "vector" else found
        return Demonstrations(
            states=padded,
            lengths=lengths,
            domain=self.domain.name,
            state_names=self.domain.plans.columns,
            state_units=self.domain.plans.units,
            concepts=(name,) * len(padded),
            observed=features,
            per_step=tuple(per_step),
        ).fitted(self.domain.observed)

    def learn(
        self,
        states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
        observed: Mapping[str, ArrayLike] | ArrayLike | None = None,
        name: str = "new concept",
        *,
        steps: int | None = None,
        seed: int = 0,
        progress: bool = False,
        **changes: Any,
    ) -> LearnedConcept:
        """Learn a concept from a few demonstrations, three to five or more: the same numbers as ``invert`` gives.

        Args:
            states, observed, name: see :meth:`demonstrations`.
            steps: of gradient descent; ``None`` for the tuned number.
            seed: decides starts, noise and timesteps.
            progress: show a bar.
            changes: of :class:`~ftl_lightning.learning.inversion_settings.InversionSettings`, such as ``components=1``.

        Raises:
            UserError: where demonstrations or settings do not fit the model.
        """
        own = self.demonstrations(states, observed, name)
        if len(found := set(own.concepts)) > 1:
            raise UserError(f"states: expected demonstrations of one concept, found those of {', '.join(sorted(found))}")
        try:
            settings = replace(self.tuned.inversion, **changes, seed=seed)
        except TypeError as error:
            raise UserError(f"learn: expected settings of an inversion, found others ({error})") from None
        total = steps or self.tuned.learning_steps
        with bar(f"learning {own.concepts[0]!r}", total) if progress else nullcontext(lambda *_: None) as advance:
            learned = invert(self.model, own, settings, total, lambda loss: advance(1, f"loss {loss:.3g}"))
        self._examples.append(own)
        return self._learned(learned[own.concepts[0]])

    def starts(self, goal: str, count: int = 10, seed: int = 0) -> InitialStates:
        """New initial states of a task, with scenes where there is an environment.

        Raises:
            UserError: in domains without initial states.
        """
        found = self.domain.source(None).starts(goal, count, EVALUATION_SEED + seed)
        if found is None:
            raise UserError(f"starts: expected a domain with initial states, found {self.domain.name}")
        return found

    def sample(
        self, concept: Composition, count: int = 10, observed: Start | None = None, *, seed: int = 0, **changes: Any
    ) -> Demonstrations:
        """Generate behaviour.

        Args:
            concept: a learned or training concept, or a sum of such with weights.
            count: of plans; where they start from initial states, one for each.
            observed: where they start, in domains with observed features.
            seed: of the noise.
            changes: of :class:`~ftl_lightning.diffusion.samplers.Sampling`: ``sampler``, ``steps``, ``temperature``.

        Returns:
            Plans ``(sample, horizon, state)`` as demonstrations, with where they start.

        Raises:
            UserError: for a start that does not fit the model.
        """
        sampling, starts = self._sampling(changes), self._starts(observed)
        if starts is None and self.domain.observed:
            told = ", ".join(f"{name} {feature.shape}" for name, feature in self.domain.observed.items())
            raise UserError(f"observed: expected where plans start ({told}), found nothing; model.starts(goal) draws some")
        if starts is not None:
            count = len(starts)
        expect_count("count", count, 1)
        seen = {} if starts is None else {key: values.to(self.model.device) for key, values in starts.observed.items()}
        states = self.model.sample([concept], count, sampling, [generator("cpu", seed)], seen)[0].cpu()
        return Demonstrations(
            states=states,
            lengths=torch.full((count,), states.shape[1]),
            domain=self.domain.name,
            state_names=self.domain.plans.columns,
            state_units=self.domain.plans.units,
            concepts=("",) * count,
            observed={} if starts is None else starts.observed,
            scenes=None if starts is None else starts.scenes,
            provenance={"pretrained": self.model.hash, "seed": seed, "temperature": sampling.temperature},
        )

    def _sampling(self, changes: Mapping[str, Any]) -> Sampling:
        try:
            found = replace(self.tuned.sampling, **changes)
        except TypeError as error:
            raise UserError(f"sample: expected sampler, steps or temperature, found others ({error})") from None
        if self.model.max_steps is not None and found.steps > self.model.max_steps:
            raise UserError(f"steps: expected 1 to {self.model.max_steps} (the model's T), found {found.steps}")
        return found

    def _starts(self, given: Start | None) -> InitialStates | None:
        if given is None or isinstance(given, InitialStates):
            return given
        features = self.domain.observed
        found = {name: _tensor(values) for name, values in _by_name(given, features).items()}
        return InitialStates({name: own.float() if features[name].kind == "vector" else own for name, own in found.items()})

    def evaluate(self, plans: Demonstrations, goal: str) -> dict[str, float]:
        """What the domain's metrics say of plans: shares of right ones, or means, by name.

        Raises:
            UserError: for a goal that the domain cannot judge by, or a domain that judges no plans.
        """
        if not self._judging.metrics:
            raise UserError(f"evaluate: expected a domain that judges plans, found {self.domain.name}; execute them")
        self._judging.expect_goal(goal)
        found = self._judging.measure(goal, plans.states, plans.initial_states)
        return {name: float(values.float().mean()) for name, values in found.items()}

    @property
    def _judging(self) -> Domain:
        """The domain; of a user's own data, with the demonstrations that concepts were learned from."""
        if self.model.examples is None:
            return self.domain
        from ftl_lightning.demonstrations.container import concatenate
        from ftl_lightning.domains.from_file import own_domain

        config = self.model.config
        return own_domain(concatenate(self._examples), config.training_concepts, config.horizon, config.metrics)

    def render(self, plans: Demonstrations, goal: str = "") -> "Figure":
        """A picture of plans; with a goal, right ones are framed green and wrong ones red."""
        starts, right = plans.initial_states, None
        if goal:
            self._judging.expect_goal(goal)
            judged = self._judging.measure(goal, plans.states, starts).values()
            right = next((one.tolist() for one in judged if one.dtype == torch.bool and one.dim()), None)
        return self.domain.show.picture(plans.states, right, goal or "samples", starts if self.domain.observed else None)

    def execute(
        self,
        concept: Composition,
        scenes: InitialStates | ArrayLike,
        goal: str = "",
        *,
        replan: int | None = None,
        environment: str = "",
        seed: int = 0,
        **changes: Any,
    ) -> Execution:
        """Execute a concept in closed loop in the domain's environment.

        Args:
            concept: as in :meth:`sample`.
            scenes: that episodes start from ``(episode, scene)``, or initial states with scenes, such as :meth:`starts` draws.
            goal: what episodes are judged by; empty for nothing.
            replan: steps that a plan is followed before a new one is made; ``None`` for the tuned number.
            environment: another of the domain's, such as driving's ``'step veto'``; empty for its own.
            seed: of the noise.
            changes: as in :meth:`sample`.

        Raises:
            UserError: in a domain without an environment, or without one of this name.
        """
        from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, reset, roll_out, sampled_plans

        loop = closed_loop_of(self.domain)
        if environment and environment not in loop.others:
            raise UserError(f"environment: expected {' or '.join(loop.others) or 'none'}, found {environment!r}")
        loop = loop.inside(environment)
        if goal:
            self._judging.expect_goal(goal)
        if replan is not None and replan < 1:
            raise UserError(f"replan: expected 1 or more, found {replan}")
        starts = scenes if isinstance(scenes, InitialStates) else reset(loop, _tensor(scenes))
        draws = [generator("cpu", seed, 1, episode) for episode in range(len(starts))]
        make = sampled_plans(self.model, [concept] * len(starts), self._sampling(changes), draws)
        policy = PlanFollower(make, planner(self.model, loop), replan or self.tuned.replan)
        rollout = roll_out(loop, starts, policy)
        return Execution(self.domain, goal, rollout, policy.followed)

    def save_pretrained(self, folder: str | Path) -> None:
        """Write ``config.json``, ``model.safetensors`` and, if there is none yet, a ``README.md`` to a folder."""
        folder = Path(folder)
        self.model.save(folder)
        if not (card := folder / "README.md").is_file():
            with atomic(card) as temporary:
                temporary.write_text(model_card(self.model), encoding="utf-8")

    def push_to_hub(self, repository: str, private: bool = False) -> str:
        """Upload the model to the Hugging Face Hub as ``owner/name``; needs a network and a login.

        Returns:
            Where it is.
        """
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder)
            return upload(folder, repository, private)


def _sum(parts: Iterable[Composition]) -> Composition:
    first, *rest = parts
    for part in rest:
        first = first + part
    return first


def _tensor(values: ArrayLike) -> Tensor:
    found = values if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values))
    return found if found.dtype == torch.uint8 else found.float()


def _padded(values: Any) -> tuple[Tensor, Tensor]:
    """Arrays of maybe different lengths as one, each padded with its last time, and the lengths."""
    if not isinstance(values, Tensor | np.ndarray):
        each = [_tensor(one) for one in values]
        if each and each[0].dim() and len({len(one) for one in each}) > 1:
            return padded(each)
        values = torch.stack(each)
    found = _tensor(values)
    return found, torch.full((len(found),), found.shape[1] if found.dim() > 1 else 1)


def _by_name(observed: Any, features: Mapping[str, Feature]) -> dict[str, Any]:
    """Observed features by name; a single value is the only one's.

    Raises:
        UserError: for a name that is none, or a value without one where there are several.
    """
    if observed is None:
        return {}
    if isinstance(observed, Mapping):
        if unknown := set(observed) - set(features):
            raise UserError(f"observed: expected {', '.join(features) or 'nothing'}, found {', '.join(sorted(unknown))}")
        return dict(observed)
    if len(features) != 1:
        raise UserError(f"observed: expected features by name ({', '.join(features) or 'none'}), found values without one")
    return {next(iter(features)): observed}
