"""Verbs with a trainer: Lightning's command line and ``invert``."""

import logging
import sys
import warnings
from argparse import ArgumentError
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

import lightning.pytorch as pl
from jsonargparse import Namespace, set_parsing_settings
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import OmegaConf

from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.services import log_folder, trust
from ftl_lightning.services.command_line import Arguments
from ftl_lightning.services.configuration import parts
from ftl_lightning.services.errors import UserError, mistake_behind, require, short
from ftl_lightning.services.store import modified
from ftl_lightning.services.text import counted, say
from ftl_lightning.services.validation import check_range
from ftl_lightning.training.board import TrainingBar, accuracies
from ftl_lightning.training.checkpoint import last_checkpoint, read_checkpoint
from ftl_lightning.training.model_folder import sampling_command
from ftl_lightning.training.trainer import Trainer, one_voice

NAMED = 3
"""Number of training concepts that are printed."""
LOGS = Path("logs")
"""Folder of the files of runs without a logger."""


class CommandLine(LightningCLI):
    """Lightning's command line with the verb ``invert``."""

    trainer: Trainer

    def __init__(self, verb: str, model: type, data: type, **options: Any) -> None:
        self._verb = verb
        super().__init__(model, data, **options)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """The requested verb and its non-option arguments; parsers of all verbs would take a third of the start-up time."""
        verbs = LightningCLI.subcommands() | {"invert": {"model", "datamodule"}}
        return {verb: names for verb, names in verbs.items() if verb == self._verb}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add a common default seed and the evaluator's options."""
        parser.add_lightning_class_args(Evaluator, "evaluation")
        parser.set_defaults({"seed_everything": 0, "trainer.enable_model_summary": False})

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse arguments, and refuse a seed that numpy does not accept."""
        super().parse_arguments(parser, args)
        verb = self.config.get("subcommand")
        config = self.config[verb] if verb else self.config
        self._expect_keys(config, args)
        for key in ("model", "data"):
            _expect_values(key, config.get(key), [option for option, _ in Arguments.read(args).options])
        seed = config.get("seed_everything")
        if isinstance(seed, int) and not isinstance(seed, bool):
            check_range("seed_everything", seed, 0, 2**32 - 1)

    @staticmethod
    def _expect_keys(known: Namespace, arguments: Sequence[str]) -> None:
        """Refuse an unknown key without subkeys in a configuration, which jsonargparse accepts."""
        for text in Arguments.read(arguments).values("config"):
            keys = OmegaConf.to_container(OmegaConf.create(text)) if ":" in text else {}
            for key in keys if isinstance(keys, dict) else ():
                if key not in known.as_dict():
                    raise ArgumentError(None, f"Group 'configuration' does not accept option '{short(str(key))}'")

    def instantiate_classes(self) -> None:
        """Build everything; model and data must have the same seed, as Lightning logs a single seed."""
        with trust.vouching(self._domains()):
            try:
                super().instantiate_classes()
            except (ValueError, MisconfigurationException) as error:
                message = _behind(error)
                raise mistake_behind(error) or UserError(f"configuration: {short(message, 230)}; see --help") from error
        model, data = (getattr(module, "hparams", {}).get("seed") for module in (self.model, self.datamodule))
        if model is not None and data is not None and model != data:
            raise UserError(f"model.seed: expected {data} (data.seed), found {model}; give --seed_everything, which sets both")

    def _domains(self) -> list[str]:
        """The configured domain, if any, which a pretrained model's folder may then use; an untrusted module is refused."""
        options = (self._get(self.config, "data") or {}).get("init_args") or {}
        domain = options.get("domain")
        if not isinstance(domain, str) or ":" not in domain:
            return []
        trust.check_module(domain, "data.domain")
        return [domain]

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """The trainer, with this package's progress bar."""
        configured = self._get(self.config_init, "trainer")
        callbacks = list(configured["callbacks"] or [])
        if configured["enable_progress_bar"] is not False and not any(isinstance(callback, ProgressBar) for callback in callbacks):
            callbacks.append(TrainingBar())
        return super().instantiate_trainer(**kwargs, callbacks=callbacks)

    def before_instantiate_classes(self) -> None:
        """Claim a log folder that no concurrent run uses: a new folder for an inversion, ``invert``, then ``invert_1`` and so on. A
        pretraining reuses the folder of an earlier run unless that is running. A run from a checkpoint uses the given folder. A run
        without a logger is given such a folder below ``logs``, since its files would be in the current folder.
        """
        if getattr(rank_zero_only, "rank", 0):  # the first process of a run claims the folder
            return
        trainer = self._get(self.config, "trainer")
        logger = trainer.get("logger")
        if (logger in (False, []) or trainer.get("fast_dev_run")) and trainer.get("default_root_dir") is None:
            trainer["default_root_dir"] = str(LOGS / self._claimed(LOGS, self._verb))
            return
        options = logger.get("init_args") if isinstance(logger, Namespace) else None
        if not options or not isinstance(options.get("version"), str) or not {"save_dir", "name"} <= set(options.keys()):
            return
        folder, name = Path(options["save_dir"]) / (options["name"] or ""), options["version"]
        options["version"] = self._claimed(folder, name)

    def _claimed(self, folder: Path, name: str) -> str:
        """Name of the log folder in a folder, claimed by verbs that learn."""
        if self._verb == "fit" and self._get(self.config, "ckpt_path"):
            log_folder.hold(folder / name)
        elif self._verb in ("fit", "invert"):
            return log_folder.claim(folder, name, new=self._verb == "invert")
        return name

    def _model_folder(self) -> str:
        """Folder of the model that ``fit`` writes."""
        return str(self.model.hparams.get("output") or Path(self.trainer.log_dir or self.trainer.default_root_dir) / "pretrained")

    def after_fit(self) -> None:
        """Print the folder of the model, and how to learn a concept with it."""
        say(", ".join((f"pretrained model: {self._model_folder()}", *accuracies(self.trainer))))
        say(f"to learn a concept: python -m ftl_lightning invert {self._model_folder()} FILE")

    def before_invert(self) -> None:
        """Print the model and some of its training concepts."""
        concepts = self.model.model.config.training_concepts
        some = ", ".join(short(text, 30) for text in concepts[:NAMED]) + (", ..." if len(concepts) > NAMED else "")
        say(f"model: {self.model.hparams['pretrained']} ({counted(len(concepts), 'training concept')}: {some})")

    def after_invert(self) -> None:
        """Print how to sample the first concept, and the log folder."""
        name, path = next(iter(self.model.files.items()))
        say(f"to sample: {sampling_command(self.model.hparams['pretrained'], name, path, self.model.domain)}")
        say(f"logged in {self.trainer.log_dir or self.trainer.default_root_dir}")

    def before_validate(self) -> None:
        """Require a checkpoint; Lightning would evaluate random weights."""
        self.before_fit()
        if not self.config_init[self._verb].get("ckpt_path"):
            raise UserError(f"ckpt_path: {self._verb} expected a checkpoint file, found none; give --ckpt_path FILE")

    before_test = before_validate

    def before_fit(self) -> None:
        """Resolve ``last`` to the path of the last checkpoint; without any, the run starts from the beginning, with a note."""
        options = self.config_init[self._verb]
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")  # as is meant
        if self._verb == "fit" and not options.get("ckpt_path") and modified(f"{self._model_folder()}/config.json"):
            say(f"note: {self._model_folder()}: is replaced", error=True)
        if options.get("ckpt_path") == "last":
            options["ckpt_path"] = last_checkpoint(self.trainer)
            if options["ckpt_path"] is None and self._verb == "fit":
                say(f"ckpt_path: no last checkpoint in {self.trainer.log_dir}; fit starts from the beginning")

    def _parse_ckpt_path(self) -> None:
        # Lightning would override configuration and command line by the checkpoint's hyper-parameters, class included.
        # Here the configuration takes precedence, and a checkpoint of another class is refused.
        path = self.config[self.config.subcommand].get("ckpt_path") if "subcommand" in self.config else None
        if path and path != "last":
            read_checkpoint(path)


def _expect_values(key: str, values: Namespace | None, given: Sequence[str]) -> None:
    """Refuse values that jsonargparse accepts: null for an argument without ``None``, and abbreviated names in option groups.
    Arguments are ``model`` or ``data``, parsed values, and names of options on the command line.
    """
    if values is None or "class_path" not in values:
        return
    module, _, name = values["class_path"].rpartition(".")
    hints: dict[str, Any] = {}
    for base in reversed(getattr(sys.modules.get(module), name, object).__mro__):
        with suppress(Exception):  # foreign annotations may not resolve
            hints |= get_type_hints(vars(base)["__init__"])
    groups = {name: get_type_hints(hint) for name, hint in hints.items() if is_dataclass(hint)}
    in_groups = {f"{name}.{option}": hint for name, options in groups.items() for option, hint in options.items()}
    for option in given:
        name = option.removeprefix(f"{key}.init_args.").removeprefix(f"{key}.")
        if option.startswith(f"{key}.") and name.partition(".")[0] in groups and name not in groups and name not in in_groups:
            raise ArgumentError(None, f"Option '{key}.{name}' is not accepted")
    for name, value in (values.get("init_args") or Namespace()).items(branches=True):
        hint = (hints | in_groups).get(name)
        if value is None and hint in (int, float, str, bool):
            raise ArgumentError(None, f'Key "{key}.{name}": Expected a {hint}. Got value: null')
        if value is None and name in groups:
            raise ArgumentError(None, f'Key "{key}.{name}": expected some of {", ".join(groups[name])}, found null')
        if value is None and name in in_groups and NoneType not in get_args(hint):
            raise ArgumentError(None, f'Key "{key}.{name}": expected a value, found null')


GROUPS = ("adapter", "budget", "codes", "embeddings", "loss", "modes", "weights")  # option groups of shipped modules


def _null_in_groups(arguments: Arguments) -> Arguments:
    """Rewrite ``--model.GROUP.OPTION null`` as ``--model.GROUP={"OPTION": null}``; the parser reads the former as a text."""
    options = []
    for option, value in arguments.options:
        group, dot, name = option.removeprefix("model.").removeprefix("init_args.").partition(".")
        null = option.startswith("model.") and dot and group in GROUPS and value == "null"
        options.append((f"model.{group}", f'{{"{name}": null}}') if null else (option, value))
    return replace(arguments, options=tuple(options))


def _behind(error: BaseException) -> str:
    """Message of the root cause of an exception."""
    while behind := error.__cause__ or error.__context__:
        error = behind
    return str(error)


class _SaveConfig(SaveConfigCallback):
    """Write the configuration of a run once its checkpoint, if any, is accepted."""

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        if stage != "fit":
            super().setup(trainer, pl_module, stage)

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        super().setup(trainer, pl_module, "fit")


class _Parser(CommandLine):
    """Parse without building anything."""

    def instantiate_classes(self) -> None:
        """Nothing."""

    before_instantiate_classes = instantiate_classes


def run(verb: str, arguments: Arguments) -> None:
    """Parse and run one of Lightning's verbs or ``invert``."""
    given = any(option in ("c", "config", "model", "model.class_path") or "help" in option for option, _ in arguments.options)
    require(given, "config", "--config FILE, such as conf/own.yaml", "none")
    with one_voice(), log_folder.run():
        _command_line(CommandLine, verb, arguments, run=True)


def build(verb: str, options: list[str]) -> CommandLine:
    """Parse the options of ``fit`` or ``invert`` and build trainer, model and data without running anything."""
    line = _command_line(CommandLine, verb, Arguments.read(options), run=False)
    line.trainer.check_alone("what another program runs")  # other processes would repeat its command line
    return line


def parse(verb: str, options: list[str]) -> dict[str, Any]:
    """Parse the options of a verb to values by key; nothing is built."""
    config: dict[str, Any] = _command_line(_Parser, verb, Arguments.read(options), run=False).config.as_dict()
    return config


PACKAGES = ("ftl_lightning", "lightning", "lightning_fabric", "pytorch_lightning", "torch", "torchmetrics")
"""Packages with classes that configurations may name."""


def _expect_trusted(verb: str, arguments: Arguments) -> None:
    """Allow a configuration only classes of packages that are installed or trusted by the user; others are a UserError."""
    packages = set(PACKAGES)
    sources = [(str(path), keys) for given in arguments.configurations() for path, keys in parts(given, verb)]
    for where, keys in (*sources, ("options", dict(arguments.options))):
        trust.check_classes(keys, where)
        packages |= trust.allowed(keys)
    trust.allow_classes(packages)
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)


def _command_line(kind: type[CommandLine], verb: str, arguments: Arguments, run: bool) -> CommandLine:
    _expect_trusted(verb, arguments)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")  # data are in memory
    warnings.filterwarnings("ignore", message=".*`IterableDataset` has `__len__` defined.*")  # there are no workers
    warnings.filterwarnings("ignore", message=".*module.s. in eval mode at the start of training.*")  # averaged or frozen
    warnings.filterwarnings("ignore", message=".*a checkpoint that ended before the epoch ended.*")  # steps are stateless
    warnings.filterwarnings("ignore", message=".*is smaller than the logging interval.*")  # in short runs
    warnings.filterwarnings("ignore", message=".*LightningCLI's args parameter is intended.*")
    warnings.filterwarnings("ignore", message=".*`isinstance.treespec, LeafSpec.` is deprecated.*")  # within Lightning
    for name in ("lightning.pytorch", "lightning.fabric"):  # advice and advertisements; warnings and errors stay
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric.strategies.launchers").setLevel(logging.INFO)  # reports a process that ended early
    try:
        return kind(
            verb,
            pl.LightningModule,
            pl.LightningDataModule,
            trainer_class=Trainer,
            subclass_mode_model=True,
            subclass_mode_data=True,
            save_config_callback=_SaveConfig,
            save_config_kwargs={"overwrite": True},
            auto_configure_optimizers=False,  # modules configure their optimiser: model.learning_rate, model.weight_decay
            parser_kwargs={"parser_mode": "omegaconf+", "exit_on_error": False, "allow_abbrev": False},
            run=run,
            args=[*([verb] if run else ()), *_null_in_groups(arguments).expanded(verb)],
        )
    except OSError as error:
        raise UserError(
            f"{error.filename or 'output'}: {error.strerror or error}; choose a place that exists, is writable and has room"
        ) from error
    except MisconfigurationException as error:
        raise UserError(f"trainer: {short(str(error), 200)}") from error
    except Exception as error:
        if mistake := mistake_behind(error):
            raise mistake from None
        raise
