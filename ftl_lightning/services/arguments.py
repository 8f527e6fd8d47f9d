"""Validation of arguments of the Python API: whole numbers, texts, devices, and settings by name."""

import difflib
import os
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch

from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.option_groups import groups_of, replaced
from ftl_lightning.services.ranges import LARGEST, check_count, check_range

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)
else:
    T = TypeVar("T")

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
    """Check and return a whole number.

    Args:
        key: name of the argument.
        value: value of the argument.
        least: minimum.
        most: maximum; ``None`` for any.

    Raises:
        UserError: for anything else, ``True`` included.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise UserError(f"{key}: expected a whole number, {least} or more, found {shown(value)}")
    if most is None:
        check_range(key, int(value), least)
    else:
        check_count(key, int(value), least, most)
    return int(value)


def check_text(key: str, value: object, example: str) -> None:
    """Refuse a value that is not a text.

    Raises:
        UserError: with an example.
    """
    if not isinstance(value, str):
        raise UserError(f"{key}: expected a text, such as {shown(example, 40)}, found {shown(value)}")


def check_path(key: str, value: object, what: str) -> None:
    """Refuse a value that is not a path.

    Raises:
        UserError: with the expected kind of path.
    """
    if not isinstance(value, str | os.PathLike):
        raise UserError(f"{key}: expected {what}, found {shown(value)}")


def changed(
    call: str, settings: T, changes: Mapping[str, Any], beside: Sequence[str], places: Mapping[str, str] = MappingProxyType({})
) -> T:
    """Copy of settings with changes.

    Args:
        call: name of the called method, such as ``'sample'``.
        settings: current settings.
        changes: changed settings by name.
        beside: other arguments of the method.
        places: grouped options ``'group.option'`` by flat name.

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
    # NumPy's numbers are allowed.
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in changes.items()}
    hints = get_type_hints(type(settings))
    of_groups = {group: get_type_hints(hints[group]) for group in groups}
    for name, place in places.items():
        group, _, option = place.partition(".")
        hints[name] = of_groups[group][option]
    for name, value in plain.items():
        kinds = _kinds(hints[name])
        if not any(_is(value, kind) for kind in kinds):
            expected = [_WORDS[kind] if kind in _WORDS else repr(kind) for kind in kinds]
            raise UserError(f"{call}: {name}: expected {' or '.join(expected)}, found {shown(value)}")
    return replaced(settings, plain, places)


_WORDS: Mapping[object, str] = {int: "a whole number", float: "a number", str: "a text", bool: "True or False", type(None): "None"}


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


def device_named(name: object) -> torch.device:
    """Check and return a device of this machine.

    Raises:
        UserError: for an unavailable device, with the available devices; for a failing device, with its error.
    """
    message = f"device: expected one that this machine has, {' or '.join(_devices())}, found {shown(name)}"
    if not isinstance(name, str | torch.device):
        raise UserError(message)
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(message) from error
    try:
        torch.ones(1, device=device).cpu()  # a valid name may be unavailable
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # kinds of unavailability
        # An available device may be out of memory or broken.
        if str(device) in _devices() or (device.type == "cuda" and device.index is None and torch.cuda.is_available()):
            reason = short(next(iter(str(error).splitlines()), "") or type(error).__name__)
            raise UserError(f"device: expected {device} to compute, found that it cannot: {reason}") from error
        raise UserError(message) from error
    return device


def _devices() -> list[str]:
    cuda = [f"cuda:{number}" for number in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    return ["cpu", *cuda, *(["mps"] if torch.backends.mps.is_available() else [])]
