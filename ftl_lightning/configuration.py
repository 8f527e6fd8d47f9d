"""Configuration files that build on others, and that say what differs between verbs.

A file may have the key ``defaults``, a list of files that are merged in order before its own keys: mappings key by key, of
everything else, lists too, the later value stands. So an experiment says only what differs. Its keys ``fit`` and ``invert`` are
sections: what they hold counts for that verb alone and is merged after the file's other keys::

    defaults: [verb.yaml, domain/agent.yaml, method/bc.yaml]
    trainer: {logger: {init_args: {name: bc_agent}}}
    fit:
      trainer: {max_steps: 6000}
    invert:
      model: {init_args: {pretrained: pretrained/baseline/bc/agent}}

Each name is searched in the folder of the file, then in the folders above, at last among the files that ship with the package
(:mod:`ftl_lightning.shipped`). Interpolations such as ``${seed_everything}`` are not resolved.
"""

import copy
import functools
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ftl_lightning.errors import UserError, short
from ftl_lightning.limits import expect_readable
from ftl_lightning.shipped import shipped

DEFAULTS = "defaults"
SECTIONS = ("fit", "invert")
"""Keys of a file whose content counts for one verb alone."""
_OPTIONS = ("--config", "-c")


def section_of(verb: str) -> str | None:
    """The section that counts for a verb; ``None`` for one whose files have no sections."""
    return {"fit": "fit", "invert": "invert", "validate": "fit", "test": "fit"}.get(verb)


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
    """The keys of a configuration file and of all that it builds on.

    Args:
        path: of the file.
        verb: whose sections count, for ``validate`` and ``test`` those of ``fit``; for another verb, or none, the keys ``fit`` and
            ``invert`` are keys like others.

    Raises:
        UserError: naming the file, for one that is missing, damaged or no mapping, or whose defaults are or go in a circle.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.create(), *(OmegaConf.create(keys) for _, keys in parts(path, verb)))
        found = OmegaConf.to_container(merged, resolve=False)
    except (OmegaConfBaseException, RecursionError, TypeError, ValueError) as error:  # OmegaConf's own are not all
        raise UserError(f"{path}: expected keys that go together, found others ({short(str(error), 150)})") from error
    return _plain(found)


def parts(path: str | Path, verb: str = "") -> list[tuple[Path, dict[str, Any]]]:
    """What :func:`load` merges, in order: files, each with keys of its own as they stand in it; the last is the file itself.

    Raises:
        UserError: as :func:`load`.
    """
    return list(_merged(find(path), section_of(verb), ()))


def _plain(keys: object) -> dict[str, Any]:
    if not isinstance(keys, dict):
        raise UserError(f"configuration: expected a mapping of keys, found {short(str(keys))}")
    return {str(key): value for key, value in keys.items()}


def _merged(path: Path, section: str | None, above: tuple[Path, ...]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Every file with its keys, the section's after the others. ``above`` are the files that led here."""
    if path.resolve() in (one.resolve() for one in above):
        raise UserError(f"{above[-1]}: key '{DEFAULTS}': {path} builds on {above[-1]} itself; leave one of them out")
    keys = _read(path)
    names = keys.pop(DEFAULTS, None) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{path}: key '{DEFAULTS}': expected a list of configuration files, found {short(str(names))}")
    for name in names:
        yield from _merged(_beside(path, name), section, (*above, path))
    sections = {} if section is None else {name: keys.pop(name, None) for name in SECTIONS}
    yield path, keys
    for name, own in sections.items():
        if own is not None and not isinstance(own, dict):
            raise UserError(f"{path}: key '{name}': expected a mapping of keys, found {short(str(own))}")
    if section and (own := sections[section]) is not None:
        yield path, _plain(own)


def _beside(path: Path, name: str) -> Path:
    """The file that ``defaults`` of a file names."""
    try:
        for folder in path.absolute().parents:
            if (folder / name).is_file():
                # As the user writes it: relative where the file is.
                return folder / name if path.is_absolute() else _relative(folder / name)
        if (ours := shipped(name)).is_file():
            return ours
    except (OSError, ValueError) as error:  # a name that no file can have, or a folder that cannot be read
        told = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, found {short(name, 150)} ({told})") from error
    found = f"found no {short(name, 150)} beside it or in a folder above it"
    raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, {found}")


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _read(path: Path) -> dict[str, Any]:
    expect_readable(path, "configuration", LONGEST)
    try:
        keys = _parsed(path.read_text("utf-8"))
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
    if not isinstance(keys, dict):
        raise UserError(f"{path}: expected a mapping of keys, found a list")
    return _plain(copy.deepcopy(keys))


@functools.lru_cache
def _parsed(text: str) -> object:
    """The content of a YAML file, parsed once for the several times that a command reads it."""
    return OmegaConf.to_container(OmegaConf.load(io.StringIO(text)), resolve=False)


LONGEST = 200_000
"""Bytes of a configuration file; OmegaConf bounds what its aliases stand for."""


def configurations(arguments: Sequence[str]) -> list[str]:
    """The configuration files that a command line names, in order."""
    return [value for _, _, value in _given(arguments)]


def expanded(arguments: Sequence[str], verb: str = "") -> list[str]:
    """A command line with the content of configuration files, as :func:`load` has it for a verb, in place of their names.

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
