"""Check contents of files and configurations against the annotations of the objects built from them: types and ranges."""

import collections
import collections.abc
import dataclasses
import functools
import inspect
import json
import math
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.limits import MOST_TEXT, check_readable
from ftl_lightning.services.ranges import LARGEST

FLOAT32 = 3.4e38
"""Maximum magnitude of a float."""
DEEPEST = 40
"""Maximum nesting of lists and mappings."""
_WORDS: Mapping[object, str] = {str: "a text", bool: "true or false", float: "a finite number (float32)"}
_LISTS = (tuple, list, collections.abc.Sequence)

T = TypeVar("T")


def read_json(path: Path, kind: str = "JSON") -> Any:
    """Read a JSON file.

    Raises:
        UserError: naming the file, as :func:`parse_json`; also if it is missing, too long, a device or a pipe.
        OSError: if it cannot be read.
    """
    check_readable(path, kind.removeprefix("a ").removesuffix(" file"), MOST_TEXT)
    with about(path):
        return parse_json(path.read_bytes(), kind)


def parse_json(text: str | bytes, kind: str = "JSON") -> Any:
    """Parse a JSON text.

    Args:
        text: the text.
        kind: expected kind, for messages.

    Raises:
        UserError: for damaged text, repeated keys, numbers that are not finite, invalid Unicode, or nesting deeper than
            :data:`DEEPEST`.
    """
    try:
        content = json.loads(text.decode() if isinstance(text, bytes) else text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise UserError(f"expected {kind}, found damaged text or too deep a nesting ({short(str(error))})") from error
    _expect_plain(content, DEEPEST)
    return content


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
        for item in (*value, *value.values()) if isinstance(value, dict) else value:
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
        raise UserError(f"{_named(key)}: expected a mapping, found {shown(content)}")
    for name in content:
        if name not in names:
            raise UserError(f"{_named(_joined(key, name))}: expected one of {short(', '.join(names), 120)}, found another key")
    for name in names:
        if name in needed and name not in content:
            raise UserError(f"{_named(_joined(key, name))}: expected a value, found none")
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
    if origin is Literal:
        if not any(type(value) is type(option) and value == option for option in arguments):
            raise _mistake(key, f"one of {', '.join(map(repr, arguments))}", value)
    elif origin in (dict, collections.abc.Mapping):
        if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
            raise _mistake(key, "a mapping", value)
        return {name: check_type(item, arguments[1], _joined(key, name)) for name, item in value.items()}
    elif origin in _LISTS:
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise _mistake(key, "a list", value)
        every = (check_type(item, arguments[0], f"{key}[{index}]") for index, item in enumerate(value))
        return tuple(every) if origin is tuple else list(every)
    elif kind is int:
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= LARGEST:
            raise _mistake(key, f"a whole number from 0 to {LARGEST}", value)
    elif kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= FLOAT32:
            raise _mistake(key, _WORDS[kind], value)
    elif kind in _WORDS and type(value) is not kind:
        raise _mistake(key, _WORDS[kind], value)
    return value


def _joined(key: str, name: object) -> str:
    return f"{key}.{short(str(name))}" if key else short(str(name))


def _named(key: str) -> str:
    return f"key {key!r}" if key else "content"


def _mistake(key: str, expected: str, value: object) -> UserError:
    return UserError(f"{_named(key)}: expected {expected}, found {shown(value)}")
