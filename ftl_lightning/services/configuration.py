"""Configuration files with defaults and a section for each verb.

The key ``defaults`` lists files that are merged in order before the file's keys: mappings key by key; for other values, lists
included, the later value wins. The keys ``fit`` and ``invert`` are sections, which apply to that verb alone and are merged
after the file's other keys::

    defaults: [verb.yaml, domain/agent.yaml, method/bc.yaml]
    trainer: {logger: {init_args: {name: bc_agent}}}
    fit:
      trainer: {max_steps: 6000}
    invert:
      model: {init_args: {pretrained: pretrained/baseline/bc/agent}}

Names are searched in the file's folder, then in its parent folders, then among shipped files
(:mod:`~ftl_lightning.services.shipped`).
Interpolations such as ``${seed_everything}`` are not resolved.
"""

import copy
import functools
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.shipped import shipped

DEFAULTS = "defaults"
SECTIONS = ("fit", "invert")
"""Keys whose content applies to a single verb."""


def section_of(verb: str) -> str | None:
    """Section of a verb; ``None`` for a verb without sections."""
    return {"fit": "fit", "invert": "invert", "validate": "fit", "test": "fit"}.get(verb)


def find(path: str | Path) -> Path:
    """Find a configuration file by its path from the current folder, or among shipped files.

    Raises:
        UserError: if there is none, with nearby files.
    """
    file = shipped(path)
    if not file.is_file():  # the message reads folders
        raise UserError(f"{path}: expected a configuration file, found {'a folder' if file.is_dir() else 'nothing'}{_near(path)}")
    return file


def _near(path: str | Path) -> str:
    """Content of the nearest folder, as a hint for a wrong name; empty for the current folder."""
    parent = next((parent for parent in Path(path).parents if shipped(parent).is_dir()), Path())  # an empty name has none
    folder = shipped(parent)
    there = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() or entry.suffix == ".yaml")
    return f"; {parent} holds {', '.join(there)}" if there and folder.resolve() != Path.cwd() else ""


def load(path: str | Path, verb: str = "") -> dict[str, Any]:
    """Load a configuration file and its defaults.

    Args:
        path: path of the file.
        verb: verb whose sections apply; ``validate`` and ``test`` use those of ``fit``. For any other, sections are ordinary keys.

    Raises:
        UserError: with the file, if it or a default is missing, damaged or no mapping, or defaults are circular.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.create(), *(OmegaConf.create(keys) for _, keys in parts(path, verb)))
        return _plain(OmegaConf.to_container(merged, resolve=False))
    except (OmegaConfBaseException, RecursionError, TypeError, ValueError) as error:  # not only OmegaConf's errors
        raise UserError(f"{path}: expected keys that go together, found others ({short(str(error), 150)})") from error


def parts(path: str | Path, verb: str = "") -> list[tuple[Path, dict[str, Any]]]:
    """Parts merged by :func:`load`, in order: files with their raw keys; the last is the file itself. Errors as :func:`load`."""
    return list(_merged(find(path), section_of(verb), ()))


def _plain(keys: object) -> dict[str, Any]:
    if not isinstance(keys, dict):
        raise UserError(f"configuration: expected a mapping of keys, found {short(str(keys))}")
    return {str(key): value for key, value in keys.items()}


def _merged(path: Path, section: str | None, above: tuple[Path, ...]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Files with their keys, the section's after the others. ``above``: files that include this file."""
    if path.resolve() in (parent.resolve() for parent in above):
        raise UserError(f"{above[-1]}: key '{DEFAULTS}': {path} builds on {above[-1]} itself; remove either from its list")
    keys = _read(path)
    names = keys.pop(DEFAULTS, None) or []
    valid = isinstance(names, list) and all(isinstance(name, str) for name in names)
    require(valid, f"{path}: key '{DEFAULTS}'", "a list of configuration files", short(str(names)))
    for name in names:
        yield from _merged(_beside(path, name), section, (*above, path))
    sections = {} if section is None else {name: keys.pop(name, None) for name in SECTIONS}
    yield path, keys
    for name, content in sections.items():
        require(isinstance(content, dict | None), f"{path}: key '{name}'", "a mapping of keys", short(str(content)))
    if section and (content := sections[section]) is not None:
        yield path, _plain(content)


def _beside(path: Path, name: str) -> Path:
    """Find a file named in ``defaults``."""
    try:
        for folder in path.absolute().parents:
            if (folder / name).is_file():
                file = folder / name
                relative = not path.is_absolute() and file.is_relative_to(Path.cwd())  # as the user's path is
                return file.relative_to(Path.cwd()) if relative else file
        if (ours := shipped(name)).is_file():
            return ours
    except (OSError, ValueError) as error:  # a name that no file can have, or a folder that cannot be read
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, found {short(name, 150)} ({reason})") from error
    missing = f"no {short(name, 150)} beside it or in a folder above it"
    raise UserError(f"{path}: key '{DEFAULTS}': expected configuration files, found {missing}")


def _read(path: Path) -> dict[str, Any]:
    check_readable(path, "configuration", LONGEST)
    try:
        keys = _parsed(path.read_text("utf-8"))
    except _DAMAGED as error:
        reason = short(str(error), 200) or "no mapping of keys"
        raise UserError(f"{path}: expected a configuration file (YAML), found {reason}") from error
    require(isinstance(keys, dict), str(path), "a mapping of keys", "a list")
    return _plain(copy.deepcopy(keys))


@functools.lru_cache
def _parsed(text: str) -> object:
    """Content of a YAML file, cached, as commands read it several times."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):  # libyaml crashes at lists and mappings that are too deep
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f"lists and mappings deeper than {DEEPEST}")
    content = OmegaConf.to_container(OmegaConf.load(io.StringIO(text)), resolve=False)
    str(content)  # a number of thousands of digits is a ValueError
    return content


DEEPEST = 40
"""Maximum nesting of lists and mappings."""
LONGEST = 200_000
"""Maximum size of a configuration file in bytes; OmegaConf bounds the expansion of aliases."""
_DAMAGED = (OSError, ValueError, YAMLError, OmegaConfBaseException, RecursionError, TypeError, LookupError, AssertionError)
