"""Interface of domains: a :class:`Domain` is one object, made of a few groups of fields.

Name, plans, concepts and source are required; every other field has a default.
"""

import difflib
import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from ftl_lightning.data.columns import aligned
from ftl_lightning.data.demonstrations import Demonstrations, padded
from ftl_lightning.data.distances import Distance
from ftl_lightning.data.features import Feature, InitialStates, Observed
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.pictures import Show, line_drawings
from ftl_lightning.domains.recorder import Recorder
from ftl_lightning.domains.tasks import Suite, training_suite
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.randomness import VALIDATION_SEED
from ftl_lightning.services.text import Shown, counted

ACCURACY, SUCCESS, CLOSED = "accuracy", "success", "closed loop"
OWN = "own"
"""Name of the domain of user data."""
NOVELTY, COVERAGE = "novelty", "coverage"
"""Distances that are measured in every domain, unless it has a metric of this name, see
:mod:`ftl_lightning.evaluation.references`."""
EXECUTED = f"{CLOSED} {SUCCESS}"
Split = Literal["train", "validation"]
_DERIVED: Any = None  # default of a field that is derived from other fields


@dataclass(frozen=True)
class View:
    """Alternative representation of behaviour for a model; files and metrics keep the domain's representation.

    Attributes:
        features: features that the model observes, by name.
        observe: conversion of the domain's observed features to these features.
        encode: conversion of states to what the model generates: ``(states (sample, horizon, state), observed) -> (sample, horizon,
            state)``.
        decode: inverse of ``encode``; projects impossible generated states to the nearest possible ones.
        perturb: augmentation in training, ``(states, observed, generator) -> (states, observed)`` with a slightly different present
            state, from which a model learns to recover. Without a generator, it only hides what new tasks do not show. ``None`` for
            none.
        pretraining: another augmentation in pretraining; ``None`` for ``perturb`` there too.
        act: planner for plans in this view, as ``act`` of :class:`~ftl_lightning.domains.execution.ClosedLoop`; ``None`` for the
            domain's planner.
        scales: groups of columns of a state; columns at the same position in each group share a scale.
        same_columns: whether encoded states have the same columns as the domain's states.
        plane: columns of an encoded state that are x and y in the coordinates of observed points; a denoiser may rotate plans and
            points together.
        columns: names of the columns of an encoded state; empty if there are as many as of a state, without names.
    """

    features: Mapping[str, Feature]
    observe: Callable[[Observed], Observed]
    encode: Callable[[Tensor, Observed], Tensor]
    decode: Callable[[Tensor, Observed], Tensor]
    perturb: Callable[[Tensor, Observed, torch.Generator | None], tuple[Tensor, Observed]] | None = None
    pretraining: Callable[[Tensor, Observed, torch.Generator | None], tuple[Tensor, Observed]] | None = None
    act: Callable[[Tensor, int, Observed], Tensor] | None = None
    scales: tuple[tuple[int, ...], ...] = ()
    same_columns: bool = False
    plane: tuple[int, ...] = ()
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plans:
    """Behaviour to generate.

    Attributes:
        horizon: number of states in a plan.
        columns, units: name and unit of each column of a state.
        start_exponent: distribution of the start of training windows as long as a plan: ``start = length * share^start_exponent``
            with a uniform ``share``. 1 is uniform. With 3, half of the windows start in the first eighth of a demonstration, for
            plans that cover the whole behaviour. Shorter windows start anywhere.
        at_rest: whether behaviour rests at the end of a demonstration. If so, windows may reach past the end, where the last state
            is repeated. If not, windows stay within demonstrations; shorter demonstrations are refused.
        groups: groups of columns by name, such as the legs of a body. A composition may restrict a concept to some groups.
        resolution: smallest variation of a column of states or observed vectors, in its unit; columns that vary by less count as
            constant.
        views: alternative representations of behaviour for models, by name. A model without a view sees states as they are.
        kinds: resolved kind of each column of a user's data, see :mod:`ftl_lightning.data.kinds`; empty if all are linear.
    """

    horizon: int
    columns: tuple[str, ...]
    units: tuple[str, ...]
    start_exponent: float = 1.0
    resolution: float = 0.0
    at_rest: bool = True
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    views: Mapping[str, View] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()

    def grouped(self, names: Sequence[str]) -> tuple[int, ...]:
        """Columns of groups; raises a ``UserError`` for an unknown name."""
        known = f"one of {', '.join(self.groups)}" if self.groups else "no group of columns, as this domain names none"
        for name in names:
            require(name in self.groups, "compose", f"{known} after '@'", repr(name))
        return tuple(column for name in names for column in self.groups[name])

    def exponent(self, window: int) -> float:
        """``start_exponent`` for windows of this length."""
        return self.start_exponent if window >= self.horizon else 1.0


@dataclass(frozen=True)
class Concepts:
    """Concepts of a domain, in words.

    Attributes:
        training: texts of the training concepts.
        suites: suites of evaluation tasks by name: ``'training'`` (training concepts), ``'validation'`` (for tuning), ``'paper'``
            (final evaluation only), or any other name. ``invert`` learns the concepts of ``data.suite``, by default those of the
            suite ``'paper'``. By default, the only suite is that of the training concepts.
        descriptions: texts in the table of embeddings, without the empty text; by default the training concepts and the goals of
            all suites.
        reads: whether a text is a goal that the metrics can judge; by default, whether it is one of the descriptions.
        sentence: conversion of a goal to the sentence that a language model embeds; by default the goal itself.
        table: file with the embeddings of all descriptions, written by ``encode``; ``None`` for none.
    """

    training: tuple[str, ...]
    suites: Mapping[str, Suite] = field(default_factory=dict)
    descriptions: tuple[str, ...] = ()
    reads: Callable[[str], bool] = _DERIVED
    sentence: Callable[[str], str] = str
    table: Path | None = None

    def __post_init__(self) -> None:
        if not self.suites:
            object.__setattr__(self, "suites", {"training": training_suite(self.training)})
        if not self.descriptions:
            texts = dict.fromkeys((*self.training, *(goal for suite in self.suites.values() for goal in suite.goals)))
            object.__setattr__(self, "descriptions", tuple(texts))
        if self.reads is _DERIVED:
            object.__setattr__(self, "reads", frozenset(self.descriptions).__contains__)


class Source(Protocol):
    """Source of demonstrations, such as an expert, a generator or a folder of files."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of each training concept. The splits have no demonstration in common."""
        ...

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """Demonstrations of any task. The same task, count and seed give the same bytes for any number of processes."""
        ...

    def starts(self, task: str, count: int, seed: int) -> InitialStates | None:
        """New initial states of a task; ``None`` if plans have no initial states."""
        ...


@runtime_checkable
class Recoveries(Protocol):
    """Source that also has demonstrations of recovery, which begin where behaviour went wrong."""

    def recoveries(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` recoveries of each training concept that has any. The splits have no demonstration in common."""
        ...


@dataclass(frozen=True)
class Generated:
    """Source of demonstrations that a function generates from a seed, for domains without initial states.

    Attributes:
        name, plans, training: name, plans and training concepts of the domain.
        states: ``(task, count, seed) -> (demo, time, state)`` float32, or a ``(time, state)`` per demonstration if their lengths
            differ; deterministic.
    """

    name: str
    plans: Plans
    training: tuple[str, ...]
    states: Callable[[str, int, int], Iterable[Tensor]]

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of each training concept; ``'validation'`` uses separate seeds."""
        return self._demonstrations(self.training, count, seed if name == "train" else VALIDATION_SEED + seed)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """``count`` demonstrations of a task, in this process."""
        return self._demonstrations((task,), count, seed)

    def starts(self, task: str, count: int, seed: int) -> None:
        """``None``: behaviour has no initial states."""

    def _demonstrations(self, tasks: Sequence[str], count: int, seed: int) -> Demonstrations:
        states, lengths = padded([rows for task in tasks for rows in self.states(task, count, seed)])
        return Demonstrations(
            states=states,
            lengths=lengths,
            domain=self.name,
            state_names=self.plans.columns,
            state_units=self.plans.units,
            concepts=tuple(task for task in tasks for _ in range(count)),
            provenance={"generator": self.name, "seed": seed, "count_per_task": count},
        )


@dataclass(frozen=True)
class Metric:
    """Measure of generated plans.

    Attributes:
        measure: ``(goal, states (sample, horizon, state), initial states or None) -> (sample,)``, of bool (right or wrong) or of
            numbers; or a single number ``()`` for the whole set, such as a distance between distributions. Return NaN for not
            applicable: such plans are excluded from the mean, and a metric without any other value is not reported.
        less_is_better: whether a smaller value is better.
        identity: description of what the values depend on besides the code, such as the hash of a judge's weights; empty for a
            rule. It is part of the configuration's hash.
        calibration: ``goal -> text``: how often the metric accepts real behaviour of the goal, or why it returns NaN; ``None`` for
            a rule.
    """

    measure: Callable[[str, Tensor, InitialStates | None], Tensor]
    less_is_better: bool = False
    identity: str = ""
    calibration: Callable[[str], str] | None = None


@dataclass(frozen=True)
class Privileged:
    """Quantity in training demonstrations that is not observed later, such as the positions of objects.

    Attributes:
        feature: shape of the quantity, a vector.
        error: error of a prediction by an image encoder: ``(prediction (sample, n), feature (sample, *shape)) -> (sample,)``.
        simulate: simulation of a prediction with realistic errors, in place of an encoded image: ``(feature (sample, *shape),
            generator) -> (sample, n)``; ``None`` for none.
    """

    feature: Feature
    error: Callable[[Tensor, Tensor], Tensor]
    simulate: Callable[[Tensor, torch.Generator], Tensor] | None = None


@dataclass(frozen=True)
class Recordings:
    """Recording and import of demonstrations, and what only those for training contain.

    Attributes:
        prepare: conversion of the user's copy of a data set (``python -m ftl_lightning prepare``): ``(folder to read or None,
            folder to write or None for the same) -> text to print``; ``None`` if none is needed.
        recorder: recorder of demonstrations with a pointer; ``None`` if behaviour cannot be shown in this way.
        imports: readers of other programs' files by ending, such as ``'.bvh'``: ``file -> demonstrations`` without a text.
        privileged: quantities in training demonstrations that are not observed, by name. Pretraining can train image encoders to
            predict them (``model.privileged``).
    """

    prepare: Callable[[Path | None, Path | None], str] | None = None
    recorder: Recorder | None = None
    imports: Mapping[str, Callable[[Path], Demonstrations]] = field(default_factory=dict)
    privileged: Mapping[str, Privileged] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Domain(Shown):
    """Domain of behaviour.

    Attributes:
        name: name of the domain in files and of its entry point, see :func:`~ftl_lightning.domains.registry.load_domain`.
        plans: behaviour to generate.
        concepts: texts of the concepts, and suites of evaluation tasks.
        source: constructor of the source of demonstrations, from the folder of the user's data or ``None``.
        show: pictures of plans; by default paths in two or three dimensions, otherwise lines over time.
        observed: features that plans are conditioned on, by name; empty if plans have no initial state.
        metrics: measures of plans in open loop, by name; ablations report the first. Empty if behaviour is judged in closed loop
            only.
        closed_loop: execution of plans; ``None`` for a domain without an environment.
        comparison: standards that results are compared with.
        recordings: recording and import of demonstrations, and what only those for training contain.
    """

    name: str
    plans: Plans
    concepts: Concepts
    source: Callable[[Path | None], Source]
    show: Show = _DERIVED
    observed: Mapping[str, Feature] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    closed_loop: ClosedLoop | None = None
    comparison: Comparison = field(default_factory=Comparison)
    recordings: Recordings = field(default_factory=Recordings)

    def __deepcopy__(self, memo: object) -> Self:
        return self  # immutable

    def __post_init__(self) -> None:
        if self.show is _DERIVED:
            object.__setattr__(self, "show", line_drawings(self.plans.columns, self.plans.units))

    def _words(self) -> Iterator[str]:
        yield repr(self.name)
        yield f"plans of {counted(self.plans.horizon, 'state')} of {counted(len(self.plans.columns), 'column')}"
        yield counted(len(self.concepts.training), "training concept")
        for name, feature in self.observed.items():
            yield f"observes {name} {feature.shape}"
        if self.metrics:
            yield f"judged by {', '.join(self.metrics)}"
        if self.closed_loop is not None:
            yield f"executed for up to {counted(self.closed_loop.steps, 'step')}"

    def fitted(self, demonstrations: Demonstrations, place: str = "states") -> Demonstrations:
        """Demonstrations in the order and units of the domain's columns, see :func:`~ftl_lightning.data.columns.aligned`.

        Raises:
            UserError: naming the ``place`` or key, for behaviour of another domain, other columns or units, or a missing feature.
        """
        wanted = f"behaviour of {self.name}, the model's domain"
        require(demonstrations.domain in (self.name, ""), place, wanted, f"that of {short(demonstrations.domain)}")
        expected, columns = len(self.plans.columns), demonstrations.states.shape[2]
        advice = "; exchange axes 1 and 2" if demonstrations.states.shape[1] == expected else ""
        require(columns == expected, place, f"states of {expected} columns ({self.name})", f"{columns}{advice}")
        return aligned(demonstrations, self.plans.columns, self.plans.units).fitted(self.observed)

    def measure(self, goal: str, states: Tensor, starts: InitialStates | None) -> dict[str, Tensor]:
        """Values of all metrics for plans ``(sample, horizon, state)``, by name.

        Raises:
            UserError: for a metric that returns neither a number per plan nor a single number.
        """
        measured = {name: metric.measure(goal, states, starts) for name, metric in self.metrics.items()}
        for name, values in measured.items():
            _check_shape(f"domain {self.name}, metric {name!r}", values, ((len(states),), ()))
        return measured

    def distances(self, states: Tensor, others: Tensor, distance: Distance) -> Tensor:
        """Distances ``(a, b)`` between plans ``(a, horizon, state)`` and ``(b, horizon, state)``; infinite for plans not finite.

        Raises:
            UserError: for plans of different shapes, or a distance that returns another shape.
        """
        _check_shape(f"domain {self.name}, distance", others, ((len(others), *states.shape[1:]),))
        distances = distance(states, others)
        _check_shape(f"domain {self.name}, distance", distances, ((len(states), len(others)),))
        return distances.nan_to_num(nan=torch.inf, posinf=torch.inf)

    def judge(self, goal: str, rollout: Rollout) -> dict[str, Tensor]:
        """Outcomes of episodes ``(episode,)`` by name.

        Raises:
            UserError: for a domain without an environment, or a judge that returns another shape or no success.
        """
        outcomes = closed_loop_of(self).judge(goal, rollout)
        found = ", ".join(outcomes) if isinstance(outcomes, Mapping) else type(outcomes).__name__
        good = isinstance(outcomes, Mapping) and SUCCESS in outcomes
        require(good, f"domain {self.name}, judge", f"outcomes by name, {SUCCESS!r} among them", found)
        for name, values in outcomes.items():
            _check_shape(f"domain {self.name}, outcome {name!r}", values, ((len(rollout.failed),),))
        return dict(outcomes)

    def check_goal(self, goal: str, key: str = "goal") -> None:
        """Refuse a goal that the domain cannot judge; the ``UserError`` has the most similar known goals."""
        require(isinstance(goal, str), key, f"a text, such as {shown(self.concepts.training[0])}", shown(goal))
        if not self.concepts.reads(goal):
            known = [text for text in self.concepts.descriptions if self.concepts.reads(text)]
            near = difflib.get_close_matches(goal, known, n=5, cutoff=0.4) or known[:5]
            elsewhere = "; a new concept of your own data is judged where it is learned (invert, FewShot.learn)"
            found = f"{short(goal)!r}{elsewhere if self.name == OWN else ''}"
            raise UserError(f"{key}: expected a task of {self.name}, such as {', '.join(map(repr, near))}, found {found}")

    @property
    def main_metric(self) -> str:
        """Metric of ablations: the first metric of plans, or success in closed loop for a domain without metrics."""
        return next(iter(self.metrics), EXECUTED)

    def less_is_better(self, metric: str) -> bool:
        """Whether a smaller value of a metric, or of an outcome in closed loop, is better."""
        if metric == COVERAGE and metric not in self.metrics:
            return True
        if (outcome := metric.removeprefix(f"{CLOSED} ")) != metric:
            outcome = outcome.partition(" (")[0]  # without the environment
            return self.closed_loop is not None and outcome in self.closed_loop.less_is_better
        return metric in self.metrics and self.metrics[metric].less_is_better


def closed_loop_of(domain: Domain) -> ClosedLoop:
    """Execution of plans in a domain; raises a ``UserError`` for a domain without an environment."""
    if domain.closed_loop is None:
        raise UserError(f"execute: expected a domain with an environment, found {domain.name}, which has none")
    return domain.closed_loop


def deferred(reference: str) -> Callable[..., Any]:
    """Function ``'package.module:function'``, imported at its first call: importing matplotlib takes half a second."""
    module, _, name = reference.partition(":")
    return lambda *arguments: getattr(importlib.import_module(module), name)(*arguments)


def _check_shape(place: str, values: object, shapes: Sequence[tuple[int, ...]]) -> None:
    found = f"shape {tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__
    fits = isinstance(values, Tensor) and tuple(values.shape) in shapes
    require(fits, place, f"a tensor of shape {' or '.join(map(str, shapes))}", found)
