"""The few-shot learner in Python: load a pretrained model, learn a concept, sample, compose, judge, draw, execute."""

import functools
import operator
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from numpy.typing import ArrayLike

from ftl_lightning.data.check import axes
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import PINNED, InitialStates, moved
from ftl_lightning.domains.domain import Domain, closed_loop_of
from ftl_lightning.evaluation.closed_loop import reset
from ftl_lightning.evaluation.policy import POLICY_STEPS, Control, Policy
from ftl_lightning.evaluation.rollout import Episodes, rollout
from ftl_lightning.few_shot.arrays import (
    Start,
    check_of_domain,
    demonstrations_of,
    mended_states,
    of_one_concept,
    pinned_states,
    scenes_of,
    starts_of,
)
from ftl_lightning.few_shot.learned_concept import LearnedConcept, Learning
from ftl_lightning.few_shot.plans import Execution, episodes, plans_of, sampled
from ftl_lightning.few_shot.shared_concept import CONCEPT_FILES, download, is_repository, read_folder, save_with_card, upload
from ftl_lightning.few_shot.tuned import ModelSettings, settings_of
from ftl_lightning.igm.composition import Composition, Part, parse_composition, space_of
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.inversion import Watch
from ftl_lightning.igm.library import Library, library
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import INVERSION
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.progress import Advance, bar
from ftl_lightning.services.randomness import EVALUATION_SEED
from ftl_lightning.services.shipped import pretrained_folder, shipped_models, shipped_name
from ftl_lightning.services.text import Shown
from ftl_lightning.services.trust import vouching
from ftl_lightning.services.validation import LARGEST_STEP, changed, check_path, check_text, check_whole, device_named
from ftl_lightning.training.checks import Check, check_concept, check_with, notes_of
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.training.quality import judged, judging_domain, picture

if TYPE_CHECKING:
    import gymnasium
    from matplotlib.figure import Figure


PLANS = 10
"""Default number of sampled plans."""
GIVEN = {
    "sample": ("count", "observed", "seed", "pin", "batch_size", "progress"),
    "execute": ("scenes", "goal", "replan", "environment", "seed"),
    "policy": ("execute", "replan", "act", "observe", "seed"),
}
"""Arguments besides the sampler's settings."""


class FewShot(Shown):
    """Few-shot learner: a pretrained model that learns concepts from a few demonstrations and generates behaviour.

    Args:
        model: the frozen model.
        tuned: default settings of every method.

    Attributes:
        settings: configuration file of the settings; empty without one.
        folder: folder of the model; ``None`` if it was not read from one.
        known_as: public name of the model: a shipped model or ``'owner/name'`` on the Hub; empty without one.
    """

    def __init__(self, model: ConceptModel, tuned: ModelSettings) -> None:
        self.model, self.tuned = model, tuned
        self.settings = ""
        self.folder: Path | None = None
        self.known_as = ""
        self._examples: list[Demonstrations] = [] if model.examples is None else [model.examples]

    @classmethod
    @usual_modes()
    def from_pretrained(
        cls, name: str | Path, settings: str | Path | None = None, device: str = "cpu", domain: Domain | str | None = None
    ) -> Self:
        """Load a model.

        Args:
            name: a shipped model (``'navigation'``, ``'driving'``, ``'rearrangement'``), a folder, or ``'owner/name'`` on the
                Hugging Face Hub, which needs a network.
            settings: configuration file of ``invert`` with the settings; ``None`` for that of the model's domain.
            device: device to compute on.
            domain: domain of your model, or its name ``'package.module:DOMAIN'``, which is imported. A folder alone never imports
                code: without ``domain``, or ``settings`` that name it, the domain must be from an installed package.

        Raises:
            UserError: with the place, if there is no model, or it requires untrusted code.
        """
        check_path("name", name, f"the name of a model, such as {', '.join(shipped_models())}, or its folder")
        if settings is not None:
            check_path("settings", settings, "a configuration file of invert")
        folder, place = pretrained_folder(name), device_named(device)
        known_as = ""
        if not folder.is_dir() and is_repository(str(name)):
            folder, known_as = download(str(name)), str(name)
        with vouching([] if settings is None else ModelSettings.domains(settings)):
            model = load_model(folder, domain).to(place)
        if settings is None:
            settings = settings_of(model.config.domain, model.method.configurations)
        loaded = cls(model, ModelSettings.read(settings))
        loaded.settings, loaded.folder, loaded.known_as = str(settings), folder, known_as or shipped_name(folder)
        return loaded

    def _words(self) -> Iterator[str]:
        return self.model._words()

    @property
    def device(self) -> torch.device:
        """The model's device."""
        return self.model.device

    @usual_modes()
    def to(self, device: str | torch.device) -> Self:
        """Move the model to another device; existing concepts follow when they are used.

        Returns:
            The object itself.

        Raises:
            UserError: for an unavailable device.
        """
        self.model.to(device_named(device))
        return self

    @functools.cached_property
    def _space(self) -> str:
        """Identity of the model's concept space; cached, as hashing is slow."""
        return space_of(self.model.config.domain, self.model.hash)

    @property
    def domain(self) -> Domain:
        """The model's domain."""
        return self.model.domain

    @property
    def training_concepts(self) -> tuple[str, ...]:
        """Texts that ``model[text]`` accepts."""
        return self.model.config.training_concepts

    @usual_modes()
    def __getitem__(self, text: str) -> Composition:
        """A training concept, with weight 1.

        Raises:
            UserError: for an unknown text.
        """
        return replace(self.model[text], space=self._space)

    def library(self, *folders: str | Path) -> Library:
        """Library of the model's concepts: training concepts, learned concepts in its folder, and saved concepts.

        Args:
            folders: folders of saved concepts, besides your library (:func:`~ftl_lightning.igm.library.concepts_folder`).

        Raises:
            UserError: for a path that is not a folder.
        """
        for folder in folders:
            check_path("folder", folder, "a folder of learned concepts")
        return library(self.model.hash, self.training_concepts, self.folder, folders)

    @usual_modes()
    def load(self, path: str | Path) -> LearnedConcept:
        """Load a learned concept from its file, a folder of ``save_pretrained``, or ``'owner/name'`` on the Hugging Face Hub.

        Only ``concept.safetensors`` of a folder is read, as numbers and texts. The Hub, which needs a network, is used if no local
        path has this name.

        Args:
            path: file, folder, or name on the Hub.

        Raises:
            UserError: with the file, if it is not a concept or belongs to another model.
        """
        check_path("path", path, "the file of a learned concept, its folder or 'owner/name' on the Hub")
        name, file = str(path), Path(path)
        if not os.path.lexists(file) and is_repository(name) and not name.endswith(".safetensors"):
            file = download(name, CONCEPT_FILES, "a concept's file, its folder or one on the Hub")
        whole = os.path.isdir(file)  # noqa: PTH112 (False for a name that is too long)
        concept = read_folder(file, name, self._space) if whole else Concept.load(file)
        check_concept(self.model, concept, path)
        return self._learned(concept)

    @usual_modes()
    def compose(self, text: str) -> Composition:
        """Compose training and learned concepts with weights: ``'go to red object:1.2 + other.safetensors:0.9'``.

        A learned concept is named by its file or its name in the :meth:`library`; training concepts take precedence. An ``@``
        restricts a concept to groups of columns: ``'walk@legs + jumping_jacks.safetensors@arms,trunk'``.

        Args:
            text: text of the composition.

        Raises:
            UserError: for an unknown or ambiguous concept, or an empty text.
        """
        check_text("compose", text, f"{self.training_concepts[0]}:1.2 + learned.safetensors")
        parts = [self._part(part) for part in parse_composition(text)]
        if not parts:
            raise UserError("concept, compose: expected a learned concept, training concepts or both, found neither")
        return functools.reduce(operator.add, parts)

    def _part(self, part: Part) -> Composition:
        composition = part.weight * self._named(part.concept)
        return composition.on(self.domain.plans.grouped(part.groups), self.model.config.state_dim) if part.groups else composition

    def _named(self, name: str) -> Composition:
        """A training concept by text, or a learned concept by file or name in the library."""
        if name in self.training_concepts:
            return self[name]
        if name.endswith(".safetensors"):
            return self.load(name)
        known = self.library()
        if (entry := known.learned_as(name)) is not None and entry.path is not None:
            return self.load(entry.path)
        if not known.learned:
            return self[name]  # raises an error with the nearest
        near = "; ".join(short(text, 40) for text in known.nearest(name))
        raise UserError(
            f"concept {shown(name)}: expected a training concept or one of the model's library: {near} are the nearest of "
            f"{len(known)}; list all: python -m ftl_lightning concepts MODEL"
        )

    def _learned(self, concept: Concept) -> LearnedConcept:
        composition = concept.composition.to(self.device)
        parts = {field.name: getattr(composition, field.name) for field in fields(Composition)}
        return LearnedConcept(
            **parts | {"space": self._space}, concept=concept, model=self.model, tuned=self.tuned, known_as=self.known_as
        )

    def _own(self, call: str, concept: object) -> Composition:
        """Check the argument of a method and move it to the model's device; ``UserError`` unless it is a concept of the model."""
        if not isinstance(concept, Composition):
            text = short(self.model.config.training_concepts[0], 40)
            raise UserError(
                f"{call}: expected a concept, such as model[{text!r}], model.compose(text), model.load(path) or what model.learn "
                f"returns, found {shown(concept)}"
            )
        if concept.space not in ("", self._space):
            raise UserError(
                f"{call}: expected a concept of this model, {self._space}, found one of {concept.space}; learn it with this model"
            )
        n = self.model.config.concept_dim
        if concept.embeddings.dim() != 3 or concept.embeddings.shape[2] != n:
            raise UserError(
                f"{call}: expected a concept of this model, {self._space}, with embeddings (K, knots, {n}), "
                f"found {tuple(concept.embeddings.shape)}"
            )
        return concept if concept.weights.device == self.device else concept.to(self.device)

    @usual_modes()
    def demonstrations(
        self,
        states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
        observed: Mapping[str, ArrayLike] | ArrayLike | None = None,
        name: str = "new concept",
    ) -> Demonstrations:
        """Make demonstrations of one concept from arrays.

        Args:
            states: ``(demo, time, state)``, or a list of ``(time, state)`` of any lengths.
            observed: features by name, or a single feature, at every time ``(demo, time, *shape)`` or at the first time
                ``(demo, *shape)``; for different lengths, a list as for ``states``.
            name: name of the concept.

        Raises:
            UserError: if the arrays do not fit the model.
        """
        check_text("name", name, "go to red bowl")
        return demonstrations_of(self.domain, states, observed, name)

    @usual_modes()
    def learn(
        self,
        states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
        observed: Mapping[str, ArrayLike] | ArrayLike | None = None,
        name: str = "new concept",
        *,
        steps: int | None = None,
        seed: int = 0,
        progress: bool | Advance = False,
        watch: Callable[[Learning], None] | None = None,
        **changes: Any,
    ) -> LearnedConcept:
        """Learn a concept from a few demonstrations, three to five or more; same numbers as ``invert``.

        Args:
            states, observed, name: see :meth:`demonstrations`.
            steps: gradient steps; ``None`` for the tuned number.
            seed: seed of starts, noise and timesteps.
            progress: show a bar, or call a function after each step of all inversions.
            watch: called after each step of the first inversion, for methods with gradient descent; it may sample the concept so
                far without side effects, or stop by raising an exception.
            changes: options of :class:`~ftl_lightning.igm.settings.InversionSettings`, such as ``form="paper"``.

        Warns:
            UserWarning: if demonstrations are longer than the model's plans, or likely have a fault (see :meth:`check`).

        Raises:
            UserError: if demonstrations or settings do not fit the model.
        """
        check_text("name", name, "go to red bowl")
        fitted = of_one_concept(demonstrations_of(self.domain, states, observed, name))
        (learned,) = self._learn(fitted, "learn", steps, seed, progress, watch, changes)
        return learned

    @usual_modes()
    def learn_all(
        self, demonstrations: Demonstrations, *, steps: int | None = None, seed: int = 0, progress: bool = False, **changes: Any
    ) -> dict[str, LearnedConcept]:
        """Learn every concept of the demonstrations in one batch: same numbers as ``invert``, and up to rounding as :meth:`learn`
        for each concept, in much less time.

        Args:
            demonstrations: demonstrations ``(demo, time, state)`` whose texts name the concepts.
            steps, seed, progress: see :meth:`learn`.
            changes: options of :class:`~ftl_lightning.igm.settings.InversionSettings`, such as ``form="paper"``.

        Returns:
            Concepts by name, in the order of the demonstrations.

        Warns:
            UserWarning: as :meth:`learn`, with the concept's name.

        Raises:
            UserError: if demonstrations or settings do not fit the model, or a demonstration has no text.
        """
        if not isinstance(demonstrations, Demonstrations):
            raise UserError(f"learn_all: expected Demonstrations, such as of Demonstrations.load, found {shown(demonstrations)}")
        if not demonstrations.concepts or not all(demonstrations.concepts):
            raise UserError("demonstrations: expected a text for each, which names its concept, found none; use learn, with name")
        fitted = self.domain.fitted(demonstrations, "demonstrations")
        learned = self._learn(fitted, "learn_all", steps, seed, progress, None, changes)
        return {concept.concept.origin.name: concept for concept in learned}

    def _learn(
        self,
        fitted: Demonstrations,
        call: str,
        steps: int | None,
        seed: int,
        progress: bool | Advance,
        watch: Callable[[Learning], None] | None,
        changes: Mapping[str, Any],
    ) -> list[LearnedConcept]:
        """Learn the concepts of fitted demonstrations, in order, for a public method called by the user.

        Its ``stacklevel`` is 4, with the decorator of the method.
        """
        names = tuple(dict.fromkeys(fitted.concepts))
        title = f"learning {names[0]!r}" if len(names) == 1 else f"learning {len(names)} concepts"
        check_whole("seed", seed, 0, None)
        chosen = changed(call, self.tuned.inversion, changes, ("steps", "seed", "progress", "watch"), INVERSION)
        settings = replace(chosen, seed=int(seed)).for_own(self.model.chooses_form and not {"modes", "adapter"} & {*changes})
        given = next(iter([*changes, *([] if watch is None else ["watch"])]), None)
        descends = self.model.invertible or given is None
        method = self.model.method.name
        require(descends, "learn", f"no settings of an inversion, as {method} learns without gradient descent", str(given))
        total = self.tuned.learning_steps if steps is None else check_whole("steps", steps, 1, LARGEST_STEP)
        for note in notes_of(self.model, fitted):
            warnings.warn(note, stacklevel=4)
        watched = None if watch is None else self._watched(names[0], watch)
        shown = bar(title, total) if progress is True else nullcontext(progress or (lambda *_: None))
        with shown as advance:
            learned = self.model.learn_concepts(fitted, settings, total, lambda loss: advance(1, f"loss {loss:.3g}"), watched)
        parts = {name: fitted.select(name) for name in names}
        self._examples += parts.values() if self.model.examples is not None else ()
        examples = tuple(self._examples)
        return [replace(self._learned(learned[name]), demonstrations=part, examples=examples) for name, part in parts.items()]

    def _watched(self, name: str, watch: Callable[[Learning], None]) -> Watch:
        return lambda step, loss, concepts: watch(Learning(step, loss, lambda: self._learned(concepts()[name])))

    @usual_modes()
    def check(
        self,
        states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
        observed: Mapping[str, ArrayLike] | ArrayLike | None = None,
        name: str = "new concept",
        *,
        learn: bool = False,
        progress: bool = False,
    ) -> Check:
        """Check whether demonstrations of a concept suffice, and find an outlier; ``print`` the result.

        Args:
            states, observed, name: see :meth:`demonstrations`; states may be missing (NaN).
            learn: also compute leave-one-out losses.
            progress: show a bar.

        Raises:
            UserError: if demonstrations do not fit the model, or the model has no inversion.
        """
        whole, findings = mended_states(states)
        fitted = of_one_concept(self.demonstrations(whole, observed, name))
        findings = (*findings, *axes(fitted))
        return check_with(self.model, fitted, self.tuned.inversion, self.tuned.learning_steps if learn else 0, findings, progress)

    @usual_modes()
    def starts(self, goal: str, count: int = 10, seed: int = 0) -> InitialStates:
        """Draw new initial states of a task, with scenes in domains with an environment.

        Args:
            goal: the task.
            count: number of initial states.
            seed: seed of the initial states.

        Raises:
            UserError: in domains without initial states, or for an unknown task.
        """
        check_text("goal", goal, self.training_concepts[0])
        count, seed = check_whole("count", count, 1), check_whole("seed", seed, 0, None)
        if self.domain.observed and goal not in self.training_concepts:
            self.judging.check_goal(goal)
        states = self.domain.source(None).starts(goal, count, EVALUATION_SEED + seed)
        if states is None:
            raise UserError(f"starts: expected a domain with initial states, found {self.domain.name}")
        return states

    @usual_modes()
    def sample(
        self,
        concept: Composition,
        count: int | None = None,
        observed: Start | None = None,
        *,
        seed: int = 0,
        pin: Mapping[int, ArrayLike] | None = None,
        batch_size: int | None = None,
        progress: bool = False,
        **changes: Any,
    ) -> Demonstrations:
        """Sample behaviour.

        Args:
            concept: a learned or training concept, or a weighted sum of concepts.
            count: number of plans; ``None`` for a plan for each initial state, or 10 plans without initial states.
            observed: initial states, in domains with observed features.
            seed: seed of the noise.
            pin: states that plans have to pass, by time, negative from the end: ``{0: start, -1: end}``; each ``(state,)`` or
                ``(count, state)`` in the domain's units, NaN for a free column. In a user's data, observed features that equal the
                initial state are pinned without it.
            batch_size: maximum number of plans in a batch, to save memory; ``None`` for all. Plans are equal up to rounding.
            progress: show a bar.
            changes: options of :class:`~ftl_lightning.igm.samplers.Sampling`: ``sampler``, ``steps``, ``temperature``.

        Returns:
            Plans ``(sample, horizon, state)`` as demonstrations, with their initial states.

        Raises:
            UserError: for a concept of another model, a start that does not fit, or another ``count`` than that of starts.
        """
        concept, sampling = self._own("sample", concept), self._sampling("sample", changes)
        starts = starts_of(self.domain, observed)
        wanted = PLANS if starts is None else len(starts)
        count, seed = wanted if count is None else check_whole("count", count, 1), check_whole("seed", seed, 0, None)
        require(starts is None or count == wanted, "count", f"{wanted} (a plan for each of the starts), or none", count)
        size = None if batch_size is None else check_whole("batch_size", batch_size, 1)
        seen = {} if starts is None else moved(starts.observed, self.device)
        if pin:
            require(self.model.invertible and self.model.max_steps is not None, "pin", "a diffusion model", self.model.method.name)
            seen = {**seen, PINNED: pinned_states(pin, count, self.model.horizon, self.domain.plans.columns).to(self.device)}
        states = sampled(self.model, concept, count, sampling, seed, seen, size, progress).cpu()
        provenance = {"pretrained": self.model.hash, "seed": seed, "temperature": sampling.temperature}
        return plans_of(self.domain, states, starts, provenance)

    def _sampling(self, call: str, changes: Mapping[str, Any]) -> Sampling:
        sampling = changed(call, self.tuned.sampling, changes, GIVEN[call])
        if self.model.max_steps is not None and sampling.steps > self.model.max_steps:
            raise UserError(f"steps: expected 1 to {self.model.max_steps} (the model's T), found {sampling.steps}")
        return sampling

    @usual_modes()
    def evaluate(self, plans: Demonstrations, goal: str) -> dict[str, float]:
        """Evaluate plans by the domain's metrics: success rates or means by name.

        Raises:
            UserError: for plans of another domain, a goal that the domain cannot judge, or a domain without metrics.
        """
        check_of_domain("evaluate", plans, self.domain)
        return judged(self.judging, plans, goal)

    @property
    def judging(self) -> Domain:
        """Domain that judges generated behaviour: the model's; for a user's data, including demonstrations of learned concepts."""
        return judging_domain(self.model, self._examples)

    @usual_modes()
    def render(self, plans: Demonstrations, goal: str = "", demonstrations: Demonstrations | None = None) -> "Figure":
        """Draw plans, below ``demonstrations`` if given; with a goal, right plans are framed green and wrong plans red.

        Raises:
            UserError: for plans of another domain, or a goal that the domain cannot judge.
        """
        check_of_domain("render", plans, self.domain)
        return picture(self.judging, plans, goal, demonstrations)

    @usual_modes()
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
            scenes: initial scenes ``(episode, scene)``, or initial states with scenes, such as from :meth:`starts`.
            goal: task that episodes are judged by; empty for none.
            replan: steps between plans; ``None`` for the tuned number.
            environment: another environment of the domain, such as driving's ``'step veto'``; empty for the default.
            seed: seed of the noise.
            changes: as in :meth:`sample`.

        Raises:
            UserError: for a concept of another model, or in a domain without this environment.
        """
        loop = closed_loop_of(self.domain)
        if environment and environment not in loop.others:
            raise UserError(f"environment: expected {' or '.join(loop.others) or 'none'}, found {shown(environment)}")
        loop = loop.inside(environment)
        if goal:
            self.judging.check_goal(goal)
        every = self.tuned.replan if replan is None else check_whole("replan", replan, 1)
        concept, sampling = self._own("execute", concept), self._sampling("execute", changes)
        seed = check_whole("seed", seed, 0, None)
        starts = scenes if isinstance(scenes, InitialStates) else reset(loop, scenes_of(scenes))
        rollout, followed = episodes(self.model, loop, concept, starts, sampling, every, seed)
        return Execution(self.domain, goal, rollout, followed)

    @usual_modes()
    def policy(
        self,
        concept: Composition,
        execute: int = 8,
        replan: int | None = None,
        *,
        act: Control | None = None,
        observe: Callable[[Any], Any] | None = None,
        seed: int = 0,
        **changes: Any,
    ) -> Policy:
        """Make a receding-horizon policy of a concept, for one environment or a batch of them.

        With a user's data, plans are whole behaviour through the present state, or windows that begin there.

        Args:
            concept: as in :meth:`sample`.
            execute: number of steps of a plan that are executed (an action chunk).
            replan: steps between plans; ``None`` for ``execute``.
            act: with a user's data, controller ``(present states (episode, state), next planned states) -> actions``, arrays;
                ``None`` for actions as planned or by an inverse model, whichever follows simulated plans best; the policy's text
                says which.
            observe: function of an observation that returns what :meth:`Policy.act
                <ftl_lightning.evaluation.policy.Policy.act>` accepts; ``None`` for the observation itself.
            seed: seed of the noise.
            changes: as in :meth:`sample`.

        Raises:
            UserError: for a concept of another model, or a domain with neither an environment nor a user's data.
        """
        if self.model.max_steps is not None and self.domain.closed_loop is None:
            changes = {"steps": min(POLICY_STEPS, self.model.max_steps), **changes}
        concept, sampling = self._own("policy", concept), self._sampling("policy", changes)
        every = check_whole("execute", execute, 1) if replan is None else check_whole("replan", replan, 1)
        return Policy(self.model, concept, sampling, every, act, observe, check_whole("seed", seed, 0, None))

    @usual_modes()
    def rollout(
        self,
        policy: Policy,
        environment: "str | Callable[[], gymnasium.Env[Any, Any]] | gymnasium.Env[Any, Any]",
        episodes: int = 50,
        success: str | Callable[[Mapping[str, Any]], bool] | None = None,
        *,
        steps: int | None = None,
        seed: int = 0,
    ) -> Episodes:
        """Evaluate a policy in a Gymnasium environment.

        Args:
            policy: such as :meth:`policy` returns.
            environment: name of a registered environment, a function that makes it, or an environment, in which episodes run one
                after another. Their seeds are far from small numbers, with which demonstrations are often recorded.
            episodes: number of episodes.
            success: ``'info.KEY'``, a key of the ``info`` of an episode's last step, or a function of this ``info``; ``None`` for
                ``is_success`` or ``success``, if there is such a key.
            steps: maximum number of steps of an episode; ``None`` for the environment's limit, or 1,000.
            seed: seed of the environment and of the noise.

        Returns:
            Success with its interval, returns, lengths, pictures of the first episode, and the time that an action chunk takes.

        Raises:
            UserError: for an environment that cannot be made, or observations or actions that do not fit.
        """
        if not isinstance(policy, Policy):
            raise UserError(f"policy: expected a policy, such as model.policy(concept), found {shown(policy)}")
        episodes, seed = check_whole("episodes", episodes, 1), check_whole("seed", seed, 0, None)
        return rollout(policy, environment, episodes, success, None if steps is None else check_whole("steps", steps, 1), seed)

    def save_pretrained(self, folder: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors`` to a folder, and a ``README.md`` unless it exists."""
        save_with_card(self.model, Path(folder))

    def push_to_hub(self, repository: str, private: bool = False) -> str:
        """Upload the model to the Hugging Face Hub as ``owner/name``; needs a network and a login.

        Args:
            repository: name of the repository.
            private: whether a new repository is private.

        Returns:
            The address.

        Raises:
            UserError: for an invalid name or a failed upload.
        """
        return upload(self.save_pretrained, repository, private)

    def publish(self, concept: LearnedConcept, repository: str, private: bool = False, demonstrations: bool = False) -> str:
        """Upload a learned concept of this model, see :meth:`LearnedConcept.push_to_hub`; :meth:`load` accepts its name.

        Args:
            concept: learned concept.
            repository, private, demonstrations: see :meth:`LearnedConcept.push_to_hub`.

        Returns:
            The address.

        Raises:
            UserError: for another object or model's concept, an invalid name, or a failed upload.
        """
        self._own("publish", concept)
        if not isinstance(concept, LearnedConcept):
            raise UserError(f"publish: expected a learned concept, such as what model.learn returns, found {shown(concept)}")
        return concept.push_to_hub(repository, private, demonstrations)
