"""What jsonargparse tells of a mistake in many lines, in one, with the file and line that the mistaken key stands in."""

import re
from collections.abc import Iterator, Sequence, Set
from pathlib import Path

import yaml

from ftl_lightning.configuration import SECTIONS, configurations, parts, section_of
from ftl_lightning.errors import LONGEST, short
from ftl_lightning.inputs import options

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
"""How lines begin that say nothing to whoever wrote the key."""
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
    """The mistake in one line.

    Args:
        message: of jsonargparse.
        arguments: of the command line, whose configuration files are searched for the key unless an option names it.

    Returns:
        File and line, if the key is found in one of them; then what is wrong.
    """
    lines = [line.strip(" -") for line in message.splitlines()]
    told = " ".join(line for line in lines if line and not line.startswith(_NOISE))
    plain = told
    for pattern, text in _PLAIN:
        plain = pattern.sub(text, plain)
    given = {key for option, _ in options(arguments) for key in option.split(".")}
    keys = [key.split(".") for key in _KEY.findall(told)]
    if keys and keys[-1][-1] not in given:
        verb = arguments[0]
        for path in (part for name in configurations(arguments) for part, _ in reversed(parts(name, verb))):
            if line := _line(path, keys[-1], set(SECTIONS) - {section_of(verb)}):
                where = f"{path}: line {line}: "
                return f"{where}{short(plain, max(LONGEST - len(where) - 10, 100))}"
    return f"{short(plain, LONGEST - 30)}; see --help"


def _line(path: Path, key: Sequence[str], out: Set[str]) -> int | None:
    """The line of a key, of which at least the end is known, in a YAML file outside of some sections; ``None`` without one."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):  # told where it is read
        return None
    found = ((names, line) for names, line in _keys(root, ()) if names[0] not in out)
    return next((line for names, line in found if names[-1] == key[-1] and set(key) <= set(names)), None)


def _keys(node: yaml.Node | None, above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Every key with those above it, and its line from 1."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            names = (*above, str(key.value))
            yield names, key.start_mark.line + 1
            yield from _keys(value, names)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            yield from _keys(value, above)
