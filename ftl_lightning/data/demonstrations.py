"""Demonstrations of tasks, and the registry of their file formats."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.actions import held_actions, named_actions
from ftl_lightning.data.features import Feature, InitialStates, Observed, check_whole, precise, take
from ftl_lightning.data.kinds import KINDS, Paths
from ftl_lightning.services.errors import UserError, about, require, short, shown
from ftl_lightning.services.files import MOST_RATIO, MOST_TENSORS, MOST_UNPACKED, raised, read_from, written_to
from ftl_lightning.services.tensor_file import bytes_hash, serialise
from ftl_lightning.services.text import Shown, counted

KIND = "demonstrations"
"""Kind of a safetensors file of demonstrations."""
CONTINUES = 1.5
"""Maximum step of padding that continues a demonstration, relative to the largest valid step."""
OBSERVED = "observed/"
"""Prefix of observed features in files."""


class Contents(TypedDict):
    """Attributes of :class:`Demonstrations` that a format has read; shapes and values are not validated yet."""

    states: Tensor
    lengths: Tensor
    domain: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    concepts: tuple[str, ...]
    observed: Observed
    per_step: tuple[str, ...]
    scenes: Tensor | None
    provenance: Mapping[str, Any]
    state_kinds: tuple[str, ...]
    actions: Tensor | None
    action_names: tuple[str, ...]


@dataclass(frozen=True)
class Format:
    """Format of demonstrations. A module of :mod:`ftl_lightning.data.formats` registers each in :data:`FORMATS`.

    Attributes:
        read: reads a file, or a data set by its folder or name.
        write: writes demonstrations under a name, atomically; ``None`` for a format that is only read.
    """

    read: Callable[[str], Contents]
    write: Callable[["Demonstrations", str], None] | None = None


MOST_COLUMNS = 10_000
"""Maximum number of columns of states in a file."""
MOST_DEMONSTRATIONS, MOST_CONCEPTS = 200_000, 20_000
"""Maximum numbers of demonstrations and of concepts in a file."""
FOREIGN = (".pkl", ".pickle", ".joblib", ".xlsx", ".xls", ".feather", ".zarr", ".bag", ".mcap", ".tfrecord", ".txt", ".gz", ".zip")
"""Suffixes of files that are not read."""
FORMATS: dict[str, Format] = {}
"""Formats by the suffix of a file, or by the kind of a data set."""


def read_contents(path: str | Path) -> Contents:
    """Read attributes of demonstrations from a ``path`` as in :meth:`Demonstrations.load`, without validating them."""
    kind, name = read_from(str(path))
    require(kind != "folder", name, "a file of demonstrations", "a folder; only fit reads folders of files")
    contents = _format(kind, name).read(name)
    foreign = next((text for text in contents["state_kinds"] if (text.split() or [KINDS[0]])[0] not in KINDS), "")
    require(not foreign, f"{name}: key 'state_kinds'", f"one of {', '.join(KINDS)}", repr(short(foreign)))
    states, lengths = contents["states"], contents["lengths"]
    columns = states.shape[2] if states.dim() == 3 else 0
    require(columns <= MOST_COLUMNS, f"{name}: key 'states'", f"at most {MOST_COLUMNS} columns", columns)
    count = len(states) if states.dim() else 0
    require(count <= MOST_DEMONSTRATIONS, f"{name}: key 'states'", f"at most {MOST_DEMONSTRATIONS} demonstrations", count)
    count = len(set(contents["concepts"]))
    require(count <= MOST_CONCEPTS, f"{name}: key 'concepts'", f"at most {MOST_CONCEPTS} different texts", count)
    whole = lengths.dtype == torch.int64 and lengths.shape == states.shape[:1]
    if states.dim() == 3 and whole and bool(((lengths >= 1) & (lengths <= states.shape[1])).all()):
        contents["states"] = held(states, lengths)
        features = {name: held(contents["observed"][name], lengths) for name in contents["per_step"] if _timed(contents, name)}
        contents["observed"] = {**contents["observed"], **features}
    return contents


def _timed(contents: Contents, name: str) -> bool:
    """Whether a feature has a value at each time."""
    values = contents["observed"].get(name)
    return values is not None and values.dim() > 2 and values.shape[:2] == contents["states"].shape[:2]


def _format(kind: str, name: str) -> Format:
    """Format of a resolved name; files of unknown suffixes are safetensors."""
    suffix = Path(name).suffix.lower() if kind == "file" else kind
    known = ", ".join(suffix for suffix in FORMATS if suffix.startswith("."))
    advice = f'{suffix}; convert it in Python: np.savez("file.npz", states=states, concepts=texts)'
    require(suffix not in FOREIGN, name, f"a file of {known}", advice)
    return FORMATS.get(suffix, FORMATS[".safetensors"])


def writer(path: str | Path) -> tuple[Callable[["Demonstrations", str], None], str]:
    """Function that writes demonstrations to a path, and the name to call it with; ``UserError`` for a format that is only read."""
    kind, name = written_to(str(path))
    if (write := _format(kind, name).write) is None:
        raise UserError(f"{name}: expected the name of an .npz or .safetensors file, found a format that is only read")
    return write, name


@dataclass(frozen=True, repr=False)
class Demonstrations(Shown):
    """Demonstrations of tasks, in the domain's units.

    Attributes:
        states: ``(demo, time, state)`` float32, or float64 where float32 cannot hold the steps of a column.
            Padded beyond each demonstration's length.
        lengths: ``(demo,)`` int64, between 1 and ``time``.
        domain: name of the domain; empty if unknown.
        state_names, state_units: an entry for each column of ``states``.
        state_kinds: kind of each column, see :mod:`ftl_lightning.data.kinds`; empty if all are linear or unknown.
        concepts: a text for each demonstration; empty if unknown.
        observed: observed features by name. Features in ``per_step`` are ``(demo, time, *shape)``, conditions of a plan that starts
            at that time. Other features are ``(demo, *shape)``, known only at the first time. Vectors are float32, images uint8.
        per_step: names of the features that are known at every time.
        scenes: ``(demo, scene)`` float32, which reset the environment to each demonstration's initial state and serve a judge,
            never a model; ``None`` if there are none.
        provenance: origin of the demonstrations (generator, seed, ...), anything JSON can hold.
        actions: ``(demo, time, action)`` float32, what was done in the state of the same time; ``None`` if unknown. Padded.
        action_names: an entry for each action; empty for numbers.

    Raises:
        UserError: at construction, for other shapes or values.
    """

    states: Tensor
    lengths: Tensor
    domain: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    concepts: tuple[str, ...]
    observed: Observed = field(default_factory=dict)
    per_step: tuple[str, ...] = ()
    scenes: Tensor | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    state_kinds: tuple[str, ...] = ()
    actions: Tensor | None = None
    action_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        size = tuple(self.states.shape)
        typed = len(size) == 3 and self.states.dtype in (torch.float32, torch.float64)
        require(typed, "key 'states'", "float32 of shape (demo, time, state)", f"{self.states.dtype} {size}")
        require(min(size) > 0, "key 'states'", "at least one demonstration, time and column", f"none in {size}")
        count, time, state = size
        require(self.lengths.dtype == torch.int64, "key 'lengths'", "whole numbers (int64)", str(self.lengths.dtype))
        lengths = self.lengths.flatten().tolist()
        within = self.lengths.shape == (count,) and all(1 <= length <= time for length in lengths)
        require(within, "key 'lengths'", f"{count} values between 1 and {time}", lengths[:20])
        for key, texts, expected in (("state_names", self.state_names, state), ("state_units", self.state_units, state)):
            require(len(texts) == expected, f"key {key!r}", f"{expected} entries", len(texts))
        kinds = len(self.state_kinds)
        require(kinds in (0, state), "key 'state_kinds'", f"{state} entries", kinds)
        require(len(self.concepts) == count, "key 'concepts'", f"{count} entries", len(self.concepts))
        unknown = short(", ".join(sorted(set(self.per_step) - set(self.observed))))
        require(not unknown, "key 'per_step'", "names of observed features", unknown)
        for name, values in self.observed.items():
            leading, shape = (count, time) if name in self.per_step else (count,), tuple(values.shape)
            fits = shape[: len(leading)] == leading and len(shape) > len(leading)
            require(fits, f"key 'observed/{name}'", f"shape ({', '.join(map(str, leading))}, ...)", str(shape))
            dtype = str(values.dtype).removeprefix("torch.")
            require(dtype in ("float32", "uint8"), f"key 'observed/{name}'", "float32, or uint8 for images", dtype)
        if self.scenes is not None:
            shape = tuple(self.scenes.shape)
            require(len(shape) == 2 and shape[0] == count, "key 'scenes'", f"shape ({count}, scene)", str(shape))
            require(self.scenes.dtype == torch.float32, "key 'scenes'", "float32", str(self.scenes.dtype))
        if self.actions is not None:
            shape, wanted = tuple(self.actions.shape), f"float32 of shape ({count}, {time}, action), or a time less"
            fits = self.actions.dtype == torch.float32 and len(shape) == 3 and shape[:2] == (count, time) and shape[2] > 0
            require(fits, "key 'actions'", wanted, f"{self.actions.dtype} {shape}")
            names = len(self.action_names)
            require(names in (0, shape[2]), "key 'action_names'", f"{shape[2]} entries", names)
        for key, tensor in self.tensors.items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                where = (~torch.isfinite(tensor)).nonzero()[0].tolist()
                advice = "; pad with any number and give 'lengths'" if key == "states" else ""
                found = f"found {tensor[tuple(where)].item()} at index {where}"
                raise UserError(f"key {key!r}: expected finite numbers, {found}{advice}")

    @classmethod
    def of(
        cls, states: Sequence[Any], concepts: str | Sequence[str] = "", actions: Sequence[Any] | None = None, **attributes: Any
    ) -> Self:
        """Demonstrations of any lengths from a list of arrays: ``Demonstrations.of(paths, "heart").save("five.npz")``.

        Args:
            states: an array ``(time, state)`` for each demonstration.
            concepts: a text for each demonstration, or a single text for all.
            actions: an array ``(time, action)`` or ``(time - 1, action)`` for each demonstration; ``None`` if unknown.
            attributes: further attributes of the class; ``observed`` may hold arrays, too.

        Raises:
            UserError: for arrays of other shapes, or other attributes that do not fit.
        """
        require(not any(map(np.ma.is_masked, states)), "states", "every value", "masked values; fill them or leave their times out")
        whole, lengths = stacked(states)
        columns, count = whole.shape[2], len(whole)
        unnamed = {"domain": "", "state_names": tuple(map(str, range(columns))), "state_units": ("",) * columns}
        texts = (concepts,) * count if isinstance(concepts, str) else tuple(concepts)
        numbers = torch.from_numpy(precise(whole.numpy()))
        if "observed" in attributes:
            attributes["observed"] = {name: _feature(name, values) for name, values in attributes["observed"].items()}
        if actions is not None:
            attributes = {**attributes, "actions": held_actions(_stacked_actions(actions), lengths, whole.shape[1])}
        return cls(**{"states": numbers, "lengths": lengths, "concepts": texts, **unnamed, **attributes})

    def __len__(self) -> int:
        return len(self.states)

    def _words(self) -> Iterator[str]:
        if self.domain:
            yield repr(self.domain)
        yield f"states {tuple(self.states.shape)}"
        shortest, longest = int(self.lengths.min()), int(self.lengths.max())
        if shortest < self.states.shape[1]:
            yield f"lengths {shortest} to {longest}"
        if any(self.concepts):
            yield repr(self.concepts[0]) if len(set(self.concepts)) == 1 else counted(len(set(self.concepts)), "concept")
        for name, values in self.observed.items():
            yield f"{name} {tuple(values.shape)}"
        if self.scenes is not None:
            yield f"scenes {tuple(self.scenes.shape)}"

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors, by their keys in a file."""
        scenes = {} if self.scenes is None else {"scenes": self.scenes}
        features = {OBSERVED + name: values for name, values in self.observed.items()}
        actions = {} if self.actions is None else {"actions": self.actions}
        return {"states": self.states, "lengths": self.lengths} | features | scenes | actions

    @property
    def features(self) -> dict[str, Feature]:
        """Shape and kind of each observed feature."""
        return {name: Feature.of(values, leading=2 if name in self.per_step else 1) for name, values in self.observed.items()}

    @property
    def rows_of(self) -> dict[str, list[int]]:
        """Numbers of the demonstrations of each concept, in order of first appearance."""
        rows: dict[str, list[int]] = {}
        for row, text in enumerate(self.concepts):
            rows.setdefault(text, []).append(row)
        return rows

    @property
    def joined(self) -> Self:
        """Demonstrations whose actions, if there are any, are the last columns of the states."""
        if self.actions is None:
            return self
        size = self.actions.shape[2]
        return replace(
            self,
            states=torch.cat((self.states, self.actions.to(self.states.dtype)), dim=2),
            state_names=(*self.state_names, *named_actions(self.action_names or tuple(map(str, range(size))))),
            state_units=(*self.state_units, *("",) * size),
            state_kinds=(*self.state_kinds, *(KINDS[0],) * size) if self.state_kinds else (),
            actions=None,
            action_names=(),
        )

    @property
    def at_start(self) -> Self:
        """Demonstrations whose observed features are known only at the first time."""
        return replace(self, observed=self.initial_states.observed, per_step=())

    def columns(self, chosen: Sequence[int]) -> Self:
        """Select columns of the states by their numbers from 0 (``chosen``), in this order."""
        return replace(
            self,
            states=self.states[..., list(chosen)],
            state_names=tuple(self.state_names[column] for column in chosen),
            state_units=tuple(self.state_units[column] for column in chosen),
            state_kinds=tuple(self.state_kinds[column] for column in chosen) if self.state_kinds else (),
        )

    def select(self, concept: str) -> Self:
        """Select the demonstrations of a concept."""
        return self.rows([index for index, text in enumerate(self.concepts) if text == concept])

    def rows(self, chosen: Sequence[int]) -> Self:
        """Select demonstrations by their numbers from 0 (``chosen``)."""
        return replace(
            self,
            states=self.states[chosen],
            lengths=self.lengths[chosen],
            concepts=tuple(self.concepts[row] for row in chosen),
            observed=take(self.observed, chosen),
            scenes=None if self.scenes is None else self.scenes[chosen],
            actions=None if self.actions is None else self.actions[chosen],
        )

    def starts(self, rows: Tensor, share: Tensor, exponent: float, horizon: int, at_rest: bool = True) -> Tensor:
        """Start times of windows ``(window,)`` int64.

        If all features are observed at every time, a plan can start at any time. If a feature is known only at the first time, all
        windows start at 0. Without observed features, a plan has no information on its time in a behaviour: windows stay within
        a demonstration, and a window of its full length starts at 0.

        Args:
            rows: ``(window,)`` int64, demonstration of each window.
            share: ``(window,)``, evenly spread over [0, 1).
            exponent: u of ``start = length * share^u``; 1 is uniform, with 3 half of the windows start in the first eighth.
            horizon: length of the windows.
            at_rest: whether windows may reach past the end; otherwise they stay within demonstrations that are long enough.
        """
        if set(self.observed) - set(self.per_step):
            return torch.zeros_like(rows)
        past = bool(self.observed) and at_rest
        room = self.lengths[rows] if past else (self.lengths[rows] - horizon + 1).clamp(min=1)
        return (share**exponent * room).long()

    def windows(self, rows: Tensor, starts: Tensor, horizon: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Windows of demonstrations, padded with the last state.

        Args:
            rows: ``(window,)`` int64, demonstration of each window.
            starts: ``(window,)`` int64, first time of each window.
            horizon: length of the windows.

        Returns:
            States ``(window, horizon, state)`` and features observed at each start, by name ``(window, *shape)``.
        """
        times = (starts[:, None] + torch.arange(horizon)).clamp(max=self.states.shape[1] - 1)
        return self.states[rows[:, None], times], self._observed_at(rows, starts)

    def _observed_at(self, rows: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Features observed at times ``(sample,)`` of demonstrations ``(sample,)``."""
        return {name: values[rows, times] if name in self.per_step else values[rows] for name, values in self.observed.items()}

    @property
    def initial_states(self) -> InitialStates:
        """Initial state of each demonstration."""
        first = {name: values[:, 0] if name in self.per_step else values for name, values in self.observed.items()}
        return InitialStates(first, self.scenes)

    @property
    def final_states(self) -> InitialStates:
        """Final states as initial states of behaviour that continues; features known only at the start are unchanged."""
        return InitialStates(self._observed_at(torch.arange(len(self)), self.lengths - 1), self.scenes)

    @property
    def every_observation(self) -> dict[str, Tensor]:
        """Observed features at all times of all demonstrations, by name ``(observation, *shape)``."""
        return {name: values.flatten(0, 1) if name in self.per_step else values for name, values in self.observed.items()}

    def named(self, concept: str) -> Self:
        """Give demonstrations without a text the name ``concept``."""
        return replace(self, concepts=tuple(text or concept for text in self.concepts))

    @property
    def hash(self) -> str:
        """16-digit hash of states, lengths, observed features and scenes, independent of the file format."""
        return bytes_hash(serialise(KIND, self.tensors, {}))

    def save(self, path: str | Path) -> None:
        """Write the demonstrations atomically.

        Args:
            path: a safetensors file, with compressed images (zlib); an ``.npz`` file, by its suffix; ``'minari:NAME'`` for a Minari
                data set; or ``'lerobot:FOLDER'`` for a LeRobot data set. Padding is dropped, in ``.npz`` also provenance.

        Raises:
            UserError: naming the path, if it cannot be written or needs an extra that is not installed.
        """
        write, name = writer(path)
        write(self, name)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read demonstrations from :meth:`save` or another program: a safetensors file, an ``.npz`` file without objects, a Minari
        data set by its name, or the folder of a LeRobot data set.

        An ``.npz`` file needs ``states`` ``(demo, time, state)``. Optional are ``concepts`` (texts, or a single text for all),
        ``lengths`` (default: full), ``state_names``, ``state_units``, ``domain``, ``scenes``, and observed features as
        ``observed/NAME``. Names listed in ``per_step`` are observed at every time.

        Args:
            path: path of the file or folder, or name of the data set.

        Raises:
            UserError: naming the file, if it is missing, damaged, of another kind, or its content is not as described.
        """
        contents = read_contents(path)
        with about(path):
            return cls(**contents)

    def fitted(self, features: Mapping[str, Feature]) -> Self:
        """Return the demonstrations if their observed features are a domain's, ``features`` by name.

        Raises:
            UserError: for a feature that is missing or has another type or shape.
        """
        for name, feature in features.items():
            given = self.features.get(name)
            message = "none" if given is None else given.words
            if given is not None and given.shape[1:] == feature.shape and name not in self.per_step:
                message += " (observed at every time? then list it in per_step)"
            require(given is not None and given.fits(feature), f"key 'observed/{name}'", f"{feature.words} each", message)
        return self


def paths_of(demonstrations: Demonstrations) -> list[Tensor]:
    """States ``(time, state)`` of each of the ``demonstrations``, without padding."""
    return [states[:length] for states, length in zip(demonstrations.states, demonstrations.lengths.tolist(), strict=True)]


def in_sequence(demonstrations: Demonstrations) -> Paths:
    """States of all ``demonstrations`` as in :func:`paths_of`, in a single tensor."""
    valid = torch.arange(demonstrations.states.shape[1]) < demonstrations.lengths[:, None]
    return Paths(demonstrations.states[valid], demonstrations.lengths)


def held(values: Tensor, lengths: Tensor, continues: float = CONTINUES) -> Tensor:
    """Values ``(demo, time, ...)`` with the last valid one in the padding, of demonstrations whose padding does not continue them.

    Padding continues a demonstration if it is finite, and no step into it or in it is larger than ``continues`` times the
    largest valid step of its column, as where vehicles drive on.

    Args:
        values: ``(demo, time, ...)``.
        lengths: ``(demo,)``, number of valid times.
        continues: see above; 0 replaces all padding that is not constant.
    """
    times = torch.arange(values.shape[1])
    if not values.is_floating_point() or bool((lengths == len(times)).all()):
        return values
    flat = values.flatten(2)
    steps, valid = flat.diff(dim=1).abs(), (times[1:] < lengths[:, None])[..., None]
    largest = torch.where(valid, steps, 0).amax(dim=1, keepdim=True)
    jumps = ((steps > continues * largest) | ~flat[:, 1:].isfinite()) & ~valid
    rows = jumps.flatten(1).any(dim=1).nonzero()[:, 0]
    if not len(rows):
        return values
    whole = values.clone()
    whole[rows] = values[rows[:, None], torch.minimum(times, lengths[rows, None] - 1)]
    return whole


def concatenate(parts: Sequence[Demonstrations]) -> Demonstrations:
    """Concatenate demonstrations of a domain, padded to the longest, with the provenance of the first part.

    A feature is observed at every time, and there are scenes and actions, only if this holds for all parts.
    """
    first, longest = parts[0], max(part.states.shape[1] for part in parts)
    per_step = tuple(name for name in first.per_step if all(name in part.per_step for part in parts))
    scenes = [part.scenes for part in parts if part.scenes is not None]
    actions = [_padded(part.actions, longest) for part in parts if part.actions is not None]

    def observed(part: Demonstrations, name: str) -> Tensor:
        return _padded(part.observed[name], longest) if name in per_step else part.initial_states.observed[name]

    return replace(
        first,
        states=torch.cat([_padded(part.states, longest) for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        concepts=tuple(text for part in parts for text in part.concepts),
        observed={name: torch.cat([observed(part, name) for part in parts]) for name in first.observed},
        per_step=per_step,
        scenes=torch.cat(scenes) if len(scenes) == len(parts) else None,
        actions=torch.cat(actions) if len(actions) == len(parts) else None,
        action_names=first.action_names if len(actions) == len(parts) else (),
    )


def padded(behaviours: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Pad ``behaviours`` ``(time, ...)`` of different lengths with their last time.

    Returns:
        ``(demo, longest time, ...)``, and lengths ``(demo,)`` int64.
    """
    lengths = torch.tensor([len(behaviour) for behaviour in behaviours])
    longest = int(lengths.max())
    return torch.cat([_padded(behaviour[None], longest) for behaviour in behaviours]), lengths


def _feature(name: str, values: Any) -> Tensor:
    """Tensor of an observed feature; numbers that are not uint8 in float32."""
    try:
        tensor = torch.as_tensor(values if isinstance(values, Tensor) else np.asarray(values))
    except (TypeError, ValueError):
        raise UserError(f"observed {name!r}: expected an array of numbers, found {shown(values)}") from None
    return tensor if tensor.dtype == torch.uint8 else tensor.float()


def _stacked_actions(actions: Any) -> Tensor:
    """Actions ``(demo, time, action)`` of arrays ``(time, action)``, or ``(time,)`` of single numbers."""
    return stacked([array[:, None] if np.ndim(array) == 1 else array for array in map(np.asarray, actions)])[0].float()


def stacked(states: Sequence[Any]) -> tuple[Tensor, Tensor]:
    """Pad ``states``, arrays ``(time, state)`` of different lengths, of NumPy or torch, with their last time.

    Returns:
        ``(demo, longest time, state)`` float64, and lengths ``(demo,)`` int64.

    Raises:
        UserError: for arrays of other shapes or types.
    """
    require(0 < len(states) <= MOST_TENSORS, "states", f"1 to {MOST_TENSORS} arrays (time, state)", str(len(states)))
    arrays: list[NDArray[np.float64]] = []
    for index, path in enumerate(states):
        try:
            array = np.asarray(_plain(path) if isinstance(path, Tensor) else path)
            found = "other values" if array.dtype.kind == "O" else str(array.dtype)
            require(array.dtype.kind in "fiub", f"states[{index}]", "numbers (time, state)", found)
            check_whole(f"states[{index}]", array)
        except (ValueError, TypeError, RuntimeError) as error:
            raise UserError(f"states[{index}]: expected numbers (time, state), found others ({short(str(error))})") from error
        columns = f"{arrays[0].shape[1]} columns" if arrays else "columns"
        fits = array.ndim == 2 and array.size and (not arrays or array.shape[1] == arrays[0].shape[1])
        require(fits, f"states[{index}]", f"an array (time, state) with {columns}", f"the shape {array.shape}")
        arrays.append(array.astype(np.float64))
    lengths = np.array([len(array) for array in arrays])
    return torch.from_numpy(gathered(np.concatenate(arrays), lengths)), torch.from_numpy(lengths)


def _plain(tensor: Tensor) -> Tensor:
    """A tensor on the CPU, of a type that NumPy has."""
    return tensor.detach().cpu().float() if tensor.dtype == torch.bfloat16 else tensor.detach().cpu()


def gathered(rows: NDArray[np.float64], lengths: NDArray[np.int64]) -> NDArray[np.float64]:
    """Demonstrations ``(demo, longest time, state)`` of ``lengths`` ``(demo,)`` from all ``rows`` ``(row, state)``, in order.

    Raises:
        UserError: if padding is far more than the rows.
    """
    size, most = len(lengths) * int(lengths.max()) * rows.shape[1] * 8, raised(max(MOST_UNPACKED, MOST_RATIO * rows.nbytes))
    expected = f"padding to the longest, {lengths.max()}, within {most} bytes"
    require(size <= most, "lengths", expected, f"{size} bytes; cut long demonstrations or leave out short ones")
    if (lengths == lengths[0]).all():
        return rows.reshape(len(lengths), lengths[0], -1)
    times = np.minimum(np.arange(lengths.max()), lengths[:, None] - 1)
    return rows[(np.cumsum(lengths) - lengths)[:, None] + times]


def _padded(values: Tensor, time: int) -> Tensor:
    """Pad ``(demo, time, ...)`` with its last time."""
    last = values[:, -1:].expand(-1, time - values.shape[1], *(-1,) * (values.dim() - 2))
    return torch.cat((values, last), dim=1)
