"""The verbs that need a trainer: Lightning's command line with ``invert`` added."""

import logging
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from jsonargparse import set_parsing_settings
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from ftl_lightning.configuration import expanded
from ftl_lightning.errors import UserError, mistake_behind
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.trainer import Trainer


class CommandLine(LightningCLI):
    """Lightning's command line; see its documentation for everything but ``invert``."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """The verbs, each with the arguments that are not options of it."""
        verbs = LightningCLI.subcommands()
        del verbs["predict"]  # `sample` is the verb for that
        return verbs | {"invert": {"model", "datamodule"}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """One seed for everything, unless a configuration says otherwise, and the evaluator's options."""
        parser.add_lightning_class_args(Evaluator, "evaluation")
        parser.set_defaults({"seed_everything": 0})

    def before_validate(self) -> None:
        """A checkpoint is needed; Lightning would evaluate random weights."""
        self._need_checkpoint()

    def before_test(self) -> None:
        """The same."""
        self._need_checkpoint()

    def _need_checkpoint(self) -> None:
        if not self.config[self.config.subcommand].get("ckpt_path"):
            raise UserError(f"ckpt_path: {self.config.subcommand} expected a checkpoint file, found none; give --ckpt_path FILE")

    def _parse_ckpt_path(self) -> None:
        # Lightning would let the checkpoint's hyper-parameters, class included, override configuration and command line.
        # Here the configuration rules, and a checkpoint of another class is refused.
        path = self.config[self.config.subcommand].get("ckpt_path") if "subcommand" in self.config else None
        if path and path not in ("last", "best"):
            if not Path(path).is_file():
                raise UserError(f"ckpt_path: expected a checkpoint file, 'last' or 'best', found {path!r}, which does not exist")
            try:
                torch.load(path, weights_only=True, map_location="cpu")
            except Exception as error:  # torch raises several kinds, none of its own
                raise UserError(f"{path}: expected a checkpoint, found a damaged or foreign file") from error


class _Parser(CommandLine):
    """The same without building anything."""

    def instantiate_classes(self) -> None:
        """Nothing."""


def run(arguments: list[str]) -> None:
    """Parse and run one of Lightning's verbs or ``invert``."""
    _command_line(CommandLine, arguments, run=True)


def build(options: list[str]) -> CommandLine:
    """Parse the options of a verb and build trainer, model and data without running anything."""
    return _command_line(CommandLine, options, run=False)


def parse(options: list[str]) -> dict[str, Any]:
    """What the options of a verb come to, by key; nothing is built."""
    found: dict[str, Any] = _command_line(_Parser, options, run=False).config.as_dict()
    return found


def _command_line(kind: type[CommandLine], arguments: list[str], run: bool) -> CommandLine:
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")  # data are in memory
    warnings.filterwarnings("ignore", message=".*`IterableDataset` has `__len__` defined.*")  # there are no workers
    warnings.filterwarnings("ignore", message=".*module.s. in eval mode at the start of training.*")  # averaged or frozen
    warnings.filterwarnings(
        "ignore", message=".*resuming from a checkpoint that ended before the epoch ended.*"
    )  # steps are stateless
    warnings.filterwarnings("ignore", message=".*LightningCLI's args parameter is intended.*")
    warnings.filterwarnings("ignore", message=".*`isinstance.treespec, LeafSpec.` is deprecated.*")  # within Lightning
    for name in ("lightning.pytorch", "lightning.fabric"):  # advice and advertisements; warnings and errors stay
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        return kind(
            pl.LightningModule,
            pl.LightningDataModule,
            trainer_class=Trainer,
            subclass_mode_model=True,
            subclass_mode_data=True,
            save_config_kwargs={"overwrite": True},
            parser_kwargs={"parser_mode": "omegaconf+", "exit_on_error": False},
            run=run,
            args=expanded(arguments),
        )
    except OSError as error:
        raise UserError(
            f"{error.filename or 'output'}: {error.strerror or error}; choose a place that exists, is writable and has room"
        ) from error
    except Exception as error:
        if mistake := mistake_behind(error):
            raise mistake from None
        raise
