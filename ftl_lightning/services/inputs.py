"""Early checks of files in a command line, before slow imports: inputs exist, and outputs are writable."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ftl_lightning.services.configuration import configurations, load
from ftl_lightning.services.data_names import INFO, read_from, written_to
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.extras import check_extra
from ftl_lightning.services.limits import MOST_TEXT, check_readable
from ftl_lightning.services.shipped import missing_model, pretrained_folder, shipped
from ftl_lightning.services.targets import check_new_folder, check_writable_file, check_writable_folder

Check = Callable[[str], None]
"""Raises a :class:`UserError` for an invalid path."""


def _model(path: str) -> None:
    if not (pretrained_folder(path) / "config.json").is_file():
        raise UserError(missing_model(path))


def _checkpoint(path: str) -> None:
    if path == "last":
        return
    with about("ckpt_path"):
        check_readable(path, "checkpoint")


def _demonstrations(path: str) -> None:
    kind, name = read_from(path)
    if kind == "lerobot":
        check_readable(Path(name) / INFO, "LeRobot info", MOST_TEXT)
    elif kind == "file":
        check_readable(name, "demonstrations")


def _concept(path: str) -> None:
    check_readable(shipped(path), "concept")


def _file(kind: str, most: int | None = None) -> Check:
    def check(path: str) -> None:
        check_readable(path, kind, most)

    return check


def _written(key: str, expect: Callable[[str, str], None] = check_writable_file) -> Check:
    def check(path: str) -> None:
        expect(path, key)

    return check


def _written_demonstrations(path: str) -> None:
    kind, name = written_to(path)
    if kind == "file":
        return check_writable_file(name, "out")
    check_extra(kind, f"out: {short(path)}: this data set")
    if kind == "lerobot":
        check_new_folder(name, "out")
        check_writable_folder(name, "out")


def _table(path: str) -> None:
    if path.endswith(".npz"):
        raise UserError(f"out: expected a name that ends in .safetensors, which is what is written, found {path!r}")
    check_writable_file(path, "out")


def _added(key: str) -> Check:
    """Check of a results file that rows are appended to."""

    def check(path: str) -> None:
        _written(key)(path)
        if Path(path).exists():
            check_readable(path, "results", MOST_TEXT)

    return check


TRAINER: Mapping[str, Check] = {
    "model.pretrained": _model,
    "data.demonstrations": _demonstrations,
    "ckpt_path": _checkpoint,
    "model.output": _written("model.output", check_writable_folder),
    "evaluation.results": _added("evaluation.results"),
    "evaluation.films": _written("evaluation.films"),
}
"""Checks of verbs with a trainer, by option without ``init_args``, as on the command line."""
_COMMANDS: Mapping[str, Check] = {"pretrained": _model, "concept": _concept, "initial": _demonstrations}
_OUT: Mapping[str, Check] = {"out": _written_demonstrations}
_FOLDER: Mapping[str, Check] = {"out": _written("out", check_writable_folder)}
_WRITTEN: Mapping[str, Mapping[str, Check]] = {
    "generate": _OUT,
    "check": {"figure": _written("figure")},
    "encode": {"out": _table},
    "invert": _FOLDER,
    "sample": {**_OUT, **{key: _written(key) for key in ("figure", "animation", "export")}},
    "ablate": {"results": _added("results"), "slurm": _written("slurm")},
    "benchmark": {
        "out": _written("out"),
        "check": _file("submission", MOST_TEXT),
        "leaderboard": _written("leaderboard"),
        "data": _written("data", check_writable_folder),
    },
    "report": {**_FOLDER, "readme": _file("Markdown", MOST_TEXT), "html": _written("html")},
    "play": {"demonstrations": _file("demonstrations"), "static": _written("static", check_writable_folder)},
    "prepare": _FOLDER,
    "study": {**_FOLDER, "consent": _file("text", MOST_TEXT)},
}


def command_checks(verb: str) -> Mapping[str, Check]:
    """Checks of a verb without a trainer."""
    return {**_COMMANDS, **_WRITTEN.get(verb, {})}


def check_inputs(verb: str, arguments: Sequence[str], checks: Mapping[str, Check]) -> None:
    """Refuse a command line, configuration files included, with missing input files or invalid outputs.

    Args:
        verb: verb whose sections of configuration files apply.
        arguments: arguments after the verb.
        checks: checks by option.

    Raises:
        UserError: for the first such file, or an unreadable configuration file.
    """
    values: dict[str, Any] = {}
    for path in configurations(arguments):
        values |= dict(_flat(load(path, verb), ""))
    values |= {option.replace(".init_args.", "."): value for option, value in options(arguments)}
    if {"help", "print_config"} & values.keys() or "-h" in arguments:
        return
    for option, check in checks.items():
        value = values.get(option)
        if isinstance(value, str) and value not in ("", "null") and "${" not in value:
            check(value)


def _flat(keys: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    """Values with their keys joined by dots, without ``init_args``."""
    for key, value in keys.items():
        if isinstance(value, Mapping):
            yield from _flat(value, above if key == "init_args" else f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def options(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Options with their values, given as ``--option=value`` or ``--option value``."""
    for argument, following in zip(arguments, [*arguments, ""][1:], strict=True):
        if argument.startswith("--"):
            option, equals, value = argument[2:].partition("=")
            yield option, value if equals else following
