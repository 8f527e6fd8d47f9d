"""Command line: a table of verbs. Verbs import what they need when they run, for a fast start."""

import difflib
import inspect
import json
import os
import sys
import warnings
from argparse import ArgumentError
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

from omegaconf.errors import OmegaConfBaseException

from ftl_lightning.cli import concepts, demonstrations, experiments, pages
from ftl_lightning.services import trust
from ftl_lightning.services.command_line import TRAINER, Arguments, check_inputs, command_checks, one_line, option_names
from ftl_lightning.services.errors import LONGEST, Note, UserError, mistake_of_machine, require, short
from ftl_lightning.services.progress import waiting
from ftl_lightning.services.text import any_terminal, line, say
from ftl_lightning.version import __version__


@dataclass(frozen=True)
class Command:
    """Verb without a trainer.

    Attributes:
        summary: line of the overview.
        function, options: what runs, called with the options class, or without it with its own arguments.
        positional: whether required arguments are positional.
        first, several: option that may also be the first positional argument, and option that collects them all.
        repeated: option that may be repeated.
    """

    summary: str
    function: Callable[..., None]
    options: type | None = None
    positional: bool = False
    first: str = ""
    several: str = ""
    repeated: str = ""

    def run(self, verb: str, arguments: Arguments) -> None:
        """Parse the arguments and run."""
        check_inputs(verb, arguments, command_checks(verb))
        from jsonargparse import auto_cli

        trust.allow_classes(("ftl_lightning",))  # stages of an ablation; these verbs accept no other class
        if self.several and arguments.positional:
            gathered = (self.several, json.dumps(arguments.positional))
            arguments = replace(arguments, positional=(), options=(gathered, *arguments.options))
        if values := arguments.values(self.repeated):
            require(all(values), self.repeated, "a value", "none")
            rest = arguments.without(self.repeated)
            arguments = replace(rest, options=(*rest.options, (self.repeated, json.dumps(values))))
        parsed: Any = auto_cli(
            self.options or self.function,
            args=arguments.expanded(verb),
            exit_on_error=False,
            allow_abbrev=False,
            as_positional=self.positional,
            prog=f"python -m ftl_lightning {verb}",
        )
        if self.options:
            self.function(parsed)


TRAINER_VERBS = {
    "fit": "pretrain a model on a domain's training concepts",
    "invert": "learn new concepts from a few demonstrations through a pretrained model; invert MODEL FILE needs no trainer",
    "validate": "validation loss and accuracy of a checkpoint",
    "test": "evaluate a checkpoint and write the results file",
}
COMMANDS: Mapping[str, Command] = {
    "play": Command(
        "show behaviour five times on a page, see it learned, and mix it with other concepts",
        pages.play,
        pages.PlayOptions,
        first="pretrained",
    ),
    "generate": Command("draw demonstrations of a task into a file", demonstrations.generate, positional=True),
    "check": Command(
        "say whether demonstrations of a concept suffice, and which of them is an outlier",
        demonstrations.check,
        demonstrations.CheckOptions,
        positional=True,
    ),
    "sample": Command(
        "generate behaviour from a learned concept, composed with training concepts", concepts.sample, concepts.SampleOptions
    ),
    "view": Command(
        "watch demonstrations, samples, a concept or results on a page", pages.view, pages.ViewOptions, positional=True
    ),
    "concepts": Command(
        "list the concepts of a model: training concepts and learned ones", concepts.concepts, positional=True, repeated="folder"
    ),
    "explain": Command("say in words what a learned concept is made of", concepts.explain),
    "ablate": Command(
        "run every cell of an ablation, those that are missing in the results", experiments.ablate, experiments.AblateOptions
    ),
    "benchmark": Command(
        "run a method through frozen suites, check a submission, make the leaderboard",
        experiments.benchmark,
        experiments.BenchmarkOptions,
        first="method",
    ),
    "report": Command("tables and figures from results, beside the paper's numbers", experiments.report),
    "prepare": Command("read your own copy of a domain's recordings, which do not ship", demonstrations.prepare, positional=True),
    "study": Command(
        "make a web page in which people rate films of generated behaviour", pages.study, pages.StudyOptions, positional=True
    ),
    "study-report": Command("the table of what they answered", pages.study_report, several="answers"),
    "encode": Command("make a domain's table of concept embeddings with a language model", demonstrations.encode, positional=True),
}
_INVERT = Command(TRAINER_VERBS["invert"], concepts.invert, concepts.InvertOptions, positional=True)
"""``invert`` with positional arguments (model and file), which needs no trainer."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb, by default of this process's command line; return 0, or 2 for a user's mistake, 130 for an interruption."""
    verb, *words = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    read = Arguments.read(words)
    any_terminal()
    # Never unpickle, whatever a library's default is.
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"
    try:
        with trust.person(verb, read) as rest, _notes(), _modes():
            _dispatch(verb, rest)
    except UserError as error:
        return _refused(str(error))
    except OmegaConfBaseException as error:
        return _refused(f"configuration: {str(error).splitlines()[0]}")
    except ArgumentError as error:
        return _refused(one_line(str(error), verb, read) + _meant(str(error), verb, read))
    except KeyboardInterrupt:
        return _interrupted()
    except (OSError, MemoryError, RuntimeError, ValueError) as error:
        if (message := mistake_of_machine(error)) is None:
            raise
        return _refused(message)
    except SystemExit as stop:  # after --help and --print_config
        if isinstance(stop.__context__, KeyboardInterrupt):  # Lightning's way
            return _interrupted()
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    return 0


@contextmanager
def _notes() -> Iterator[None]:
    """Print notes about the input as lines, each once."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        shown, before = warnings.showwarning, set[str]()

        def show(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
            if not issubclass(category, Note):
                shown(message, category, *place, **options)
            elif str(message) not in before:
                before.add(str(message))
                say("note:", line(str(message)), error=True)

        warnings.showwarning = show
        yield


def _modes() -> AbstractContextManager[None]:
    """The usual modes of torch, which a program that calls :func:`main` may have changed; torch is not imported for this."""
    if "torch" not in sys.modules:
        return nullcontext()
    from ftl_lightning.services.modes import usual_modes

    return usual_modes()


def _refused(message: str) -> int:
    say("error:", short(line(message), LONGEST + 100), error=True)
    return 2


def _meant(message: str, verb: str, arguments: Arguments) -> str:
    """The known option nearest to an unknown one that a message names; empty without any."""
    if (command := COMMANDS.get(verb, _INVERT if arguments.positional else None)) is not None:
        known = [*inspect.signature(command.options or command.function).parameters]
    else:
        known = [key for path in arguments.configurations() for key in option_names(path, verb)]
    unknown = [name for name, _ in arguments.options if name not in known and name.rpartition(".")[2] in message]
    near = [match for name in unknown for match in difflib.get_close_matches(name, known, 1, cutoff=0.7)]
    return f"; did you mean --{near[0]}?" if near else ""


def _interrupted() -> int:
    say("interrupted: what was written before is whole", error=True)
    return 130


def _dispatch(verb: str, arguments: Arguments) -> None:
    if verb in ("-h", "--help"):
        say(_overview())
    elif verb == "--version":
        say(__version__)
    elif verb in COMMANDS:
        command, positional = COMMANDS[verb], arguments.positional
        if command.first and positional:
            options = ((command.first, positional[0]), *arguments.options)
            arguments = Arguments(positional[1:], options)
        command.run(verb, arguments)
    elif verb == "invert" and arguments.positional:
        _INVERT.run(verb, arguments)
    elif verb in TRAINER_VERBS:
        check_inputs(verb, arguments, TRAINER)
        with waiting("loading"):
            from ftl_lightning.apps.lightning_cli import run

        run(verb, arguments)
    else:
        verbs = (*TRAINER_VERBS, *COMMANDS)
        near = "".join(f"; did you mean {match}?" for match in difflib.get_close_matches(verb, verbs, 1))
        raise UserError(f"verb: expected one of {', '.join(verbs)}, found {verb!r}{near}")


def _overview() -> str:
    verbs = TRAINER_VERBS | {verb: command.summary for verb, command in COMMANDS.items()}
    width = max(map(len, verbs))
    lines = [f"  {verb:<{width}}  {summary}" for verb, summary in verbs.items()]
    usage = "usage: python -m ftl_lightning VERB [--help] [--config FILE] [--trust MODULE] ..."
    trusted = (
        f"{trust.OPTION} MODULE lets a configuration or a model's folder ask for code of this module, in the current folder too"
    )
    return "\n".join((usage, "", *lines, "", trusted))
