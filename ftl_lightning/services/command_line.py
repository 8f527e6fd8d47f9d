"""Arguments of a verb: early checks of files, before slow imports, and short messages for a parser's errors."""

import glob
import re
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import yaml
from omegaconf import OmegaConf

from ftl_lightning.services.configuration import SECTIONS, load, parts, section_of
from ftl_lightning.services.errors import LONGEST, UserError, about, require, short
from ftl_lightning.services.files import (
    INFO,
    MOST_TEXT,
    check_new_folder,
    check_readable,
    check_writable_file,
    check_writable_folder,
    read_from,
    written_to,
)
from ftl_lightning.services.shipped import check_extra, missing_model, pretrained_folder, shipped
from ftl_lightning.services.store import is_url, modified

_LONG = {"-c": "--config", "-h": "--help"}


@dataclass(frozen=True)
class Arguments:
    """Arguments of a verb.

    Attributes:
        positional: arguments that belong to no option.
        options: names without dashes, with their values, in order; ``None`` for an option without a value.
    """

    positional: tuple[str, ...] = ()
    options: tuple[tuple[str, str | None], ...] = ()

    @classmethod
    def read(cls, arguments: Sequence[str]) -> "Arguments":
        """Read ``--option=value`` and ``--option value``; ``-c`` is ``--config``, and ``-h`` is ``--help``."""
        positional: list[str] = []
        options: list[tuple[str, str | None]] = []
        waiting = False  # for the value of the last option
        for argument in arguments:
            name, equals, value = argument.partition("=")
            name = _LONG.get(name, name)
            if name.startswith("--"):
                options.append((name[2:], value if equals else None))
                waiting = not equals and name[2:] not in ("help", "print_config", "version")
            elif waiting:
                options[-1] = (options[-1][0], argument)
                waiting = False
            else:
                positional.append(argument)
        return cls(tuple(positional), tuple(options))

    def words(self) -> list[str]:
        """Arguments for a parser: positional ones first, and ``--option=value``."""
        return [*self.positional, *(f"--{name}" if value is None else f"--{name}={value}" for name, value in self.options)]

    def values(self, name: str) -> list[str]:
        """Values of an option, in order; an empty text for a missing value."""
        return [value or "" for option, value in self.options if option == name]

    def without(self, name: str) -> "Arguments":
        """These arguments without an option."""
        return replace(self, options=tuple(option for option in self.options if option[0] != name))

    def configurations(self) -> list[str]:
        """Paths of configuration files, in order. Inline configurations (``--config '{seed_everything: 1}'``) are skipped."""
        return [value for value in self.values("config") if _is_path(value)]

    def expanded(self, verb: str = "") -> list[str]:
        """:meth:`words` with the content of configuration files, see :func:`~ftl_lightning.services.configuration.load`."""
        options = (
            (name, OmegaConf.to_yaml(OmegaConf.create(load(value, verb))) if name == "config" and _is_path(value) else value)
            for name, value in self.options
        )
        return replace(self, options=tuple(options)).words()


def _is_path(value: str | None) -> TypeGuard[str]:
    return value is not None and "\n" not in value and not value.lstrip().startswith("{")


Check = Callable[[str, str], object]
"""Raises a :class:`UserError` for an invalid path, given the path and its option."""


def _model(path: str, option: str) -> None:
    if not (pretrained_folder(path) / "config.json").is_file():
        raise UserError(missing_model(path))


def _checkpoint(path: str, option: str) -> None:
    if is_url(path):
        require(modified(path) is not None, option, "a checkpoint file", f"nothing at {path}")
    elif path != "last":
        with about(option):
            check_readable(path, "checkpoint")


def _demonstrations(path: str, option: str) -> None:
    kind, name = read_from(path)
    if kind == "lerobot":
        check_readable(Path(name) / INFO, "LeRobot info", MOST_TEXT)
    elif kind == "file":
        check_readable(name, "demonstrations")


def _concept(path: str, option: str) -> None:
    file = shipped(path)
    if len(file.parts) > 2 and not file.exists():  # a later invert writes to another log folder
        others = file.parents[2].glob(f"*/{glob.escape(file.parent.name)}/{glob.escape(file.name)}")
        if newest := max(others, key=lambda other: other.stat().st_mtime, default=None):
            raise UserError(f"{path}: expected a concept file, found nothing; the newest of this name is {newest}")
    check_readable(file, "concept")


def _text(kind: str) -> Check:
    """Check of a text file."""
    return lambda path, option: check_readable(path, kind, MOST_TEXT)


def _written_demonstrations(path: str, option: str) -> None:
    kind, name = written_to(path)
    if kind == "file":
        return check_writable_file(name, option)
    check_extra(kind, f"{option}: {short(path)}: this data set")
    if kind == "lerobot":
        check_new_folder(name, option)


def _table(path: str, option: str) -> None:
    require(not path.endswith(".npz"), option, "a name that ends in .safetensors, which is what is written", path)
    check_writable_file(path, option)


def _written_model(path: str, option: str) -> None:
    if not is_url(path):
        check_writable_folder(path, option)


def _results(path: str, option: str) -> None:
    """Check a results file that rows are added to."""
    check_writable_file(path, option)
    if Path(path).exists():
        check_readable(path, "results", MOST_TEXT)


TRAINER: Mapping[str, Check] = {
    "model.pretrained": _model,
    "data.demonstrations": _demonstrations,
    "ckpt_path": _checkpoint,
    "model.output": _written_model,
    "evaluation.results": _results,
    "evaluation.films": check_writable_file,
}
"""Checks of verbs with a trainer, by option without ``init_args``, as on the command line."""
_FOLDER: Mapping[str, Check] = {"out": check_writable_folder}
_WRITTEN: Mapping[str, Mapping[str, Check]] = {
    "generate": {"out": _written_demonstrations},
    "check": {"figure": check_writable_file},
    "encode": {"out": _table},
    "invert": _FOLDER,
    "sample": {"out": _written_demonstrations, **dict.fromkeys(("figure", "animation", "export"), check_writable_file)},
    "ablate": {"results": _results, "slurm": check_writable_file},
    "benchmark": {
        "check": _text("submission"),
        "data": check_writable_folder,
        **dict.fromkeys(("out", "leaderboard"), check_writable_file),
    },
    "report": {**_FOLDER, "readme": _text("Markdown"), "html": check_writable_file},
    "play": {"demonstrations": lambda path, option: check_readable(path, "demonstrations"), "static": check_writable_folder},
    "prepare": _FOLDER,
    "study": {**_FOLDER, "consent": _text("text")},
}


def command_checks(verb: str) -> Mapping[str, Check]:
    """Checks of a verb without a trainer."""
    return {"pretrained": _model, "concept": _concept, "initial": _demonstrations, **_WRITTEN.get(verb, {})}


def check_inputs(verb: str, arguments: Arguments, checks: Mapping[str, Check]) -> None:
    """Refuse arguments after a verb, configuration files included, with missing input files or invalid outputs.

    Raises:
        UserError: for the first such file, or an unreadable configuration file.
    """
    values: dict[str, Any] = {}
    for path in arguments.configurations():
        values |= dict(_flat(load(path, verb), ""))
    values |= {option.replace(".init_args.", "."): value for option, value in arguments.options}
    if {"help", "print_config"} & values.keys():
        return
    for option, check in checks.items():
        value = values.get(option)
        if isinstance(value, str) and value not in ("", "null") and "${" not in value:
            check(value, option)


def _flat(keys: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    """Values with their keys joined by dots, without ``init_args``."""
    for key, value in keys.items():
        if isinstance(value, Mapping):
            yield from _flat(value, above if key == "init_args" else f"{above}{key}.")
        else:
            yield f"{above}{key}", value


_NOISE = (
    "Does not validate",
    "Subtypes:",
    "Errors:",
    "Expected a <class 'NoneType'>",
    "Given value",
    "Not a valid subclass",
    "Subclass types expect",
    "a class path (str)",
    "a dict with",
)
"""Prefixes of lines of jsonargparse's messages that do not help the user."""
_PLAIN = (
    (r"""(?:Parser )?[Kk]ey "([\w.]+)": """, r"key '\1': "),
    (r"Problem with given class_path '[\w.]*?(\w+)': ", r"\1: "),
    (r"\b\w{1,40}Data: the following arguments are required: (\w+)", r"found no \1; give --data.\1"),
    (r"the following arguments are required: demonstrations$", "expected a model, then a file of demonstrations"),
    (r"Option '(\S+)' is not accepted", r"argument '\1' is not accepted; mend its name"),
    (r"(?:Subcommand|Group) '(\w+)' does not accept option '(\S+)'", r"key '\2' is not accepted; mend its name"),
    (r"Expected an? <class '(\w+)'>\. Got value: ", r"expected \1, found "),
    (r"Importing '(\S+)' is not allowed, denied by .*", r"\1 is not taken from a configuration (docs: Security)"),
    (r"Import path (\S+) does not correspond to a subclass of (\w+)", r"expected a \2, found \1"),
)
"""Patterns of jsonargparse's messages, which have no codes, with plainer texts."""
_KEY = re.compile(r"""(?:[Kk]ey|[Oo]ption) ['"]([\w.]+)['"]""")


def one_line(message: str, verb: str, arguments: Arguments) -> str:
    """Shorten a message of jsonargparse to a single line: file and line, if a configuration file has the key; then the mistake.

    The configuration files of ``arguments`` are searched for the key unless an option names it.
    """
    lines = [line.strip(" -") for line in message.splitlines()]
    relevant = " ".join(line for line in lines if line and not line.startswith(_NOISE))
    plain = relevant
    for pattern, text in _PLAIN:
        plain = re.sub(pattern, text, plain)
    given = {key for option, _ in arguments.options for key in option.split(".")}
    keys = [key.split(".") for key in _KEY.findall(relevant)]
    if keys and keys[-1][-1] not in given:
        for path in (part for name in arguments.configurations() for part, _ in reversed(parts(name, verb))):
            if line := _line(path, keys[-1], set(SECTIONS) - {section_of(verb)}):
                where = f"{path}: line {line}: "
                return f"{where}{short(plain, max(LONGEST - len(where) - 10, 100))}"
    return f"{short(plain, LONGEST - 30)}; see --help"


def option_names(path: str, verb: str) -> list[str]:
    """Names of the options that a configuration file and its defaults set, as on the command line."""
    root = yaml.compose(OmegaConf.to_yaml(OmegaConf.create(load(path, verb))), Loader=yaml.SafeLoader)
    return list(dict.fromkeys(".".join(part for part in names if part != "init_args") for names, _ in _keys(root, ())))


def _line(path: Path, key: Sequence[str], excluded: Set[str]) -> int | None:
    """Line of a key, which may be a suffix, in a YAML file without the excluded sections; ``None`` if it is missing."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):  # reported where it is read
        return None
    matches = ((names, line) for names, line in _keys(root, ()) if names[0] not in excluded)
    return next((line for names, line in matches if names[-1] == key[-1] and set(key) <= set(names)), None)


def _keys(node: yaml.Node | None, above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Every key with its parent keys, and its line from 1."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            names = (*above, str(key.value))
            yield names, key.start_mark.line + 1
            yield from _keys(value, names)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            yield from _keys(value, above)
