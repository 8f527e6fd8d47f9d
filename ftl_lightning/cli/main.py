"""Command line, with lazy imports for a fast start of verbs without a trainer."""

import importlib
import json
import os
import sys
from argparse import ArgumentError
from collections.abc import Sequence
from typing import Any

from omegaconf.errors import OmegaConfBaseException

from ftl_lightning.services import inputs, trust
from ftl_lightning.services.configuration import expanded
from ftl_lightning.services.errors import UserError, mistake_of_machine
from ftl_lightning.services.parse_error import one_line
from ftl_lightning.services.printing import any_terminal, line, say
from ftl_lightning.services.starting import imported
from ftl_lightning.version import __version__

TRAINER_VERBS = {
    "fit": "pretrain a model on a domain's training concepts",
    "invert": "learn new concepts from a few demonstrations through a pretrained model; invert MODEL FILE needs no trainer",
    "validate": "validation loss and accuracy of a checkpoint",
    "test": "evaluate a checkpoint and write the results file",
}
COMMANDS = {
    "play": "show behaviour five times on a page, see it learned, and mix it with other concepts",
    "generate": "draw demonstrations of a task into a file",
    "check": "say whether demonstrations of a concept suffice, and which of them is odd",
    "sample": "generate behaviour from a learned concept, composed with training concepts",
    "view": "watch demonstrations, samples, a concept or results on a page",
    "concepts": "list the concepts of a model: training concepts and learned ones",
    "explain": "say in words what a learned concept is made of",
    "ablate": "run every cell of an ablation, those that are missing in the results",
    "benchmark": "run a method through frozen suites, check a submission, make the leaderboard",
    "report": "tables and figures from results, beside the paper's numbers",
    "prepare": "read your own copy of a domain's recordings, which do not ship",
    "study": "make a web page in which people rate films of generated behaviour",
    "study-report": "the table of what they answered",
    "encode": "make a domain's table of concept embeddings with a language model",
}
POSITIONAL = {"check", "concepts", "generate", "encode", "invert", "prepare", "study", "view"}
"""Commands with positional required arguments."""
FIRST = {"play": "pretrained", "benchmark": "method"}
"""Option of a command that may also be its first positional argument."""
SEVERAL = {"study-report": "answers"}
"""Option of a command that collects positional files."""
REPEATED = {"concepts": "folder"}
"""Option of a command that may be repeated."""
MODULES = {
    "ablate": "ftl_lightning.cli.ablate_command",
    "benchmark": "ftl_lightning.cli.benchmark_command",
    "check": "ftl_lightning.cli.check_command",
    "invert": "ftl_lightning.cli.invert_command",
    "play": "ftl_lightning.cli.play_command",
    "sample": "ftl_lightning.cli.sampling_command",
    "view": "ftl_lightning.cli.play_command",
}
"""Modules of commands that are not in ``commands``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        arguments: command-line arguments without the program's name.

    Returns:
        Exit code: 0; 2 for a user's mistake, or 130 for an interruption, each with a line on standard error.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    any_terminal()
    # Never unpickle, whatever a library's default is.
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"
    try:
        with trust.person(arguments) as rest:
            _dispatch(rest)
    except UserError as error:
        say("error:", line(str(error)), error=True)
        return 2
    except OmegaConfBaseException as error:
        say("error: configuration:", line(str(error).splitlines()[0]), error=True)
        return 2
    except ArgumentError as error:
        say("error:", line(one_line(str(error), arguments)), error=True)
        return 2
    except KeyboardInterrupt:
        return _interrupted()
    except (OSError, MemoryError, RuntimeError, ValueError) as error:
        if (message := mistake_of_machine(error)) is None:
            raise
        say("error:", line(message), error=True)
        return 2
    except SystemExit as stop:  # after --help and --print_config
        if isinstance(stop.__context__, KeyboardInterrupt):  # Lightning's way
            return _interrupted()
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    return 0


def _interrupted() -> int:
    say("interrupted: what was written before is whole", error=True)
    return 130


def _dispatch(arguments: list[str]) -> None:
    verb = arguments[0] if arguments else "--help"
    if verb in FIRST and len(arguments) > 1 and not arguments[1].startswith("-"):
        arguments = [verb, f"--{FIRST[verb]}={arguments[1]}", *arguments[2:]]
    if verb in ("-h", "--help"):
        say(_overview())
    elif verb == "--version":
        say(__version__)
    elif verb in COMMANDS or (verb == "invert" and _by_position(arguments[1:])):
        inputs.check_inputs(verb, arguments[1:], inputs.command_checks(verb))
        from jsonargparse import auto_cli

        trust.allow_classes(("ftl_lightning",))  # stages of an ablation; these verbs accept no other class
        commands = importlib.import_module(MODULES.get(verb, "ftl_lightning.cli.commands"))
        name = verb.replace("-", "_")
        function, kind = getattr(commands, name), getattr(commands, f"{name.capitalize()}Options", None)
        options: dict[str, Any] = {"as_positional": verb in POSITIONAL, "prog": f"python -m ftl_lightning {verb}"}
        given = _gathered(arguments[1:], SEVERAL[verb]) if verb in SEVERAL else arguments[1:]
        given = _repeated(given, REPEATED[verb]) if verb in REPEATED else given
        parsed = auto_cli(kind or function, args=expanded(given, verb), exit_on_error=False, **options)
        if kind:  # an options class
            function(parsed)
    elif verb in TRAINER_VERBS:
        inputs.check_inputs(verb, arguments[1:], inputs.TRAINER)
        imported("ftl_lightning.apps.lightning_cli").run(arguments)
    else:
        raise UserError(f"verb: expected one of {', '.join((*TRAINER_VERBS, *COMMANDS))}, found {verb!r}")


def _by_position(arguments: Sequence[str]) -> bool:
    """Whether ``invert`` has positional arguments (model and file), which needs no trainer."""
    return bool(arguments) and not arguments[0].startswith("-")


def _gathered(arguments: list[str], option: str) -> list[str]:
    """Collect leading positional arguments in a list for an option."""
    count = next((index for index, argument in enumerate(arguments) if argument.startswith("-")), len(arguments))
    return [f"--{option}={json.dumps(arguments[:count])}", *arguments[count:]] if count else arguments


def _repeated(arguments: list[str], option: str) -> list[str]:
    """Collect the values of a repeated option in a list."""
    values, rest, left = [], [], iter(arguments)
    for argument in left:
        name, equals, value = argument.partition("=")
        if name != f"--{option}":
            rest.append(argument)
            continue
        if not (value := value if equals else next(left, "")):
            raise UserError(f"{option}: expected a value, found none")
        values.append(value)
    return [*rest, f"--{option}={json.dumps(values)}"] if values else rest


def _overview() -> str:
    verbs = TRAINER_VERBS | COMMANDS
    width = max(map(len, verbs))
    lines = [f"  {verb:<{width}}  {summary}" for verb, summary in verbs.items()]
    usage = "usage: python -m ftl_lightning VERB [--help] [--config FILE] [--trust MODULE] ..."
    trusted = (
        f"{trust.OPTION} MODULE lets a configuration or a model's folder ask for code of this module, in the current folder too"
    )
    return "\n".join((usage, "", *lines, "", trusted))
