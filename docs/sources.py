"""What a reference to a number comes to: rows of ``results``, files, constants of the code, the paper. See ``claims.py``."""

import importlib
import inspect
import json
import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

import pandas as pd
import yaml
from safetensors import safe_open

from ftl_lightning.apps.paper import measured
from ftl_lightning.domains.comparison import OURS, Compared
from ftl_lightning.domains.registry import domain_of_file
from ftl_lightning.evaluation.results import latest, read_rows
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.reporting.paired import mcnemar, up
from ftl_lightning.reporting.table import lookup, select
from ftl_lightning.reporting.tables import against
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError as SourceError

ROOT = Path(__file__).parent.parent
EVERY = "*"
"""In place of a column's value or of a key: each that there is."""
READERS: Mapping[str, Callable[[str], Any]] = {
    ".json": json.loads,
    ".yaml": yaml.safe_load,
    ".toml": tomllib.loads,
    ".py": str,
    ".ipynb": str,
    ".md": str,
}


def _same(numbers: list[float]) -> float:
    if len(set(numbers)) != 1:
        raise SourceError(f"expected the same number several times, found {numbers}")
    return numbers[0]


COMBINED: Mapping[str, Callable[[list[float]], float]] = {
    "mean": mean,
    "min": min,
    "max": max,
    "sum": sum,
    "difference": lambda values: values[0] - sum(values[1:]),
    "product": math.prod,
    "same": _same,
    "ratio": lambda values: values[0] / math.prod(values[1:]),
}
"""Numbers that are made of several."""

_table, _tuned = cache(read_rows), cache(ModelSettings.read)


def values(reference: Mapping[str, Any]) -> list[float]:
    """The numbers that a reference stands for, in order.

    Raises:
        SourceError: for a reference that comes to nothing.
    """
    kinds = [kind for kind in KINDS if kind in reference]
    if len(kinds) != 1:
        raise SourceError(f"expected one of {', '.join(KINDS)}, found {', '.join(map(str, reference))}")
    rest = {key: value for key, value in reference.items() if key != kinds[0]}
    try:
        found = list(KINDS[kinds[0]](reference[kinds[0]], rest))
    except (KeyError, IndexError, AttributeError, ImportError, OSError, TypeError, ZeroDivisionError) as error:
        raise SourceError(f"{type(error).__name__}: {error}") from error
    if not all(isinstance(value, int | float) for value in found):
        raise SourceError(f"expected numbers, found {found}")
    return found


def _rows(chosen: Mapping[str, Any], rest: Mapping[str, Any]) -> Iterator[float]:
    """``rows: {file, columns...}``; ``of`` another part of the number than its mean; ``against`` a policy from the same starts.

    A list of values in a column is a number for each, ``*`` one for each that these rows have.
    """
    wanted = dict(chosen)
    rows = _table(ROOT / "results" / wanted.pop("file"))
    for one in _each(rows, wanted):
        yield _number(rows, one, rest)


def _each(rows: pd.DataFrame, chosen: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Columns of one value each; lists go first, so that ``*`` is what the rows of this one of their values have."""
    several = [column for column, value in chosen.items() if isinstance(value, list)]
    column = next(iter(several or [column for column, value in chosen.items() if value == EVERY]), None)
    if column is None:
        yield chosen
        return
    alone = {name: value for name, value in chosen.items() if value != EVERY}
    for one in chosen[column] if several else dict.fromkeys(select(rows, **alone)[column]):
        yield from _each(rows, {**chosen, column: one})


def _number(rows: pd.DataFrame, chosen: Mapping[str, Any], rest: Mapping[str, Any]) -> float:
    if "against" not in rest:
        return getattr(measured(rows, chosen, "rows"), rest.get("of", "mean"))
    counts = against(latest(select(rows, **chosen)), rest["against"])
    if counts is None:
        raise SourceError(f"expected rows of episodes against {rest['against']!r} with {dict(chosen)}, found none")
    won, lost, count = counts
    return {"lead": (won - lost) / count, "p": up(mcnemar(won, lost))}[rest["of"]]


def _file(name: str, rest: Mapping[str, Any]) -> Iterator[float]:
    """``file`` below the root, ``at`` keys; of a text the number that a ``pattern`` finds in brackets."""
    path = ROOT / name
    for found in _at(READERS[path.suffix](path.read_text(encoding="utf-8")), rest.get("at", ())):
        yield _found(rest["pattern"], found) if "pattern" in rest else found


def _found(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    if found is None:
        raise SourceError(f"expected {pattern!r} in {text!r}, found nothing like it")
    return float(found[1])


def _at(content: Any, keys: Sequence[Any]) -> Iterator[float]:
    """What stands at keys, each below the one before.

    A list of keys: at each of them. ``*``: at all. A mapping: of a list's items those that have its values, or one of them.
    """
    if not keys:
        yield content
        return
    key, *below = keys
    if isinstance(key, Mapping):
        found = [item for item in content if all(item.get(name) in _listed(value) for name, value in key.items())]
    elif key == EVERY:
        found = list(content.values() if isinstance(content, Mapping) else content)
    else:
        found = [content[one] if isinstance(content, Mapping | Sequence) else getattr(content, one) for one in _listed(key)]
    if not found:
        raise SourceError(f"expected items with {key}, found none")
    for item in found:
        yield from _at(item, below)


def _listed(key: Any) -> list[Any]:
    return key if isinstance(key, list) else [key]


def _settings(name: str, rest: Mapping[str, Any]) -> Iterator[float]:
    """``settings: conf/NAME.yaml``, ``at`` attributes of :class:`ModelSettings`, or keys of what a ``verb``'s groups come to."""
    return _at(load(name, rest["verb"]) if "verb" in rest else _tuned(name), rest["at"])


def _code(name: str, rest: Mapping[str, Any]) -> Iterator[float]:
    """``code: package.module.NAME``, an attribute of what is named, or ``package.module.function(parameter)``, its default."""
    dotted, _, parameter = name.rstrip(")").partition("(")
    parts = dotted.split(".")
    for length in range(len(parts) - 1, 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            found = getattr(found, part)
        return _at(inspect.signature(found).parameters[parameter].default if parameter else found, rest.get("at", ()))
    raise SourceError(f"expected a module, found none in {name}")


def _paper(given: Mapping[str, Any] | float, rest: Mapping[str, Any]) -> Iterator[float]:
    """``paper: {domain, setting, metric, ...}`` of the numbers beside ours, or a number and ``where`` in the paper it stands."""
    if not isinstance(given, Mapping):
        if not rest.get("where"):
            raise SourceError("expected where in the paper the number stands")
        yield float(given)
        return
    wanted = dict(given)
    domain = domain_of_file(wanted.pop("domain"))
    if domain.comparison.paper:  # texts may name numbers beside which tables put none
        paper = replace(domain.comparison.paper, comparable=True)
        domain = replace(domain, comparison=replace(domain.comparison, paper=paper))
    method = Compared(wanted.pop("method", OURS))
    number = lookup(domain, wanted.pop("setting"), wanted.pop("metric", "accuracy"), method=method, **wanted)
    if number is None:
        raise SourceError(f"expected a number of the paper with {dict(given)}, found none")
    yield getattr(number, rest.get("of", "value"))


def _given(number: float, rest: Mapping[str, Any]) -> Iterator[float]:
    """``given``: what is measured nowhere, and ``why``."""
    if not rest.get("why"):
        raise SourceError("expected why the number needs no source")
    yield float(number)


def _weights(name: str, rest: Mapping[str, Any]) -> Iterator[float]:
    """``weights``: how many numbers the tensors of a file hold, those whose names begin with ``under``."""
    with safe_open(ROOT / name, "np") as file:
        yield sum(math.prod(file.get_slice(key).get_shape()) for key in file.keys() if key.startswith(rest.get("under", "")))  # noqa: SIM118


def _size(name: str, rest: Mapping[str, Any]) -> Iterator[float]:
    """``size``: bytes of a file."""
    yield float((ROOT / name).stat().st_size)


def _combined(kind: str) -> Callable[[Sequence[Any], Mapping[str, Any]], Iterator[float]]:
    """``mean``, ``ratio`` and so on: of references and plain factors; of these alone with ``why``."""

    def numbers(parts: Sequence[Any], rest: Mapping[str, Any]) -> Iterator[float]:
        if not rest.get("why") and not any(isinstance(part, Mapping) for part in parts):
            raise SourceError("expected why plain numbers are the source")
        yield COMBINED[kind]([value for part in parts for value in (values(part) if isinstance(part, Mapping) else [part])])

    return numbers


KINDS: Mapping[str, Callable[[Any, Mapping[str, Any]], Iterator[float]]] = {
    "rows": _rows,
    "file": _file,
    "settings": _settings,
    "code": _code,
    "paper": _paper,
    "given": _given,
    "weights": _weights,
    "size": _size,
    **{kind: _combined(kind) for kind in COMBINED},
}
"""Kinds of references."""
