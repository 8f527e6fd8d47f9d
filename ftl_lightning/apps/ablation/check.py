"""Check a plan before it runs."""

import importlib
from argparse import ArgumentError
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import pretrained_folder
from ftl_lightning.services.trust import check_module

if TYPE_CHECKING:
    from ftl_lightning.training.adaptation import Adaptation


def check(cells: Sequence[Cell]) -> None:
    """Check files, keys and encoder of each cell and, for ``invert``, domain, suites and model.

    Raises:
        UserError: all mistakes in one line; nothing was started.
    """
    made = {cell.options["model.output"] for cell in cells if cell.verb == "fit" and "model.output" in cell.options}
    mistakes = {}
    for cell in cells:
        try:
            _check(cell, made)
        except (UserError, ArgumentError) as error:
            mistakes[cell.command] = " ".join(str(error).split())
    if mistakes:
        messages = dict.fromkeys(mistakes.values())
        raise UserError(f"ablation: {len(mistakes)} of {len(cells)} cells cannot run, none was started: {'; '.join(messages)}")


def _check(cell: Cell, made: set[str]) -> None:
    from ftl_lightning.apps.lightning_cli import parse
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.networks.text_encoder import load_encoder
    from ftl_lightning.training.method import kinds_for, model_class
    from ftl_lightning.training.model_config import read_config

    config = parse(cell.verb, cell.arguments)
    model, data = config["model"]["init_args"], config["data"]["init_args"]
    if cell.verb == "fit":
        load_encoder(data["encoder"], Path(), data["revision"])
        return
    if "pretrained" not in model or "domain" not in data:
        files = ", ".join(cell.configs)
        raise UserError(f"verb: {files}: expected the configuration of an adaptation (invert), found that of a pretraining (fit)")
    if ":" in data["domain"]:
        check_module(data["domain"], "data.domain")
    domain = load_domain(data["domain"])
    for key, names in (("evaluation.suites", config["evaluation"]["suites"] or ()), ("data.suite", [data["suite"]])):
        if unknown := set(names) - set(domain.concepts.suites):
            expected = ", ".join(domain.concepts.suites)
            raise UserError(f"{key}: expected some of {expected} (domain {domain.name}), found {', '.join(sorted(unknown))}")
    if model["pretrained"] not in made:
        adaptation = _class(config["model"]["class_path"])
        trained = read_config(pretrained_folder(model["pretrained"]))
        network = model_class(trained["kind"])
        if trained["domain"] != domain.name or network is None or not adaptation.adapts(network):
            expected = " or ".join(kinds_for(adaptation.adapts))
            raise UserError(
                f"model.pretrained: expected a model of {domain.name} ({expected}), found one of {trained['domain']} "
                f"({trained['kind']}) in {model['pretrained']}"
            )
    if "encoder" in model:
        load_encoder(model["encoder"], domain.concepts.table, model["revision"])


def _class(path: str) -> type["Adaptation"]:
    module, _, name = path.rpartition(".")
    adaptation: type[Adaptation] = getattr(importlib.import_module(module), name)
    return adaptation
