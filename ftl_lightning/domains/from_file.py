"""User data as a domain, without code: a file of demonstrations with a concept text for each.

The training concepts are the texts in order of first appearance. Plans have the length of the longest demonstration, or of
``horizon``. The configuration lists metrics, a name and a number each:

``recognised: P``
    right if the goal is the likeliest of all concepts with demonstrations, and the plan is as typical of it as a share P of real
    demonstrations: in place, size, shape and roughness, see :mod:`ftl_lightning.domains.recognition`. Not measured (NaN) where a
    training concept has fewer than :data:`CALIBRATED` held-out demonstrations.
``nearest_demonstration: K``
    right if most of the K demonstrations nearest to the plan (dynamic time warping, columns scaled alike) are of the goal.
``nearest_shape: K``
    right if most of the K demonstrations nearest in shape are of the goal: Euclidean distance after removing place (mean of each
    column) and size (root mean square). For behaviour at any place and size, such as pen strokes.
``end_point_within: R``
    right if the plan ends within R (Euclidean, in the file's units) of where a demonstration of the goal ends.
``dtw_within: R``
    right if the mean distance per step to the nearest demonstration of the goal, after dynamic time warping, is at most R.
``dtw_to_demonstrations: 1``
    this distance itself; less is better. The number does not matter.

Plans are compared with held-out demonstrations; for a new concept, with the demonstrations it was learned from.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.actions import CONTEXT, INITIAL, PRESENT, STILL, action_columns, follows_present
from ftl_lightning.data.columns import check_precision
from ftl_lightning.data.demonstrations import Demonstrations, held, in_sequence
from ftl_lightning.data.distances import warped_distances
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.kinds import LINEAR, Columns, check_values, declared, resolved
from ftl_lightning.data.places import objects, places
from ftl_lightning.data.shards import Shards
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import OWN, Concepts, Domain, Metric, Plans, Recordings, Split, View
from ftl_lightning.domains.recognition import Recognition
from ftl_lightning.domains.recorder import drawn_by_hand
from ftl_lightning.services.errors import about, note, require, short
from ftl_lightning.services.files import read_from
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.services.spectrum import check_cosines

CONTINUOUS = "continuous"
"""View of data with columns that are not linear."""
RECOGNISED, CALIBRATED = "recognised", 10
"""Metric that is calibrated by held-out demonstrations, and the least number of them for each training concept."""


@dataclass(frozen=True)
class FileSource:
    """Source that splits the demonstrations of a file by the mask ``held_out (demo,)`` of the validation split.

    For a folder of files, ``demonstrations`` are the sample of ``shards``.
    """

    demonstrations: Demonstrations
    held_out: Tensor
    shards: Shards | None = None

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """All demonstrations of a split; ``count`` and ``seed`` are ignored."""
        rows = self.held_out if name == "validation" else ~self.held_out
        return self.demonstrations.rows(rows.nonzero()[:, 0].tolist())

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """The first ``count`` demonstrations of a concept; raises a ``UserError`` if there are fewer."""
        rows = _rows(self.demonstrations, task)
        require(len(rows) >= count, "task", f"{count} demonstrations of {task!r} in the file", len(rows))
        return self.demonstrations.rows(rows[:count])

    def starts(self, task: str, count: int, seed: int) -> InitialStates | None:
        """Initial states of held-out demonstrations, drawn with replacement."""
        if not self.demonstrations.observed:
            return None
        starts = self.split("validation", count, seed).initial_states
        return starts.take(torch.randint(len(starts), (count,), generator=generator("cpu", seed)))


HELD_OUT = 3
"""Seed of the demonstrations that are held out."""
ACTED, LEAST_WINDOWS = 32, 2
"""Length of windows of demonstrations whose actions follow the present state, and least number of such windows in the longest."""
LONGEST_PLAN, WINDOW = 1024, 256
"""Maximum length of demonstrations that are learned whole by default, and the default length of windows of longer ones."""


@dataclass(frozen=True, repr=False)
class OwnDomain(Domain):
    """Domain of user data, which is pickled by the arguments of :func:`own_domain`."""

    arguments: tuple[Any, ...] = ()

    def fitted(self, demonstrations: Demonstrations, place: str = "states") -> Demonstrations:
        """As of any domain, and of the kinds of the model's columns. Data of a user may name any domain.

        Raises:
            UserError: also for other kinds, values that contradict a kind, and columns whose steps float32 cannot hold.
        """
        acted = demonstrations.joined if action_columns(self.plans.columns) else demonstrations
        context = next((name for name in self.observed if name.startswith(CONTEXT) and name not in acted.observed), "")
        if context and set(context.removeprefix(CONTEXT).split(",")) <= set(acted.state_names):
            acted = with_context(acted, context)
        if PRESENT in self.observed:
            width = acted.states.shape[2] - len(action_columns(acted.state_names))
            acted = with_present(acted, max(self.observed[PRESENT].shape[0] // max(width, 1), 1))
        acted = with_initial(acted) if INITIAL in self.observed else acted
        fitted = super().fitted(replace(acted, domain=self.name), place)
        kinds = self.plans.kinds or (LINEAR,) * len(self.plans.columns)
        words = [[text.partition(" ")[0] for text in texts] for texts in (fitted.state_kinds or kinds, kinds)]
        wanted = f"{short(', '.join(words[1]), 100)}, the model's"
        require(words[0] == words[1], "key 'state_kinds'", wanted, short(", ".join(words[0]), 100))
        check_values(in_sequence(fitted), fitted.state_names, kinds)
        check_precision(fitted)
        return replace(fitted, state_kinds=kinds, domain=demonstrations.domain)

    def __reduce__(self) -> tuple[Any, ...]:
        return own_domain, self.arguments


def own_domain(
    examples: Demonstrations, training: Sequence[str], horizon: int, metrics: Mapping[str, float], source: FileSource | None = None
) -> Domain:
    """Domain of user data.

    Args:
        examples: demonstrations of all evaluated concepts, which plans are compared with.
        training: training concepts.
        horizon: states in a plan.
        metrics: names and numbers, see this module; an unknown name raises a ``UserError``.
        source: source of demonstrations; ``None`` for the examples.
    """
    unknown = sorted(set(metrics) - set(METRICS))
    require(not unknown, "data.metrics", f"some of {', '.join(METRICS)}", ", ".join(unknown))
    source = source or FileSource(examples, torch.ones(len(examples), dtype=torch.bool))
    columns = Columns(examples.state_kinds)
    names, judged, convert = columns.names(examples.state_names), examples, _same
    if columns or examples.states.dtype == torch.float64:
        convert = partial(_continuous, columns, columns.encode(examples.states).flatten(0, 1).mean(dim=0))
        units = ("",) * len(names)
        judged = replace(examples, states=convert(examples.states), state_names=names, state_units=units, state_kinds=())
    view = View(
        examples.features,
        observe=lambda observed: observed,
        encode=lambda states, observed: columns.encode(states),
        decode=lambda states, observed: columns.decode(states),
        columns=names,
    )

    missing = uncalibrated(examples, training) if RECOGNISED in metrics else ""

    def metric(name: str, number: float) -> Metric:
        made = METRICS[name](judged, horizon, number)
        if name == RECOGNISED and missing:
            return Metric(_not_measured, identity=examples.hash, calibration=lambda goal: missing)
        return replace(
            made, measure=lambda goal, states, starts: made.measure(goal, convert(states), starts), identity=examples.hash
        )

    def distance(states: Tensor, others: Tensor) -> Tensor:
        return _distance(judged, convert(states), convert(others))

    return OwnDomain(
        name=OWN,
        plans=Plans(
            horizon,
            examples.state_names,
            examples.state_units,
            views={CONTINUOUS: view} if columns else {},
            kinds=examples.state_kinds,
        ),
        concepts=Concepts(training=tuple(training), reads=frozenset(examples.concepts).__contains__),
        source=lambda root: source,
        observed=examples.features,
        metrics={name: metric(name, number) for name, number in metrics.items()},
        comparison=Comparison(headline=next(iter(metrics), ""), distance=distance, fresh=False),
        recordings=Recordings(recorder=drawn_by_hand(examples, horizon)),
        arguments=(examples, tuple(training), horizon, dict(metrics), source),
    )


def context_of(demonstrations: Demonstrations) -> str:
    """Name of the feature of the columns of states, but for actions, that differ between demonstrations only; empty for none."""
    acts, names = action_columns(demonstrations.state_names), demonstrations.state_names
    states = demonstrations.states.double()
    valid = (torch.arange(states.shape[1]) < demonstrations.lengths[:, None])[..., None]
    top, bottom = states.where(valid, -torch.inf).amax(dim=1), states.where(valid, torch.inf).amin(dim=1)  # (demo, column)
    whole = top.amax(dim=0) - bottom.amin(dim=0)
    still = ((top - bottom).amax(dim=0) <= STILL * whole) & (whole > 0)
    columns = [column for column in still.nonzero()[:, 0].tolist() if column not in acts]
    rest = len(names) - len(acts) - len(columns)
    return CONTEXT + ",".join(names[column] for column in columns) if columns and rest else ""


def with_context(demonstrations: Demonstrations, context: str) -> Demonstrations:
    """Demonstrations whose columns of a context, see :func:`context_of`, are an observed feature."""
    names = context.removeprefix(CONTEXT).split(",")
    columns = [demonstrations.state_names.index(name) for name in names]
    rest = [column for column in range(demonstrations.states.shape[2]) if column not in columns]
    observed = {**demonstrations.observed, context: demonstrations.states[..., columns].float()}
    return replace(demonstrations.columns(rest), observed=observed, per_step=(*demonstrations.per_step, context))


def with_present(demonstrations: Demonstrations, history: int) -> Demonstrations:
    """Demonstrations that observe the last ``history`` states, without their actions; the first state is repeated."""
    acts = action_columns(demonstrations.state_names)
    states = demonstrations.states[..., [column for column in range(demonstrations.states.shape[2]) if column not in acts]]
    time = torch.arange(states.shape[1])
    past = torch.cat([states[:, (time - back).clamp(min=0)] for back in reversed(range(history))], dim=2)
    observed = {**demonstrations.observed, PRESENT: past.float()}
    return replace(demonstrations, observed=observed, per_step=(*demonstrations.per_step, PRESENT))


def with_initial(demonstrations: Demonstrations) -> Demonstrations:
    """Demonstrations that observe the initial state, without its actions."""
    acts = action_columns(demonstrations.state_names)
    first = demonstrations.states[:, 0, [column for column in range(demonstrations.states.shape[2]) if column not in acts]]
    return replace(demonstrations, observed={**demonstrations.observed, INITIAL: first.float()})


def _follows(demonstrations: Demonstrations, acts: list[int]) -> bool:
    """Whether actions follow the present state, see :func:`~ftl_lightning.data.actions.follows_present`."""
    rest = [column for column in range(demonstrations.states.shape[2]) if column not in acts]
    states, time = demonstrations.states, demonstrations.states.shape[1]
    timed = [
        values.flatten(2) if name in demonstrations.per_step else values.flatten(1)[:, None].expand(-1, time, -1)
        for name, values in demonstrations.observed.items()
        if values.dtype != torch.uint8
    ]
    observed = torch.cat(timed, dim=2) if timed else states.new_zeros(len(states), time, 0)
    return follows_present(states[..., rest], states[..., acts], demonstrations.lengths, demonstrations.concepts, observed)


def uncalibrated(examples: Demonstrations, training: Sequence[str]) -> str:
    """Why the metric recognised is not shown; empty if every training concept has enough held-out demonstrations."""
    counts = {name: examples.concepts.count(name) for name in training}
    fewest = min(counts, key=lambda name: counts[name])
    if counts[fewest] >= CALIBRATED:
        return ""
    needed = f"it needs {CALIBRATED} held-out demonstrations of each training concept"
    found = f"{short(fewest, 40)!r} has {counts[fewest]}"
    return f"{RECOGNISED} is not shown: {needed}, and {found}; fit with a larger data.validation_share"


def _not_measured(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    return torch.full((len(states),), torch.nan)


def _same(states: Tensor) -> Tensor:
    return states


def _continuous(columns: Columns, centre: Tensor, states: Tensor) -> Tensor:
    """Continuous columns of states ``(..., state)`` in float32, less a ``centre`` so that nothing is lost."""
    return (columns.encode(states) - centre).float()


def domain_from_file(
    path: str,
    horizon: int | None,
    metrics: Mapping[str, float],
    share: float,
    kinds: Mapping[str, str] | None = None,
    history: int = 1,
) -> Domain:
    """Domain of a file.

    Args:
        path: the file, a folder of files, the folder of a LeRobot data set, or the name of an installed Minari data set.
        horizon: states in a plan; ``None`` for the length of the longest demonstration, or :data:`WINDOW` if it is longer than
            :data:`LONGEST_PLAN`. Plans of data with actions that are whole demonstrations use features at the first time alone.
        metrics: see :func:`own_domain`.
        share: share of each concept's demonstrations to hold out at random, at least a single demonstration.
        kinds: kinds of columns by name, see :func:`~ftl_lightning.data.kinds.declared`.
        history: number of states that windows of data with actions observe.

    Raises:
        UserError: naming the file, if it has no texts, fewer than two concepts, or a concept with a single demonstration.
    """
    shards = Shards.of(path, read_own) if read_from(path)[0] == "folder" else None
    demonstrations = of_kinds(read_own(path) if shards is None else shards.sample, kinds or {}, path)
    with about(path):
        check_precision(demonstrations)
    rows_of = demonstrations.rows_of
    expected = "texts of two concepts or more to pretrain on"
    require(len(rows_of) >= 2, f"{path}: key 'concepts'", expected, f"only {short(', '.join(map(repr, rows_of)))}")
    held_out = torch.zeros(len(demonstrations), dtype=torch.bool)
    for text, rows in rows_of.items():
        require(len(rows) >= 2, f"{path}: concept {text!r}", "two demonstrations or more (one is held out)", len(rows))
        mixed = torch.randperm(len(rows), generator=generator("cpu", task_key(text), HELD_OUT))
        held_out[torch.tensor(rows)[mixed[: max(1, math.floor(share * len(rows)))]]] = True
    longest = int(demonstrations.lengths.max())
    usual = longest if longest <= LONGEST_PLAN else WINDOW
    acts = list(action_columns(demonstrations.state_names))
    if acts and (context := context_of(demonstrations)):
        note(f"{path}: {short(context, 80)}: columns that are constant in each demonstration are observed")
        demonstrations = with_context(demonstrations, context)
        acts = list(action_columns(demonstrations.state_names))
    if acts and (horizon or usual) >= longest and objects(demonstrations, longest):
        demonstrations = with_initial(demonstrations)
    followed = places(demonstrations, longest) if acts else {}
    if acts and horizon is None and not followed and longest > LEAST_WINDOWS * ACTED and _follows(demonstrations, acts):
        horizon, whole = ACTED, f"--data.horizon {longest} makes them whole"
        note(f"data.horizon: actions follow the present state, so plans are windows of {horizon}; {whole}")
    if acts and horizon is not None and horizon < longest:
        demonstrations = with_present(demonstrations, history)
    seen = "windows of demonstrations with actions, which observe states; see data.horizon"
    require(history == 1 or PRESENT in demonstrations.observed, "data.history", f"1, or {seen}", history)
    if acts and longest <= (horizon or usual):
        demonstrations = demonstrations.at_start
        note(f"{path}: plans are whole demonstrations, which follow the places {short(', '.join(followed), 80) or 'none'}")
    source = FileSource(demonstrations, held_out, shards)
    return own_domain(source.split("validation", 0, 0), tuple(rows_of), horizon or usual, metrics, source)


def read_own(path: str) -> Demonstrations:
    """Read user data, see :meth:`Demonstrations.load`; demonstrations without a text are named after the file.

    Raises:
        UserError: naming the file, if it is missing or damaged.
    """
    read = Demonstrations.load(path).named(Path(path).stem).joined
    return replace(read, states=held(read.states, read.lengths, continues=0))


def of_kinds(demonstrations: Demonstrations, kinds: Mapping[str, str], place: str) -> Demonstrations:
    """Demonstrations with the resolved kind of each column, declared or proposed by the data; a note names what is not linear.

    Raises:
        UserError: for an unknown column or kind, or values that contradict a declared kind.
    """
    names, units = demonstrations.state_names, demonstrations.state_units
    given = declared(names, demonstrations.state_kinds, kinds, f"{place}: data.kinds")
    found = resolved(in_sequence(demonstrations), names, units, given, place)
    if not any(given):
        for text in Columns(found).notes(names):
            note(f"{place}: {text}; data.kinds declares others")
    return replace(demonstrations, state_kinds=found)


def read_demonstrations(path: str, domain: Domain) -> Demonstrations:
    """Read demonstrations of a domain; those without a text are named after the file or data set.

    Raises:
        UserError: naming the file, if it does not fit the domain.
    """
    demonstrations = Demonstrations.load(path).named(Path(path).stem)
    with about(path):
        return domain.fitted(demonstrations, "key 'states'")


def _rows(demonstrations: Demonstrations, concept: str) -> list[int]:
    return [row for row, text in enumerate(demonstrations.concepts) if text == concept]


def _goal_rows(examples: Demonstrations, goal: str) -> list[int]:
    rows = _rows(examples, goal)
    require(rows, "goal", "a concept with demonstrations to compare with", repr(goal))
    return rows


def _scaled(examples: Demonstrations, states: Tensor) -> Tensor:
    """Scale columns by their standard deviation over the examples; constant columns stay unscaled."""
    spread = examples.states.flatten(0, 1).std(dim=0)
    return states / torch.where(spread > 0, spread, 1)


def _whole(states: Tensor) -> Tensor:
    return torch.full((len(states),), states.shape[1])


def _distance(examples: Demonstrations, states: Tensor, others: Tensor) -> Tensor:
    """:func:`~ftl_lightning.data.distances.warped_distances` ``(a, b)`` of whole plans with scaled columns."""
    rows, columns = _scaled(examples, states), _scaled(examples, others)
    if len(columns) < len(rows):  # loop over the smaller set
        return warped_distances(columns, _whole(columns), rows, _whole(rows)).T
    return warped_distances(rows, _whole(rows), columns, _whole(columns))


def _recognised(examples: Demonstrations, horizon: int, number: float) -> Metric:
    require(0 < number <= 1, "data.metrics.recognised", "a share of real demonstrations above 0, at most 1", f"{number:g}")
    check_cosines(horizon, "the metric recognised")
    recognition = cache(lambda: Recognition(examples, horizon, number))  # fitted on first use
    acceptance = cache(lambda count: recognition().acceptance(count))

    def calibration(goal: str) -> str:
        count = len(_goal_rows(examples, goal))
        return f"accepts {acceptance(count):.2f} of held-out demonstrations by {count} others of their concept"

    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        _goal_rows(examples, goal)
        return recognition().recognised(goal, states)

    return Metric(measure, identity=examples.hash, calibration=calibration)


MOST_COMPARED = 20
"""Maximum number of demonstrations of a concept that are compared with the others."""


def _nearest(name: str, examples: Demonstrations, horizon: int, number: float, distances: Callable[[Tensor], Tensor]) -> Metric:
    """Whether most of the ``number`` nearest examples, by ``distances: states (n, ...) -> (n, example)``, are of the goal.

    NaN for a goal whose own demonstrations are not recognised by the others, such as a known concept by another name.
    """
    require(number >= 1, f"data.metrics.{name}", "1 or more neighbours", f"{number:g}")
    count = min(int(number), len(examples))

    def mostly(rows: list[int], apart: Tensor) -> Tensor:
        of_goal = torch.zeros(len(examples), dtype=torch.bool)
        of_goal[rows] = True
        return of_goal[apart.topk(count, largest=False).indices].float().mean(dim=1) > 0.5

    @cache
    def like_another(goal: str) -> bool:
        rows = _goal_rows(examples, goal)
        some = rows[:MOST_COMPARED]
        apart = distances(_cut(examples.states[some], horizon))
        apart[torch.arange(len(some)), some] = torch.inf
        return len(rows) > count and bool(mostly(rows, apart).float().mean() <= 0.5)

    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        return _not_measured(goal, states, starts) if like_another(goal) else mostly(_goal_rows(examples, goal), distances(states))

    def calibration(goal: str) -> str:
        return f"{name} is not measured: demonstrations of {goal!r} are like those of other concepts" if like_another(goal) else ""

    return Metric(measure, identity=examples.hash, calibration=calibration)


def _cut(states: Tensor, horizon: int) -> Tensor:
    """States ``(n, horizon, state)`` of behaviour of any length: cut, or continued by its last state."""
    return states[:, torch.arange(horizon).clamp(max=states.shape[1] - 1)]


def _nearest_demonstration(examples: Demonstrations, horizon: int, number: float) -> Metric:
    known, lengths = _scaled(examples, examples.states)[:, :horizon], examples.lengths.clamp(max=horizon)

    def distances(states: Tensor) -> Tensor:
        return warped_distances(_scaled(examples, states), _whole(states), known, lengths)

    return _nearest("nearest_demonstration", examples, horizon, number, distances)


def _nearest_shape(examples: Demonstrations, horizon: int, number: float) -> Metric:
    known = _shapes(_cut(examples.states, horizon))
    return _nearest("nearest_shape", examples, horizon, number, lambda states: torch.cdist(_shapes(states), known))


def _shapes(states: Tensor) -> Tensor:
    """Remove place and size of behaviour ``(n, time, state)``: ``(n, time * state)``."""
    moved = states - states.mean(dim=1, keepdim=True)
    return (moved / moved.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-9)).flatten(1)


def _end_point_within(examples: Demonstrations, horizon: int, number: float) -> Metric:
    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        rows = _goal_rows(examples, goal)
        ends = examples.states[rows, examples.lengths[rows].clamp(max=horizon) - 1]
        return torch.cdist(states[:, -1], ends).amin(dim=1) <= number

    return Metric(measure, identity=examples.hash)


def _dtw_to_demonstrations(examples: Demonstrations, horizon: int, number: float) -> Metric:
    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        rows = _goal_rows(examples, goal)
        lengths = examples.lengths[rows].clamp(max=horizon)
        return warped_distances(states, _whole(states), examples.states[rows, :horizon], lengths).amin(dim=1)

    return Metric(measure, less_is_better=True, identity=examples.hash)


def _dtw_within(examples: Demonstrations, horizon: int, number: float) -> Metric:
    distance = _dtw_to_demonstrations(examples, horizon, number).measure
    return Metric(lambda goal, states, starts: distance(goal, states, starts) <= number, identity=examples.hash)


METRICS: dict[str, Callable[[Demonstrations, int, float], Metric]] = {
    "recognised": _recognised,
    "nearest_demonstration": _nearest_demonstration,
    "nearest_shape": _nearest_shape,
    "end_point_within": _end_point_within,
    "dtw_within": _dtw_within,
    "dtw_to_demonstrations": _dtw_to_demonstrations,
}
