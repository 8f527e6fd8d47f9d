"""What a domain is: one object in a few groups. Adding a domain adds such an object, here or in a package of one's own.

Name, plans, concepts and source are required; everything else has a default.
"""

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import Feature, InitialStates, Observed
from ftl_lightning.domains import line_plots
from ftl_lightning.domains.distances import Distance
from ftl_lightning.domains.paper import PAPERS_METHOD, Compared, Paper
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.tasks import Suite, training_suite
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.text import Shown, counted

if TYPE_CHECKING:
    import gymnasium
    from matplotlib.figure import Figure

    from ftl_lightning.domains.recorder import Recorder
    from ftl_lightning.domains.vector_film import VectorFilm
    from ftl_lightning.domains.wireframe import Wireframe

ACCURACY = "accuracy"
SUCCESS = "success"
NOVELTY, COVERAGE = "novelty", "coverage"
"""Distances of generated plans to demonstrations and of fresh behaviour to generated plans, in every domain, see
:mod:`ftl_lightning.evaluation.diversity`; a metric of a domain's own by one of these names stands in its place."""
CLOSED = "closed loop"
EXECUTED = f"{CLOSED} {SUCCESS}"
Split = Literal["train", "validation"]
Frames = list[NDArray[np.uint8]]
"""Pictures ``(height, width, 3)``."""


@dataclass(frozen=True)
class Plans:
    """The behaviour that is generated.

    Attributes:
        horizon: number of states in a plan.
        columns, units: name and unit of each column of a state.
        start_exponent: where training windows as long as a plan start in a demonstration: ``start = length * share^start_exponent``
            with a uniform ``share``. 1 is uniform; with 3 half of the windows start in the first eighth, for plans that cover the
            whole behaviour. Shorter windows start anywhere.
        at_rest: whether behaviour is at rest at the end of a demonstration. Windows may then reach past the end, where the last
            state is repeated; otherwise they stay within demonstrations that are long enough.
        groups: named groups of columns, such as the legs of a body; a composition may restrict a concept to some of them.
        resolution: columns of states and observed vectors that vary by less than this, in their units, count as constant.
    """

    horizon: int
    columns: tuple[str, ...]
    units: tuple[str, ...]
    start_exponent: float = 1.0
    resolution: float = 0.0
    at_rest: bool = True
    groups: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def grouped(self, names: Sequence[str]) -> tuple[int, ...]:
        """Columns of some groups.

        Raises:
            UserError: for a name that is none.
        """
        if unknown := [name for name in names if name not in self.groups]:
            told = f"one of {', '.join(self.groups)}" if self.groups else "no group of columns, as this domain names none"
            raise UserError(f"compose: expected {told} after '@', found {unknown[0]!r}")
        return tuple(column for name in names for column in self.groups[name])

    def exponent(self, window: int) -> float:
        """That of windows of this length."""
        return self.start_exponent if window >= self.horizon else 1.0


_UNSAID: Any = None  # default of a field whose value follows from the others where it is not said


@dataclass(frozen=True)
class Concepts:
    """The behaviour's concepts, in words.

    Attributes:
        training: texts of the training concepts.
        suites: evaluation tasks by name of the suite: ``'training'`` (training concepts), ``'validation'`` (for tuning),
            ``'paper'`` (final evaluation only), or any other. ``invert`` learns the suite ``'paper'`` unless ``data.suite`` says
            otherwise. By default the training concepts alone.
        descriptions: every text in the table of embeddings besides the empty one; by default the training concepts and the suites'
            goals.
        reads: whether a text is a goal that behaviour can be judged by; by default, whether it is one of the descriptions.
        sentence: turns a goal into the sentence that a language model embeds; by default the goal itself.
        table: file with the embeddings of all descriptions, made by ``encode``; ``None`` where none ships.
    """

    training: tuple[str, ...]
    suites: Mapping[str, Suite] = field(default_factory=dict)
    descriptions: tuple[str, ...] = ()
    reads: Callable[[str], bool] = _UNSAID
    sentence: Callable[[str], str] = str
    table: Path | None = None

    def __post_init__(self) -> None:
        if not self.suites:
            object.__setattr__(self, "suites", {"training": training_suite(self.training)})
        if not self.descriptions:
            texts = dict.fromkeys((*self.training, *(goal for suite in self.suites.values() for goal in suite.goals)))
            object.__setattr__(self, "descriptions", tuple(texts))
        if self.reads is _UNSAID:
            object.__setattr__(self, "reads", frozenset(self.descriptions).__contains__)


class Source(Protocol):
    """Where demonstrations come from: an expert, a generator, a folder of files."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of every training concept; those of ``'validation'`` are in no training split."""
        ...

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """Demonstrations of any task; the same task, count and seed give the same bytes, whatever the number of processes."""
        ...

    def starts(self, task: str, count: int, seed: int) -> InitialStates | None:
        """New initial states of a task; ``None`` where behaviour has none."""
        ...


@runtime_checkable
class Recoveries(Protocol):
    """A source that also has demonstrations which begin where behaviour went wrong."""

    def recoveries(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` of every training concept of which there are some; those of ``'validation'`` are in no training split."""
        ...


@dataclass(frozen=True)
class Metric:
    """How generated plans are judged.

    Attributes:
        measure: ``(goal, states (sample, horizon, state), initial states or None) -> (sample,)`` of bool (right or wrong) or of
            numbers; or one number ``()`` for the whole set, such as a distance between distributions. NaN where it says nothing
            of a plan or a goal: such plans do not count, and where it says nothing at all it is not reported.
        less_is_better: whether a smaller value is better.
        identity: what the values depend on besides the code, such as the hash of a trained judge's weights. It is part of the
            configuration's hash; empty for a rule.
    """

    measure: Callable[[str, Tensor, InitialStates | None], Tensor]
    less_is_better: bool = False
    identity: str = ""


@dataclass(frozen=True)
class Show:
    """Pictures of plans.

    Attributes:
        picture: ``(states (sample, horizon, state), right (sample,) of bool or None if not judged, title, initial states or None)
            -> figure``.
        film: ``states (horizon, state) -> frames`` of one plan; ``None`` where a plan is not a motion.
        wireframe: ``states (horizon, state) -> moving points and lines``, from which a web page draws the same film in a twentieth
            of its size; ``None`` where a plan cannot be drawn in this way.
        vector_film: ``(states (horizon, state), initial state or None) -> shapes that move``, which ``report --html`` shows;
            ``None`` for those of the wireframe, if there is one.
        beside: ``(demonstrations (demo, horizon, state), samples (sample, horizon, state), title, right (sample,) of bool or None)
            -> figure`` of both on one scale; ``None`` for one picture above the other.
        exports: by the ending of a file, such as ``'.bvh'``, ``states (horizon, state) -> text`` of one plan for other programs
            (``sample --export``); empty where none reads such behaviour.
    """

    picture: Callable[[Tensor, Sequence[bool] | None, str, InitialStates | None], "Figure"]
    film: Callable[[Tensor], Frames] | None = None
    wireframe: Callable[[Tensor], "Wireframe"] | None = None
    vector_film: "Callable[[Tensor, InitialStates | None], VectorFilm] | None" = None
    beside: Callable[[Tensor, Tensor, str, Sequence[bool] | None], "Figure"] | None = None
    exports: Mapping[str, Callable[[Tensor], str]] = field(default_factory=dict)


def line_drawings(plans: Plans) -> Show:
    """Pictures of behaviour of which nothing but its columns is known, see :mod:`ftl_lightning.domains.line_plots`.

    Paths in two or three dimensions are also filmed.
    """
    film = line_plots.film if len(plans.columns) in (2, 3) else None
    drawn = line_plots.path_film if len(plans.columns) == 2 else line_plots.line_film
    return Show(line_plots.picture(plans.columns), film, vector_film=drawn, beside=line_plots.beside(plans.columns))


Policy = Callable[[Observed, list[int], int], Tensor]
"""``(observed (episode, *shape) by name, which episodes, step) -> actions (episode, action)``; not finite where there is none."""


@dataclass(frozen=True)
class ClosedLoop:
    """How a domain executes plans.

    Attributes:
        environment: makes a Gymnasium environment. Its observations are the domain's observed features by name; its ``reset`` takes
            ``options={'scene': (scene,)}``. ``judge`` also receives the ``info`` of its last step.
        act: the planner: ``(plans (episode, horizon, state), steps since the plans were made, observed (episode, *shape) by name)
            -> actions (episode, action)``.
        steps: maximum number of steps in an episode.
        judge: ``(goal, rollout) -> outcomes`` by name, each ``(episode,)``. One of them is ``'success'``, of bool.
        film: ``(rollout of one episode, plans (step, horizon, state) that were followed) -> frames``; ``None`` where episodes are
            not filmed.
        vector_film: ``rollout of one episode -> shapes that move``, which ``report --html`` shows; ``None`` for no film.
        keeps: names of the observed features that ``judge`` and films need; all where empty.
        less_is_better: names of the outcomes of which a smaller value is better, such as ``'crash'``.
        identity: what outcomes depend on besides the code, such as the planner's name. It is part of the configuration's hash; may
            be empty.
        others: more environments by name, such as one with another planner. ``evaluation.environments`` chooses those in which
            plans are also executed.
        policies: reference lines that act step by step, by name: ``(goal, initial states, demonstrations that the concept was
            learned from or None, seed) -> policy``, or ``None`` where it would take too long.
        expect: raises a :class:`~ftl_lightning.services.errors.UserError` if the environment lacks a package; called
            before any work.
    """

    environment: "Callable[[], gymnasium.Env[Any, Any]]"
    act: Callable[[Tensor, int, Observed], Tensor]
    steps: int
    judge: Callable[[str, Rollout], dict[str, Tensor]]
    film: Callable[[Rollout, Tensor], Frames] | None = None
    vector_film: "Callable[[Rollout], VectorFilm] | None" = None
    keeps: tuple[str, ...] = ()
    less_is_better: tuple[str, ...] = ()
    identity: str = ""
    others: "Mapping[str, Callable[[], gymnasium.Env[Any, Any]]]" = field(default_factory=dict)
    policies: Mapping[str, Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]] = field(default_factory=dict)
    expect: Callable[[], None] = lambda: None

    def inside(self, name: str) -> Self:
        """How plans are executed in another environment; in the domain's own for the empty name."""
        return replace(self, environment=self.others[name]) if name else self


@dataclass(frozen=True)
class View:
    """How a model sees behaviour, where this differs from what files hold.

    Attributes:
        features: the features that the model observes, by name.
        observe: turns the domain's observed features into these features.
        encode: ``(states (sample, horizon, state), observed) -> (sample, horizon, state)``, what the model generates.
        decode: the inverse of ``encode``; of generated states that are impossible, it returns the nearest possible ones.
        perturb: ``(states, observed, generator) -> (states, observed)`` with a slightly different present state, used in training:
            it teaches recovery from states outside the demonstrations. Without a generator it only hides what a new task will not
            show. ``None`` for no perturbation.
        act: a planner for plans in this view, as ``act`` of :class:`ClosedLoop`; ``None`` for the domain's planner.
        scales: groups of columns of a state; columns at the same position in each group share a scale.
        same_columns: whether encoded states have the same columns as the domain's states.
        plane: columns of an encoded state that are x and y in the coordinates of what is seen as points: a denoiser may turn plans
            together with these.
    """

    features: Mapping[str, Feature]
    observe: Callable[[Observed], Observed]
    encode: Callable[[Tensor, Observed], Tensor]
    decode: Callable[[Tensor, Observed], Tensor]
    perturb: Callable[[Tensor, Observed, torch.Generator | None], tuple[Tensor, Observed]] | None = None
    act: Callable[[Tensor, int, Observed], Tensor] | None = None
    scales: tuple[tuple[int, ...], ...] = ()
    same_columns: bool = False
    plane: tuple[int, ...] = ()


@dataclass(frozen=True)
class Privileged:
    """Something that training demonstrations show and that is not observed later, such as where objects are.

    Attributes:
        feature: a vector.
        error: ``(read (sample, n), feature (sample, *shape)) -> (sample,)``, how wrong what was read of an image is.
        told: ``(feature (sample, *shape), draw) -> (sample, n)``, what an encoder of images might read of one that shows this,
            with errors as it makes them; ``None`` where nobody can say.
    """

    feature: Feature
    error: Callable[[Tensor, Tensor], Tensor]
    told: Callable[[Tensor, torch.Generator], Tensor] | None = None


def _expect(what: str, values: object, shapes: Sequence[tuple[int, ...]]) -> None:
    if not isinstance(values, Tensor) or tuple(values.shape) not in shapes:
        found = f"shape {tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__
        raise UserError(f"{what}: expected a tensor of shape {' or '.join(map(str, shapes))}, found {found}")


@dataclass(frozen=True, repr=False)
class Domain(Shown):
    """A domain.

    Attributes:
        name: the name under which its package offers it, see :func:`ftl_lightning.domains.registry.load_domain`.
        plans: the behaviour that is generated.
        concepts: texts of the concepts, and suites of evaluation tasks.
        source: makes the source of demonstrations, given the folder of the user's data or ``None``.
        show: pictures of plans; by default lines over time, or paths where a state has two or three columns.
        observed: features that a plan is conditioned on, by name; empty where plans have no initial state.
        privileged: what training demonstrations show beside these, by name: the encoder of images can be taught by it in
            pretraining (``model.privileged``). No model observes it.
        metrics: how plans are judged in open loop, by name; the first is the one that ablations report. Empty where behaviour is
            judged in closed loop only.
        ours: our method in the form that others are compared with; the paper's by default.
        headline: what methods are compared by: the name of a metric, or ``'closed loop '`` and an outcome.
        references: reference lines (trivial policies and oracles) by name: ``(goal, samples, initial states or None, seed) ->
            states (sample, horizon, state)``.
        views: ways in which a model may see behaviour, by name; without any, the model sees states as they are.
        closed_loop: how plans are executed; ``None`` where they cannot be.
        distance: between plans, for novelty and coverage: ``(states (a, horizon, state), others (b, horizon, state)) -> (a, b)``;
            ``None`` for the root mean square over the plan's times, columns scaled by their spread.
        fresh: whether the source draws demonstrations of any goal quickly enough to do so in every evaluation; otherwise coverage
            is not measured.
        paper: published numbers, if there are any.
        prepare: ``(folder of the user's copy of the data, folder to write or None for the same) -> text to print``, for recordings
            that are read once before they are used; see ``python -m ftl_lightning prepare``.
        recorder: how a person shows behaviour with a pointer, see :mod:`ftl_lightning.domains.recorder`; ``None`` where nobody can.
        imports: by the ending of a file of other programs, such as ``'.bvh'``, ``file -> demonstrations`` without a text.
    """

    name: str
    plans: Plans
    concepts: Concepts
    source: Callable[[Path | None], Source]
    show: Show = _UNSAID
    observed: Mapping[str, Feature] = field(default_factory=dict)
    privileged: Mapping[str, Privileged] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    ours: Compared = PAPERS_METHOD
    headline: str = ACCURACY
    references: Mapping[str, Callable[[str, int, InitialStates | None, int], Tensor]] = field(default_factory=dict)
    views: Mapping[str, View] = field(default_factory=dict)
    closed_loop: ClosedLoop | None = None
    distance: Distance | None = None
    fresh: bool = True
    paper: Paper | None = None
    prepare: Callable[[Path | None, Path | None], str] | None = None
    recorder: "Recorder | None" = None
    imports: Mapping[str, Callable[[Path], Demonstrations]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.show is _UNSAID:
            object.__setattr__(self, "show", line_drawings(self.plans))

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

    def measure(self, goal: str, states: Tensor, starts: InitialStates | None) -> dict[str, Tensor]:
        """What each metric says of plans ``(sample, horizon, state)``, by name.

        Raises:
            UserError: for a metric that returns neither a number for each plan nor one for all of them.
        """
        measured = {name: metric.measure(goal, states, starts) for name, metric in self.metrics.items()}
        for name, values in measured.items():
            _expect(f"domain {self.name}, metric {name!r}", values, ((len(states),), ()))
        return measured

    def distances(self, states: Tensor, others: Tensor, distance: Distance) -> Tensor:
        """Between plans ``(a, horizon, state)`` and others ``(b, horizon, state)``: ``(a, b)``.

        Plans that are not finite are infinitely far from all others.

        Args:
            states, others: of one shape but for their numbers.
            distance: the domain's, or what stands for it.

        Raises:
            UserError: for plans of different shapes, or a distance that returns something else.
        """
        _expect(f"domain {self.name}, distance", others, ((len(others), *states.shape[1:]),))
        distances = distance(states, others)
        _expect(f"domain {self.name}, distance", distances, ((len(states), len(others)),))
        return distances.nan_to_num(nan=torch.inf, posinf=torch.inf)

    def judge(self, goal: str, rollout: Rollout) -> dict[str, Tensor]:
        """What happened in episodes, by name ``(episode,)``.

        Raises:
            UserError: for a domain without an environment, or a judge that returns something else or no success.
        """
        outcomes = closed_loop_of(self).judge(goal, rollout)
        if not isinstance(outcomes, Mapping) or SUCCESS not in outcomes:
            told = ", ".join(outcomes) if isinstance(outcomes, Mapping) else type(outcomes).__name__
            raise UserError(f"domain {self.name}, judge: expected outcomes by name, {SUCCESS!r} among them, found {told}")
        for name, values in outcomes.items():
            _expect(f"domain {self.name}, outcome {name!r}", values, ((len(rollout.failed),),))
        return dict(outcomes)

    def check_goal(self, goal: str, key: str = "goal") -> None:
        """Refuse a goal that the domain cannot read.

        Raises:
            UserError: naming the nearest goals that it knows.
        """
        if not isinstance(goal, str):
            raise UserError(f"{key}: expected a text, such as {shown(self.concepts.training[0])}, found {shown(goal)}")
        if not self.concepts.reads(goal):
            known = [text for text in self.concepts.descriptions if self.concepts.reads(text)]
            near = difflib.get_close_matches(goal, known, n=5, cutoff=0.4) or known[:5]
            raise UserError(f"{key}: expected a task of {self.name}, such as {', '.join(map(repr, near))}, found {short(goal)!r}")

    @property
    def main_metric(self) -> str:
        """What ablations are about: the first metric of plans, or success where only what comes of them is judged."""
        return next(iter(self.metrics), EXECUTED)

    def less_is_better(self, metric: str) -> bool:
        """Whether a smaller value of a metric, or of an outcome in closed loop, is better."""
        if metric == COVERAGE and metric not in self.metrics:
            return True
        if (outcome := metric.removeprefix(f"{CLOSED} ")) != metric:
            outcome = outcome.partition(" (")[0]  # the environment
            return self.closed_loop is not None and outcome in self.closed_loop.less_is_better
        return metric in self.metrics and self.metrics[metric].less_is_better


def closed_loop_of(domain: Domain) -> ClosedLoop:
    """How a domain executes plans.

    Raises:
        UserError: for one that cannot.
    """
    if domain.closed_loop is None:
        raise UserError(f"execute: expected a domain with an environment, found {domain.name}, which has none")
    return domain.closed_loop
