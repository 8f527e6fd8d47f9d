"""Check values against type annotations and ranges: options, arguments of the Python API, contents of files."""

import codecs
import collections
import collections.abc
import dataclasses
import difflib
import functools
import inspect
import json
import math
import numbers
import os
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ftl_lightning.services.errors import UserError, about, require, short, shown
from ftl_lightning.services.files import MOST_TEXT, check_readable

if TYPE_CHECKING:
    import torch
    from _typeshed import DataclassInstance

    S = TypeVar("S", bound=DataclassInstance)
else:
    S = TypeVar("S")


LARGEST = 1_000_000
"""Maximum of a user-given size or count."""
MOST_TOGETHER = 100_000
"""Maximum size of a batch, or number of runs learned together."""
LARGEST_STEP = 10**9
"""Maximum number of steps of a run."""
LARGEST_RATE = 1e30
"""Maximum learning rate, near the limit of float32."""
LARGEST_FACTOR = 1e6
"""Maximum of weights, temperatures and powers; larger values exhaust the precision of float32."""


def check_range(key: str, value: float, least: float = -math.inf, most: float = math.inf) -> None:
    """Refuse a number that is not finite or not from ``least`` to ``most``.

    Raises:
        UserError: with key, range and value.
    """
    if math.isinf(most):
        expected = "a finite number" if math.isinf(least) else f"{least:g} or more"
    else:
        expected = f"a number from {least:g} to {most:g}"
    require(-math.inf < value < math.inf and least <= value <= most, key, expected, value)


def check_count(key: str, value: int, least: int, most: int = LARGEST) -> None:
    """Check a count; report the upper bound only when it is exceeded."""
    check_range(key, value, least)
    check_range(key, value, least, most)


def check_factor(key: str, value: float, least: float = -LARGEST_FACTOR, most: float = LARGEST_FACTOR) -> None:
    """Check a weight, a temperature or another factor."""
    check_range(key, value, -math.inf if least == -LARGEST_FACTOR else least)
    check_range(key, value, least, most)


FLOAT32 = 3.4e38
"""Maximum magnitude of a float."""
DEEPEST = 40
"""Maximum nesting of lists and mappings."""
MOST_LISTS, MOST_VALUES = 300_000, 4_000_000
"""Maximum number of lists, mappings or keys, and of values, of a JSON text: each takes a hundred times its bytes in memory."""
_LISTS = (tuple, list, collections.abc.Sequence)

T = TypeVar("T")


def read_json(path: Path, kind: str = "JSON") -> Any:
    """Read a JSON file; errors as :func:`parse_json` and :func:`~ftl_lightning.services.files.check_readable`."""
    check_readable(path, kind.removeprefix("a ").removesuffix(" file"), MOST_TEXT)
    with about(path):
        return parse_json(path.read_bytes().removeprefix(codecs.BOM_UTF8), kind)


def parse_json(text: str | bytes, kind: str = "JSON") -> Any:
    """Parse a JSON text; ``kind`` is the expected kind, for messages.

    Raises:
        UserError: for damaged text, repeated keys, numbers that are not finite, invalid Unicode, nesting deeper than
            :data:`DEEPEST`, more lists than :data:`MOST_LISTS`, or more values than :data:`MOST_VALUES`.
    """
    check_json_size(text, kind)
    try:
        content = json.loads(text.decode() if isinstance(text, bytes) else text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise UserError(f"expected {kind}, found damaged text or too deep a nesting ({short(str(error))})") from error
    _expect_plain(content, DEEPEST)
    return content


def check_json_size(text: str | bytes, kind: str) -> None:
    """Refuse a JSON text of more than :data:`MOST_LISTS` lists, mappings or keys, or :data:`MOST_VALUES` values.

    Raises:
        UserError: naming the expected ``kind`` and the number.
    """
    for marks, most, what in (("[{", MOST_LISTS, "lists and mappings"), (":", MOST_LISTS, "keys"), (",", MOST_VALUES, "values")):
        count = 0  # marks in texts are too few to matter
        for mark in marks:
            count += text.count(mark.encode()) if isinstance(text, bytes) else text.count(mark)
        require(count <= most, "content", f"{kind} of at most {most} {what}", str(count))


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        ((twice, _),) = collections.Counter(key for key, _ in pairs).most_common(1)
        raise UserError(f"key {short(twice)!r}: expected it once, found it several times")
    return mapping


def _expect_plain(value: object, left: int) -> None:
    """Refuse JSON that other programs cannot read."""
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise UserError(f"expected texts of Unicode characters, found half of one in {short(ascii(value))}") from error
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"expected finite numbers, found {value}")
    elif isinstance(value, dict | list):
        if not left:
            raise UserError(f"expected lists and mappings at most {DEEPEST} deep, found deeper ones")
        items = (*value, *value.values()) if isinstance(value, dict) else value
        kinds = set(map(type, items))
        if kinds <= {int, bool, type(None)} or (kinds == {float} and all(map(math.isfinite, items))):  # fast for numbers
            return
        for item in ("".join(items),) if kinds == {str} else items:
            _expect_plain(item, left - 1)


def from_mapping(kind: Callable[..., T], content: object, key: str, *given: object) -> T:
    """Call a class with named arguments of a file or configuration, checked against its annotations.

    Whole numbers are from 0 to :data:`LARGEST`; the class checks narrower ranges.

    Args:
        kind: a dataclass, or a class with an annotated ``__init__``.
        content: arguments by name.
        key: location of the arguments, for messages; empty for the top.
        given: leading arguments, which no file names.

    Raises:
        UserError: naming the key of an argument that is missing, unknown or of another type.
    """
    hints, needed = _arguments(kind)
    names = list(hints)[len(given) :]
    if not isinstance(content, Mapping):
        raise UserError(f"{_place(key)}: expected a mapping, found {shown(content)}")
    for name in content:
        require(name in names, _place(_joined(key, name)), f"one of {short(', '.join(names), 120)}", "another key")
    for name in names:
        require(name in content or name not in needed, _place(_joined(key, name)), "a value", "none")
    return kind(*given, **{name: check_type(value, hints[name], _joined(key, name)) for name, value in content.items()})


@functools.cache
def _arguments(kind: Callable[..., Any]) -> tuple[dict[str, Any], frozenset[str]]:
    """Annotations of a class's arguments, and the names of required arguments."""
    hints = get_type_hints(kind if dataclasses.is_dataclass(kind) else kind.__init__)
    parameters = inspect.signature(kind).parameters
    needed = (name for name, parameter in parameters.items() if parameter.default is inspect.Parameter.empty)
    return {name: hints.get(name, Any) for name in parameters}, frozenset(needed)


def check_type(value: Any, kind: Any, key: str) -> Any:
    """Convert a value of JSON or YAML to its annotation: lists to tuples, mappings to dataclasses.

    Raises:
        UserError: naming the key, for a value of another type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return from_mapping(kind, value, key)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        for option in (option for option in arguments if option is not type(None)):
            try:
                return check_type(value, option, key)
            except UserError as error:
                mistake = error
        raise mistake
    valid, expected = True, ""
    if origin is Literal:
        valid = any(type(value) is type(option) and value == option for option in arguments)
        expected = f"one of {', '.join(map(repr, arguments))}"
    elif origin in (dict, collections.abc.Mapping):
        valid, expected = isinstance(value, Mapping) and all(isinstance(name, str) for name in value), "a mapping"
    elif origin in _LISTS:
        valid, expected = isinstance(value, Sequence) and not isinstance(value, str), "a list"
    elif kind is int:
        valid = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST
        expected = f"a whole number from 0 to {LARGEST}"
    elif kind is float:
        valid = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FLOAT32
        expected = "a finite number (float32)"
    elif kind in (str, bool):
        valid, expected = type(value) is kind, "a text" if kind is str else "true or false"
    if not valid:
        raise UserError(f"{_place(key)}: expected {expected}, found {shown(value)}")
    if origin in (dict, collections.abc.Mapping):
        return {name: check_type(item, arguments[1], _joined(key, name)) for name, item in value.items()}
    if origin in _LISTS:
        if set(map(type, value)) == {arguments[0]} <= {str, int} and (
            arguments[0] is str or 0 <= min(value) <= max(value) <= LARGEST
        ):
            return tuple(value) if origin is tuple else list(value)
        items = (check_type(item, arguments[0], f"{key}[{index}]") for index, item in enumerate(value))
        return tuple(items) if origin is tuple else list(items)
    return value


def _joined(key: str, name: object) -> str:
    return f"{key}.{short(str(name))}" if key else short(str(name))


def _place(key: str) -> str:
    return f"key {key!r}" if key else "content"


ELSEWHERE = {
    "num_inference_steps": "steps",
    "n_steps": "steps",
    "iterations": "steps",
    "epochs": "steps",
    "eta": "temperature",
    "scheduler": "sampler",
    "num_samples": "count",
    "n": "count",
    "starts": "observed",
    "batch": "batch_size",
    "generator": "seed",
    "lr": "learning_rate",
    "k": "components",
    "rank": "adapter",
}
"""Argument names of other libraries and their equivalents."""
MOST_NAMES = 8
"""Maximum number of settings listed in an error message."""


def check_whole(key: str, value: object, least: int, most: int | None = LARGEST) -> int:
    """Check and return a whole number from ``least`` to ``most``; ``None`` for no maximum.

    Raises:
        UserError: for anything else, ``True`` included.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):  # NumPy's integers are Integral
        raise UserError(f"{key}: expected a whole number, {least} or more, found {shown(value)}")
    if most is None:
        check_range(key, int(value), least)
    else:
        check_count(key, int(value), least, most)
    return int(value)


def check_text(key: str, value: object, example: str) -> None:
    """Refuse a value that is not a text by a :class:`UserError` with an example."""
    require(isinstance(value, str), key, f"a text, such as {shown(example, 40)}", shown(value))


def check_path(key: str, value: object, what: str) -> None:
    """Refuse a value that is not a path by a :class:`UserError` with the expected kind of path."""
    require(isinstance(value, str | os.PathLike), key, what, shown(value))


def groups_of(places: Mapping[str, str]) -> list[str]:
    """Unique names of the groups of options.

    Args:
        places: grouped options ``'group.option'`` by flat name, as in results, checkpoints and the Python API.
    """
    return list(dict.fromkeys(place.partition(".")[0] for place in places.values()))


def flat(groups: Mapping[str, object], places: Mapping[str, str]) -> dict[str, Any]:
    """Flatten groups by name to options by flat name; ``places`` as in :func:`groups_of`.

    Raises:
        UserError: for an object that is not a group.
    """
    options = {}
    for name, place in places.items():
        group, _, option = place.partition(".")
        if not hasattr(groups[group], option):
            raise UserError(f"model.{group}: expected a group of options with {option!r}, found {shown(groups[group])}")
        options[name] = getattr(groups[group], option)
    return options


def replaced(settings: S, options: Mapping[str, Any], places: Mapping[str, str]) -> S:
    """Copy of a dataclass of options and groups, with new options by flat name; ``places`` as in :func:`groups_of`."""
    changes = {name: value for name, value in options.items() if name not in places}
    in_groups: dict[str, dict[str, Any]] = {}
    for name in options.keys() & places.keys():
        group, _, option = places[name].partition(".")
        in_groups.setdefault(group, {})[option] = options[name]
    return replace(settings, **changes, **{group: replace(getattr(settings, group), **new) for group, new in in_groups.items()})


def changed(
    call: str, settings: S, changes: Mapping[str, Any], beside: Sequence[str], places: Mapping[str, str] = MappingProxyType({})
) -> S:
    """Copy of settings with changes.

    Args:
        call: name of the called method, such as ``'sample'``.
        settings: current settings.
        changes: changed settings by name.
        beside: other arguments of the method.
        places: see :func:`groups_of`.

    Raises:
        UserError: for an unknown name, with the known names, or a value of another type.
    """
    groups = groups_of(places)
    names = [*(field.name for field in fields(settings) if field.name not in (*beside, *groups)), *places]
    if unknown := [name for name in changes if name not in names]:
        expected = names if len(names) <= MOST_NAMES else [*names[:MOST_NAMES], "..."]
        raise UserError(
            f"{call}: expected {', '.join(expected)} (or {', '.join(beside)}), found {short(str(unknown[0]), 30)!r}"
            f"; model.tuned shows all settings{_meant(str(unknown[0]), (*names, *beside))}"
        )
    import numpy as np  # local: options are checked without it

    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in changes.items()}
    hints = get_type_hints(type(settings))
    of_groups = {group: get_type_hints(hints[group]) for group in groups}
    for name, place in places.items():
        group, _, option = place.partition(".")
        hints[name] = of_groups[group][option]
    for name, value in plain.items():
        kinds = _kinds(hints[name])
        if not any(_is(value, kind) for kind in kinds):
            expected = [_KINDS[kind] if kind in _KINDS else repr(kind) for kind in kinds]
            raise UserError(f"{call}: {name}: expected {' or '.join(expected)}, found {shown(value)}")
    return replaced(settings, plain, places)


_KINDS: Mapping[object, str] = {int: "a whole number", float: "a number", str: "a text", bool: "True or False", type(None): "None"}


def _kinds(hint: Any) -> list[Any]:
    """Allowed types and literal texts of an annotation."""
    parts = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return [kind for part in parts for kind in (get_args(part) if get_origin(part) is Literal else (part,))]


def _is(value: object, kind: Any) -> bool:
    """Whether a value has a type; for a literal, whether it is a text, whose choice the settings check."""
    if isinstance(kind, str):
        return isinstance(value, str)
    if kind in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, int | float if kind is float else kind)


def _meant(name: str, known: Sequence[str]) -> str:
    """Suggestion for an unknown name; empty without a similar name."""
    translated = ELSEWHERE.get(name.lower())
    near = [translated] if translated in known else difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def device_named(name: object) -> "torch.device":
    """Check and return a device of this machine.

    Raises:
        UserError: for an unavailable device, with the available devices; for a failing device, with its error.
    """
    import torch

    cuda = [f"cuda:{number}" for number in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    known = ["cpu", *cuda, *(["mps"] if torch.backends.mps.is_available() else [])]
    expected = f"one that this machine has, {' or '.join(known)}"
    if not isinstance(name, str | torch.device):
        raise UserError(f"device: expected {expected}, found {shown(name)}")
    try:
        device = torch.device(name)
        torch.ones(1, device=device).cpu()  # a valid name may be unavailable
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        # An available device may be out of memory or broken.
        if str(name) in known or (str(name) == "cuda" and torch.cuda.is_available()):
            reason = short(next(iter(str(error).splitlines()), "") or type(error).__name__)
            raise UserError(f"device: expected {name} to compute, found that it cannot: {reason}") from error
        raise UserError(f"device: expected {expected}, found {shown(name)}") from error
    return device
