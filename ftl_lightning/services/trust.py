"""Trust in code: files may name modules, but only installed or user-trusted modules are imported.

A model's folder may name a domain of an installed package. A configuration may name classes and domains of installed modules.
Other modules, the current folder's in particular, must be trusted by the user: on the command line by ``--trust MODULE`` or by
naming the class or domain, in Python by an argument.
"""

import contextvars
import importlib.machinery
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import EntryPoint, distributions
from pathlib import Path

from ftl_lightning.services.command_line import Arguments
from ftl_lightning.services.errors import about, require, short

_TRUST = "trust"
OPTION = f"--{_TRUST}"
"""Option that trusts a module, wherever it is named, the current folder included."""
NO_CODE = ("ftl_lightning.conf", "ftl_lightning.pretrained")
"""Folders of the package with data files of others and never a module."""
_PACKAGE = Path(__file__).parent.parent.parent
_REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_CLASS = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)+")
_INLINE = re.compile(r"\b(class_path|domain)[\"']?\s*:\s*[\"']?([\w.:]+)")
_CLASSES = ("class_path", "model", "data", "callbacks", "logger", "strategy", "plugins", "profiler", "optimizer", "lr_scheduler")
"""Last parts of options that name classes."""
_SAFE_PATH = "PYTHONSAFEPATH"
_POSITIONAL = ("generate", "encode", "prepare", "study")
"""Verbs with a domain as first argument."""
_vouched: contextvars.ContextVar[frozenset[str]] = contextvars.ContextVar("vouched", default=frozenset())


def search_path() -> list[str]:
    """Python's path without the current folder, unless the package is in it.

    Python adds the folder for ``-c``, for ``-m`` (see ``__main__``), in notebooks, and for an empty part of ``PYTHONPATH``.
    """
    here = Path.cwd()
    python_path = os.environ.get("PYTHONPATH")
    parts = {Path(part or ".").absolute() for part in python_path.split(os.pathsep)} if python_path else set()
    accidental = {"", ".", _appended()} | ({str(here)} if here in parts else set())
    return [entry for entry in sys.path if entry not in accidental or (here == _PACKAGE and entry == str(here))]


def _appended() -> str:
    """Entry of the current folder at the end of Python's path, where it hides no other module."""
    return f"{Path.cwd()}{os.sep}."


def entry_points(group: str) -> list[EntryPoint]:
    """Entry points of installed packages in a group, without the current folder."""
    return [point for package in distributions(path=search_path()) for point in package.entry_points if point.group == group]


def is_installed(module: str) -> bool:
    """Whether a module's package is on Python's path without the current folder. Nothing is imported."""
    if any(module == folder or module.startswith(f"{folder}.") for folder in NO_CODE):
        return False
    package, path = module.partition(".")[0], search_path()
    for finder in sys.meta_path:
        ours = finder is importlib.machinery.PathFinder
        if (importlib.machinery.PathFinder.find_spec(package, path) if ours else finder.find_spec(package, None)) is not None:
            return True
    return False


def is_vouched(reference: str) -> bool:
    """Whether the user trusts this ``module:ATTRIBUTE``, its module, or a parent package."""
    module, names = reference.partition(":")[0], _vouched.get()
    return reference in names or any(module == name or module.startswith(f"{name}.") for name in names)


def trusted_names() -> frozenset[str]:
    """Names that the user trusts, to pass on to other processes."""
    return _vouched.get()


@contextmanager
def vouching(names: Iterable[str]) -> Iterator[None]:
    """Trust modules, packages, or ``module:ATTRIBUTE`` within the block."""
    token = _vouched.set(_vouched.get() | set(names))
    try:
        yield
    finally:
        _vouched.reset(token)


@contextmanager
def person(verb: str, arguments: Arguments) -> Iterator[Arguments]:
    """Trust names in a verb's arguments, and remove the current folder from Python's path unless a module in it is named.

    Yields:
        The arguments without :data:`OPTION`.

    Raises:
        UserError: for an option without a module.
    """
    names = set(arguments.values(_TRUST))
    for name in names:
        require(_CLASS.fullmatch(name) or name.isidentifier(), OPTION, "the name of a module such as my_domain", repr(short(name)))
    arguments = arguments.without(_TRUST)
    names |= _named(verb, arguments)
    before, safe = list(sys.path), os.environ.get(_SAFE_PATH)
    sys.path[:] = search_path()
    os.environ[_SAFE_PATH] = "1"  # for worker processes, whose path would include the current folder
    if any(not is_installed(name.partition(":")[0]) for name in names):
        sys.path.append(_appended())
    try:
        with vouching(names):
            yield arguments
    finally:
        sys.path[:] = before
        if safe is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = safe


def _named(verb: str, arguments: Arguments) -> set[str]:
    """Domains and environments ``module:ATTRIBUTE``, and modules of classes, in the command line itself."""
    first = arguments.positional[:1] if verb in _POSITIONAL else ()
    names = {domain for domain in first if _REFERENCE.fullmatch(domain)}
    for option, value in arguments.options:
        last, value = option.rstrip("+").rpartition(".")[2], value or ""
        if last in ("domain", "environment") and _REFERENCE.fullmatch(value):
            names.add(value)
        if last in _CLASSES and _CLASS.fullmatch(value):
            names.add(value.rpartition(".")[0])
        for key, inside in _INLINE.findall(value):  # --config '{data: {class_path: my_data.Data}}'
            if (_REFERENCE if key == "domain" else _CLASS).fullmatch(inside):
                names.add(inside if key == "domain" else inside.rpartition(".")[0])
    return names


def check_classes(keys: object, where: str) -> None:
    """Refuse the content of a file (``where``) with a class of a module that is neither installed nor trusted.

    Raises:
        UserError: with the file, the key and the module.
    """
    for key, value in leaves(keys):
        if key.rpartition(".")[2] == "class_path" and _CLASS.fullmatch(value):
            with about(where):
                check_module(value.rpartition(".")[0], key)


def check_module(reference: str, key: str) -> None:
    """Refuse a module, or ``module:ATTRIBUTE``, that is neither installed nor trusted.

    Raises:
        UserError: with the key and the module.
    """
    module = reference.partition(":")[0]
    advice = f"install its package, or if it is in the current folder and you trust it, add {OPTION} {short(module)}"
    refused = f"{short(module)!r}, which was not imported; {advice}"
    require(is_installed(module) or is_vouched(reference), f"key {short(key)!r}", "an installed module", refused)


def allowed(keys: object) -> set[str]:
    """Packages and modules allowed for a configuration's classes: installed packages that it names, and trusted modules.

    The standard library is excluded: it has no models, data or trainer parts.
    """
    texts = {value for _, value in leaves(keys) if _CLASS.fullmatch(value)}
    packages = {text.partition(".")[0] for text in texts if is_installed(text)}
    return (packages - sys.stdlib_module_names) | {name.partition(":")[0] for name in _vouched.get()}


def allow_classes(packages: Iterable[str]) -> None:
    """Allow only classes and types of these packages in configurations, until the next call.

    Other names of classes, such as interpolated values, are refused on import.
    """
    from jsonargparse import set_parsing_settings

    now = set(packages)
    # jsonargparse accumulates settings, so earlier packages must be denied, unless they are inside an allowed package.
    inside = {name for name in _allowed_before if any(name.startswith(f"{package}.") for package in now)}
    set_parsing_settings(
        instantiate_subclass_spec_in_any=False,
        import_path_denylist=["*", *sorted(_allowed_before - now - inside)],
        import_path_allowlist=sorted(now | inside),
    )
    set_parsing_settings(import_path_denylist=list(NO_CODE))
    _allowed_before.update(now)


_allowed_before: set[str] = set()
"""All packages ever passed to :func:`allow_classes`; global, as are jsonargparse's settings."""


def leaves(keys: object, above: str = "") -> Iterator[tuple[str, str]]:
    """Every text in nested mappings and lists, with its keys joined by dots."""
    if isinstance(keys, Mapping):
        for key, value in keys.items():
            yield from leaves(value, f"{above}.{key}" if above else str(key))
    elif isinstance(keys, list | tuple):
        for index, value in enumerate(keys):
            yield from leaves(value, f"{above}[{index}]")
    elif isinstance(keys, str):
        yield above, keys
