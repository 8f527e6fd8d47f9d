"""What a domain is: one object with a handful of members. Adding a domain adds a folder with such an object."""

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError


@dataclass(frozen=True)
class EvaluationTask:
    """One bar of a chart: behaviour to generate and the goal it is judged by.

    Attributes:
        setting: the paper's name of the group it is averaged in, e.g. ``'training composition'``.
        goal: the task in words, as :attr:`Domain.succeeded` reads it.
        learned: name of the learned concept that is used, or ``None``.
        texts: training concepts that are composed in.
        component: number (from 1) of the only component of the learned concept that is used, or ``None`` for all.
        initial: where behaviour starts, in domains with initial states: in new ones, or in those of the demonstrations that the
            concept was learned from.
    """

    setting: str
    goal: str
    learned: str | None = None
    texts: tuple[str, ...] = ()
    component: int | None = None
    initial: Literal["new", "demonstrated"] = "new"

    @property
    def name(self) -> str:
        """Its name within its setting."""
        return self.goal if self.component is None else f"{self.goal} (learned from: {self.learned})"


@dataclass(frozen=True)
class Suite:
    """Evaluation tasks that are reported together."""

    tasks: tuple[EvaluationTask, ...]

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the concepts to learn, each once, in order."""
        return tuple(dict.fromkeys(task.learned for task in self.tasks if task.learned))

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings, each once, in order."""
        return tuple(dict.fromkeys(task.setting for task in self.tasks))


OURS = "FTL-IGM"
"""The name of the paper's method; what a method's tables tell of it in brackets is not part of its name."""


@dataclass(frozen=True)
class Published:
    """A number of the paper, to be shown beside ours.

    Attributes:
        setting: as in :class:`EvaluationTask`.
        value: accuracy in [0, 1].
        error: standard error over tasks; ``None`` for a single task or where it is not reported.
        components: K.
        omega: the fixed weight as text, or ``'learned'``.
        task: name of the evaluation task; ``''`` for the mean of the setting.
        metric: as in a row of the results.
        method: ours, or a baseline's name.
    """

    setting: str
    value: float
    error: float | None = None
    components: int = 2
    omega: str = "learned"
    task: str = ""
    metric: str = "accuracy"
    method: str = OURS


Policy = Callable[[Tensor, list[int], int], Tensor]
"""``(observations (episode, m), which episodes, step) -> actions (episode, action)``; not finite where there is none."""


@dataclass(frozen=True)
class ClosedLoop:
    """How a domain executes plans.

    Attributes:
        environment: makes an environment whose observation is an initial state ``(m,)`` and whose ``reset`` takes one as
            ``options={'initial_state': ...}``. What its last step tells (``info``) is what ``judge`` knows besides observations.
        act: the planner, ``(plans (episode, horizon, state), steps since they were made, observations (episode, m)) ->
            actions (episode, action)``.
        steps: at most, of an episode.
        judge: ``(goal, observations (episode, time, m), what the environment told at the end of each) -> what happened``, by name
            ``(episode,)``; ``'success'``, of bool, is the paper's metric. Observations are padded with the last one.
        frames: ``(observations (time, m), plans (step, horizon, state) that were followed) -> pictures (height, width, 3)`` of an
            episode.
        headline: what of that the method and others are compared by, episode for episode.
        costs: of what of that less is better.
        policies: policies to print beside every rate: name to ``(goal, initial states (episode, m), demonstrations that the
            behaviour was learned from or None, seed) -> policy``, or ``None`` where it would take too long.
    """

    environment: Callable[[], gymnasium.Env[Any, Any]]
    act: Callable[[Tensor, int, Tensor], Tensor]
    steps: int
    judge: Callable[[str, Tensor, Sequence[Mapping[str, Any]]], dict[str, Tensor]]
    frames: Callable[[Tensor, Tensor], list[NDArray[np.uint8]]]
    headline: str = "success"
    costs: tuple[str, ...] = ()
    policies: Mapping[str, Callable[[str, Tensor, Demonstrations | None, int], Policy | None]] = field(default_factory=dict)


class Generate(Protocol):
    """Draws demonstrations; the same task, count and seed give the same bytes, whatever the number of processes."""

    def __call__(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations: ...


@dataclass(frozen=True)
class View:
    """How a model sees behaviour, where it is not as it stands in files.

    Attributes:
        encode: ``(states (sample, horizon, state), initial states (sample, m)) -> (sample, horizon, state)``.
        decode: its inverse.
        observe: ``initial states (sample, m) -> (sample, what the model is conditioned on)``.
        perturb: ``(states (sample, horizon, state), initial states (sample, m), normal noise (sample, 2)) -> both``, as if the
            present had been a little different; ``None`` where that is not known. A model that has learned the ways back from
            there does not get lost where its demonstrations never were.
        act: as of :class:`ClosedLoop`, for a planner that looks at behaviour likewise; ``None`` for the domain's.
        alike: groups of columns of a state, in the same order: those in the same place of each share a scale.
    """

    encode: Callable[[Tensor, Tensor], Tensor]
    decode: Callable[[Tensor, Tensor], Tensor]
    observe: Callable[[Tensor], Tensor]
    perturb: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] | None = None
    act: Callable[[Tensor, int, Tensor], Tensor] | None = None
    alike: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class Domain:
    """A domain.

    Attributes:
        name: folder name under ``ftl_lightning/domains``.
        horizon: number of states in a generated plan.
        state_names, state_units: one entry a column of a state.
        training_concepts: descriptions of the behaviours of pretraining.
        suites: by name: ``'training'`` (training concepts), ``'paper'`` (final evaluation only), ``'validation'`` (for tuning)
            and any other, such as ``'components'`` (what each learned component generates alone).
        descriptions: every text that the shipped table of embeddings holds besides the empty one.
        training_set: ``(samples per concept, seed) -> demonstrations`` of every training concept.
        generate: demonstrations of any task of the domain's grammar.
        reads: whether a text is a goal that behaviour can be judged by.
        succeeded: ``(goal, states (sample, horizon, state), initial states (sample, m) or None) -> (sample,)`` of bool, the paper's
            metric of plans; ``None`` where only what comes of them is judged.
        render: ``(states (sample, horizon, state), right (sample,) of bool or None if nobody judged, title, initial states
            (sample, m) or None) -> figure``.
        references: trivial policies to print beside every rate: name to ``(goal, samples, initial states (sample, m) or None, seed)
            -> states (sample, horizon, state)``.
        initial_states: ``(task, count, seed) -> (count, m)``, new initial states of a task; ``None`` where behaviour has none.
        views: by name, how a model may see behaviour; without any, as it is. The columns below are of what it sees.
        entities: columns of an initial state for each of its exchangeable entities, in the same order for each; the other columns
            say nothing about a single entity.
        looks: which of an entity's columns, counted from its first, a concept asks for when it names an entity; all where empty.
        state_columns: columns of an initial state that hold the state a plan starts from, in a state's order; none where it
            holds no such state.
        early: how much more often windows start early in a demonstration, see
            :meth:`~ftl_lightning.demonstrations.container.Demonstrations.starts`; 3 where a plan reaches over the whole
            behaviour, so that the first one matters most, 1 where it is short.
        closed_loop: how plans are executed; ``None`` where they cannot be.
        sentence: how a task is told to a language model, in the paper's words.
        published: the paper's numbers for this domain.
        omega: the fixed guidance weight of two learned components in our main tables, as text.
        published_omega: that of the paper's main figures.
    """

    name: str
    horizon: int
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    training_concepts: tuple[str, ...]
    suites: Mapping[str, Suite]
    descriptions: tuple[str, ...]
    training_set: Callable[[int, int], Demonstrations]
    generate: Generate
    reads: Callable[[str], bool]
    succeeded: Callable[[str, Tensor, Tensor | None], Tensor] | None
    render: Callable[[Tensor, Sequence[bool] | None, str, Tensor | None], Figure]
    references: Mapping[str, Callable[[str, int, Tensor | None, int], Tensor]] = field(default_factory=dict)
    initial_states: Callable[[str, int, int], Tensor] | None = None
    views: Mapping[str, View] = field(default_factory=dict)
    entities: tuple[tuple[int, ...], ...] = ()
    looks: tuple[int, ...] = ()
    state_columns: tuple[int, ...] = ()
    early: float = 1.0
    closed_loop: ClosedLoop | None = None
    sentence: Callable[[str], str] = lambda goal: goal
    published: tuple[Published, ...] = ()
    omega: str = "1.2"
    published_omega: str = "1.2"

    def start_power(self, window: int) -> float:
        """:attr:`early` for windows that reach over the whole behaviour, 1 for shorter ones: all times of it are alike to them."""
        return self.early if window >= self.horizon else 1.0

    @property
    def table(self) -> Path:
        """The shipped table of concept embeddings, in the domain's folder."""
        return Path(__file__).parent / self.name / "embeddings.safetensors"


def domain_names() -> tuple[str, ...]:
    """The domains that are installed: the folders beside this file."""
    return tuple(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.ispkg)


def load_domain(name: str) -> Domain:
    """Import a domain by the name of its folder.

    Raises:
        UserError: if there is none of that name.
    """
    if name not in domain_names():
        raise UserError(f"domain: expected one of {', '.join(domain_names())}, found {name!r}")
    domain: Domain = importlib.import_module(f"ftl_lightning.domains.{name}").DOMAIN
    return domain
