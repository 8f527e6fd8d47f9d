"""Configuration files that build on others.

A file may have the key ``defaults``, a list of files that are merged in order before its own keys: mappings key by key, of
everything else, lists too, the later value stands. So an experiment says only what differs::

    defaults: [trainer/fit.yaml, domain/fit/agent.yaml, method/fit/bc.yaml]
    trainer: {max_steps: 6000}

Each name is looked for in the folder of the file that has it, then in the folders above, at last in what is shipped with the
package (:mod:`ftl_lightning.shipped`). Interpolations such as ``${seed_everything}`` are left as they are.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ftl_lightning.errors import UserError, short
from ftl_lightning.limits import expect_readable
from ftl_lightning.regrouped import class_of, regrouped
from ftl_lightning.shipped import shipped

DEFAULTS = "defaults"
_OPTIONS = ("--config", "-c")


def find(path: str | Path) -> Path:
    """A configuration file by its path from the current folder or, if there is none, among the shipped ones.

    Raises:
        UserError: if there is none, naming what is there instead.
    """
    found = shipped(path)
    if not found.is_file():
        raise UserError(f"{path}: expected a configuration file, found {'a folder' if found.is_dir() else 'nothing'}{_near(path)}")
    return found


def _near(path: str | Path) -> str:
    """What the nearest folder holds, to help with a wrong name; nothing for the current folder."""
    parent = next((parent for parent in Path(path).parents if shipped(parent).is_dir()), Path())  # an empty name has none
    folder = shipped(parent)
    there = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() or entry.suffix == ".yaml")
    return f"; {parent} holds {', '.join(there)}" if there and folder.resolve() != Path.cwd() else ""


def load(path: str | Path, verb: str = "") -> dict[str, Any]:
    """The keys of a configuration file and of all that it builds on; what is older in a file is told in one line.

    Args:
        path: of the file.
        verb: that it configures, which tells older options apart where none of the files names a class.

    Raises:
        UserError: naming the file, for one that is missing, damaged or no mapping, or whose defaults are or go in a circle.
    """
    try:
        files = [(str(part), _plain(keys)) for part, keys in _parts(find(path), ())]
        named = class_of([keys for _, keys in files], verb)
        found = OmegaConf.to_container(
            OmegaConf.merge(*(OmegaConf.create(regrouped(keys, where, named)) for where, keys in files)), resolve=False
        )
    except (OmegaConfBaseException, RecursionError, TypeError, ValueError) as error:  # OmegaConf's own are not all
        raise UserError(f"{path}: expected keys that go together, found others ({short(str(error), 150)})") from error
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def parts(path: str | Path) -> list[Path]:
    """The files that :func:`load` merges, in order; the last is the file itself."""
    return [part for part, _ in _parts(find(path), ())]


def _parts(path: Path, above: tuple[Path, ...]) -> Iterator[tuple[Path, DictConfig]]:
    """Every file with its own keys. ``above`` are the files that led here."""
    if path.resolve() in (one.resolve() for one in above):
        raise UserError(f"{above[-1]}: key '{DEFAULTS}': {path} builds on {above[-1]} itself; leave one of them out")
    keys = _read(path)
    names = keys.pop(DEFAULTS, None) or []
    if not isinstance(names, ListConfig | list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{path}: key '{DEFAULTS}': expected a list of configuration files, found {short(str(names))}")
    for name in names:
        yield from _parts(_beside(path, name), (*above, path))
    yield path, keys


def _beside(path: Path, name: str) -> Path:
    """The file that ``defaults`` of a file name."""
    try:
        for folder in path.absolute().parents:
            if (folder / name).is_file():
                # As the user writes it: relative where the file is.
                return folder / name if path.is_absolute() else _relative(folder / name)
        if (own := shipped(name)).is_file():
            return own
    except (OSError, ValueError) as error:  # a name that no file can have, or a folder that cannot be read
        told = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, found {short(name, 150)} ({told})") from error
    found = f"found no {short(name, 150)} beside it or in a folder above it"
    raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, {found}")


def read(path: Path) -> dict[str, Any]:
    """The own keys of one configuration file, as they stand in it.

    Raises:
        UserError: as :func:`load`.
    """
    return _plain(_read(path))


def _plain(keys: DictConfig) -> dict[str, Any]:
    found = OmegaConf.to_container(keys, resolve=False)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _read(path: Path) -> DictConfig:
    expect_readable(path, "configuration", LONGEST)
    try:
        keys = OmegaConf.load(path)
    except (
        OSError,
        ValueError,
        YAMLError,
        OmegaConfBaseException,
        RecursionError,
        TypeError,
        LookupError,
        AssertionError,
    ) as error:
        told = short(str(error), 200) or "no mapping of keys"
        raise UserError(f"{path}: expected a configuration file (YAML), found {told}") from error
    if not isinstance(keys, DictConfig):
        raise UserError(f"{path}: expected a mapping of keys, found a list")
    return keys


LONGEST = 200_000
"""Bytes of a configuration file; OmegaConf bounds what its aliases stand for."""


def configurations(arguments: Sequence[str]) -> list[str]:
    """The configuration files that a command line names, in order."""
    return [value for _, _, value in _given(arguments)]


def expanded(arguments: Sequence[str], verb: str = "") -> list[str]:
    """A command line with the content of configuration files, as :func:`load` has it, in place of their names.

    Args:
        arguments: with or without the verb.
        verb: see :func:`load`.

    Raises:
        UserError: as :func:`load`.
    """
    result = list(arguments)
    for index, prefix, value in _given(arguments):
        result[index] = prefix + OmegaConf.to_yaml(OmegaConf.create(load(value, verb)))
    return result


def _given(arguments: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """For each configuration file the argument that holds its name, what stands before it there, and the name.

    A configuration that is itself the argument (``--config '{seed_everything: 1}'``) is left out.
    """
    for index, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if argument in _OPTIONS and index + 1 < len(arguments):
            index, equals, option, value = index + 1, "", "", arguments[index + 1]
        elif option not in _OPTIONS or not equals:
            continue
        if "\n" not in value and not value.lstrip().startswith("{"):
            yield index, option + equals, value
