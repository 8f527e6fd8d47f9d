"""Whose code runs. Files name modules, too, but only an installation or the person at the keyboard decides that one is imported.

A model's folder may ask for a domain that an installed package offers. A configuration may ask for classes and domains of installed
modules. Everything else, and the current folder above all, takes a person's word: on the command line, by ``--trust MODULE`` or by
naming the class or domain there, in Python by an argument.
"""

import contextvars
import importlib.machinery
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import EntryPoint, distributions
from pathlib import Path

from ftl_lightning.errors import UserError, about, short

OPTION = "--trust"
"""Names a module that may be imported, wherever it is named and though it lies in the current folder."""
NO_CODE = ("ftl_lightning.conf", "ftl_lightning.pretrained")
"""Folders inside of the package that hold files of others and never a module."""
_PACKAGE = Path(__file__).parent.parent
_REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_CLASS = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)+")
_INLINE = re.compile(r"\b(class_path|domain)[\"']?\s*:\s*[\"']?([\w.:]+)")
_CLASSES = ("class_path", "model", "data", "callbacks", "logger", "strategy", "plugins", "profiler", "optimizer", "lr_scheduler")
"""Ends of options that name classes."""
_SAFE_PATH = "PYTHONSAFEPATH"
_POSITIONAL = ("generate", "encode", "prepare", "study")
"""Verbs whose first argument is a domain."""
_vouched: contextvars.ContextVar[frozenset[str]] = contextvars.ContextVar("vouched", default=frozenset())


def search_path() -> list[str]:
    """Where modules are looked for: Python's path without the current folder, which is on it by accident.

    Python puts it there for ``-c``, for ``-m`` (see ``__main__``), in a notebook, and for an empty part of ``PYTHONPATH``. The
    folder that this package comes from stays.
    """
    here = Path.cwd()
    python_path = os.environ.get("PYTHONPATH")
    parts = {Path(part or ".").absolute() for part in python_path.split(os.pathsep)} if python_path else set()
    accidental = {"", ".", _appended()} | ({str(here)} if here in parts else set())
    return [entry for entry in sys.path if entry not in accidental or (here == _PACKAGE and entry == str(here))]


def _appended() -> str:
    """The current folder as it stands at the end of Python's path, where it hides no other module, if a module in it is named."""
    return f"{Path.cwd()}{os.sep}."


def entry_points(group: str) -> list[EntryPoint]:
    """What installed packages offer in a group; the current folder is none."""
    return [point for package in distributions(path=search_path()) for point in package.entry_points if point.group == group]


def is_installed(module: str) -> bool:
    """Whether Python finds the package of a module without the current folder. Nothing is imported."""
    if any(module == folder or module.startswith(f"{folder}.") for folder in NO_CODE):
        return False
    package, path = module.partition(".")[0], search_path()
    for finder in sys.meta_path:
        ours = finder is importlib.machinery.PathFinder
        if (importlib.machinery.PathFinder.find_spec(package, path) if ours else finder.find_spec(package, None)) is not None:
            return True
    return False


def is_vouched(reference: str) -> bool:
    """Whether a person named this ``module:ATTRIBUTE``, its module, or a package that the module is in."""
    module, names = reference.partition(":")[0], _vouched.get()
    return reference in names or any(module == name or module.startswith(f"{name}.") for name in names)


def vouched() -> frozenset[str]:
    """All that a person named, for processes that are started elsewhere."""
    return _vouched.get()


@contextmanager
def vouching(names: Iterable[str]) -> Iterator[None]:
    """Within the block, these are vouched for: modules, packages, or ``module:ATTRIBUTE``."""
    token = _vouched.set(_vouched.get() | set(names))
    try:
        yield
    finally:
        _vouched.reset(token)


@contextmanager
def person(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Take what a command line names as a person's word, and the current folder off Python's path unless something in it is named.

    Args:
        arguments: of the program, the verb first.

    Yields:
        The arguments without :data:`OPTION`.

    Raises:
        UserError: for an option without a module.
    """
    names, rest = _trusted(arguments)
    names |= _named(rest)
    before, safe = list(sys.path), os.environ.get(_SAFE_PATH)
    sys.path[:] = search_path()
    os.environ[_SAFE_PATH] = "1"  # of worker processes, which are started with the current folder on their path
    if any(not is_installed(name.partition(":")[0]) for name in names):
        sys.path.append(_appended())
    try:
        with vouching(names):
            yield rest
    finally:
        sys.path[:] = before
        if safe is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = safe


def _trusted(arguments: Sequence[str]) -> tuple[set[str], list[str]]:
    """The modules that :data:`OPTION` names, and the arguments without it."""
    names, rest, left = set(), [], iter(arguments)
    for argument in left:
        option, equals, value = argument.partition("=")
        if option != OPTION:
            rest.append(argument)
            continue
        name = value if equals else next(left, "")
        if not _CLASS.fullmatch(name) and not name.isidentifier():
            raise UserError(f"{OPTION}: expected the name of a module such as my_domain, found {short(name)!r}")
        names.add(name)
    return names, rest


def _named(arguments: Sequence[str]) -> set[str]:
    """Domains as ``module:ATTRIBUTE``, and modules of classes, that the command line itself names."""
    names = set()
    if len(arguments) > 1 and arguments[0] in _POSITIONAL and _REFERENCE.fullmatch(arguments[1]):
        names.add(arguments[1])
    for argument, following in zip(arguments, [*arguments, ""][1:], strict=True):
        option, equals, value = argument.partition("=")
        value = value if equals else following
        last = option.lstrip("-").rstrip("+").rpartition(".")[2]
        if option.startswith("-") and last == "domain" and _REFERENCE.fullmatch(value):
            names.add(value)
        if option.startswith("-") and last in _CLASSES and _CLASS.fullmatch(value):
            names.add(value.rpartition(".")[0])
        for key, inside in _INLINE.findall(argument):  # --config '{data: {class_path: my_data.Data}}'
            if (_REFERENCE if key == "domain" else _CLASS).fullmatch(inside):
                names.add(inside if key == "domain" else inside.rpartition(".")[0])
    return names


def expect_classes(keys: object, where: str) -> None:
    """Refuse a configuration that asks for a class of a module which neither is installed nor a person vouches for.

    Args:
        keys: what a configuration file says, mappings and lists within one another.
        where: the file.

    Raises:
        UserError: naming the file, the key and the module.
    """
    for key, value in leaves(keys):
        if key.rpartition(".")[2] == "class_path" and _CLASS.fullmatch(value):
            with about(where):
                expect_module(value.rpartition(".")[0], key)


def expect_module(reference: str, key: str) -> None:
    """Refuse a module, or ``module:ATTRIBUTE``, that neither is installed nor a person vouches for.

    Raises:
        UserError: naming the key and the module.
    """
    module = reference.partition(":")[0]
    if not is_installed(module) and not is_vouched(reference):
        raise UserError(
            f"key {short(key)!r}: expected an installed module, found {short(module)!r}, which was not imported; install its "
            f"package, or if it is in the current folder and you trust it, add {OPTION} {short(module)}"
        )


def allowed(keys: object) -> set[str]:
    """Packages and modules that a configuration's classes may come from: installed ones that it names, and those vouched for.

    Python's own library is left out: none of its classes is a model, data or a part of a trainer.
    """
    texts = {value for _, value in leaves(keys) if _CLASS.fullmatch(value)}
    packages = {text.partition(".")[0] for text in texts if is_installed(text)}
    return (packages - sys.stdlib_module_names) | {name.partition(":")[0] for name in _vouched.get()}


def allow_classes(packages: Iterable[str]) -> None:
    """Let configurations name classes and types of these packages alone, until it is called again.

    Whatever else names a class, such as a value that is put together from others, is refused where it would be imported.
    """
    from jsonargparse import set_parsing_settings

    now = set(packages)
    # jsonargparse adds to what it was told before, so what is allowed no more has to be denied, unless it is inside of what is.
    inside = {name for name in _told if any(name.startswith(f"{package}.") for package in now)}
    set_parsing_settings(
        instantiate_subclass_spec_in_any=False,
        import_path_denylist=["*", *sorted(_told - now - inside)],
        import_path_allowlist=sorted(now | inside),
    )
    set_parsing_settings(import_path_denylist=list(NO_CODE))
    _told.update(now)


_told: set[str] = set()
"""What :func:`allow_classes` was ever told, for the whole process, as jsonargparse's settings are."""


def leaves(keys: object, above: str = "") -> Iterator[tuple[str, str]]:
    """Every text in mappings and lists, with its keys joined by dots."""
    if isinstance(keys, Mapping):
        for key, value in keys.items():
            yield from leaves(value, f"{above}.{key}" if above else str(key))
    elif isinstance(keys, list | tuple):
        for index, value in enumerate(keys):
            yield from leaves(value, f"{above}[{index}]")
    elif isinstance(keys, str):
        yield above, keys
