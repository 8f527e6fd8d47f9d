"""One-line messages for jsonargparse errors, with file and line of the wrong key."""

import re
from collections.abc import Iterator, Sequence, Set
from pathlib import Path

import yaml

from ftl_lightning.services.configuration import SECTIONS, configurations, parts, section_of
from ftl_lightning.services.errors import LONGEST, short
from ftl_lightning.services.inputs import options

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
"""Prefixes of lines that do not help the user."""
_PLAIN = (
    (re.compile(r"""(?:Parser )?[Kk]ey "([\w.]+)": """), r"key '\1': "),
    (re.compile(r"Problem with given class_path '[\w.]*?(\w+)': "), r"\1: "),
    (re.compile(r"Option '(\S+)' is not accepted"), r"argument '\1' is not accepted; mend its name"),
    (
        re.compile(r"(?:Subcommand|Group) '(\w+)' does not accept option '(\S+)'"),
        r"key '\2' is not accepted; mend its name",
    ),
    (re.compile(r"Expected an? <class '(\w+)'>\. Got value: "), r"expected \1, found "),
    (
        re.compile(r"Importing '(\S+)' is not allowed, denied by .*"),
        r"\1 is not taken from a configuration (docs: Security)",
    ),
    (re.compile(r"Import path (\S+) does not correspond to a subclass of (\w+)"), r"expected a \2, found \1"),
)
_KEY = re.compile(r"""(?:[Kk]ey|[Oo]ption) ['"]([\w.]+)['"]""")


def one_line(message: str, arguments: Sequence[str]) -> str:
    """Message in one line.

    Args:
        message: message of jsonargparse.
        arguments: command line; its configuration files are searched for the key unless an option names it.

    Returns:
        File and line, if a file has the key; then the mistake.
    """
    lines = [line.strip(" -") for line in message.splitlines()]
    relevant = " ".join(line for line in lines if line and not line.startswith(_NOISE))
    plain = relevant
    for pattern, text in _PLAIN:
        plain = pattern.sub(text, plain)
    given = {key for option, _ in options(arguments) for key in option.split(".")}
    keys = [key.split(".") for key in _KEY.findall(relevant)]
    if keys and keys[-1][-1] not in given:
        verb = arguments[0]
        for path in (part for name in configurations(arguments) for part, _ in reversed(parts(name, verb))):
            if line := _line(path, keys[-1], set(SECTIONS) - {section_of(verb)}):
                where = f"{path}: line {line}: "
                return f"{where}{short(plain, max(LONGEST - len(where) - 10, 100))}"
    return f"{short(plain, LONGEST - 30)}; see --help"


def _line(path: Path, key: Sequence[str], out: Set[str]) -> int | None:
    """Line of a key, which may be a suffix, in a YAML file without the sections ``out``; ``None`` if it is missing."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):  # reported where it is read
        return None
    matches = ((names, line) for names, line in _keys(root, ()) if names[0] not in out)
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
