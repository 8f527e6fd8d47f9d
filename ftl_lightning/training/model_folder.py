"""Folder of a pretrained model: ``config.json``, ``model.safetensors``, and examples of a user's data."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import torch

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import OWN, own_domain
from ftl_lightning.domains.registry import domain_of_file
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.tensor_file import alone, check_finite, file_hash, load_tensors, save_tensors, write_text
from ftl_lightning.services.validation import from_mapping
from ftl_lightning.training.concept_model import KIND, ConceptModel
from ftl_lightning.training.model_config import CONFIG, VERSION, check_domain, read_config
from ftl_lightning.training.model_weights import WEIGHTS, at_most, check_weights
from ftl_lightning.training.prepared import blank

M = TypeVar("M", bound=ConceptModel)
EXAMPLES = "demonstrations.safetensors"
"""File name of the examples in a model's folder."""


def save_model(model: ConceptModel, folder: str | Path) -> None:
    """Write ``config.json``, ``model.safetensors`` and any examples, each atomically; weights in half precision.

    Raises:
        UserError: before writing, for weights that are not finite or too large for half precision.
    """
    folder, stored = Path(folder), model.stored()
    check_finite(stored, str(folder), "nothing was written; train it anew")
    header = {"format": VERSION, "hash": model.hash, "kind": model.method.kind}
    with alone(folder):  # concurrent writes do not mix
        save_tensors(folder / WEIGHTS, KIND, stored, {"domain": model.config.domain})
        if model.examples is not None:
            model.examples.save(folder / EXAMPLES)
        write_text(folder / CONFIG, json.dumps(header | asdict(model.config), indent=2) + "\n")


def read_model(kind: type[M], folder: str | Path, domain: Domain | None = None) -> M:
    """Read a folder written by :func:`save_model`; the model is frozen and in evaluation mode.

    Args:
        kind: the model's class.
        folder: folder to read.
        domain: replaces the folder's domain; ``None`` for the folder's, which must be installed or given by the user with the
            folder.

    Raises:
        UserError: with the file, if it is missing or damaged, or if the files do not match.
    """
    path = Path(folder) / CONFIG
    content = read_config(folder)
    with about(path):
        if (actual := content.pop("kind")) != kind.method.kind:
            raise UserError(f"key 'kind': expected {kind.method.kind!r}, found {actual!r}, the model of another method")
        if domain is None and content["domain"] != OWN:
            domain = domain_of_file(content["domain"])
        del content["format"]
        expected_hash = content.pop("hash")
        config = from_mapping(kind.Config, content, "")
    weights = Path(folder) / WEIGHTS
    tensors, _ = load_tensors(weights, KIND)
    if (actual := file_hash(weights)) != expected_hash:
        raise UserError(
            f"{weights}: expected the hash {short(expected_hash)} that {CONFIG} names, found {actual}; copy both files again"
        )
    examples = Demonstrations.load(Path(folder) / EXAMPLES) if config.domain == OWN else None
    with about(path):
        if examples is not None:
            domain = own_domain(examples, config.training_concepts, config.horizon, config.metrics)
        elif domain is None:
            domain = domain_of_file(config.domain)
        check_domain(config, domain)
        # First on the meta device: a small file can name sizes beyond any memory.
        with torch.device("meta"), at_most(sum(value.numel() for value in tensors.values())):
            expected = kind(blank(config, domain)).state_dict()
    with about(weights):
        check_weights(tensors, expected)
    model = kind(blank(config, domain))
    model.examples = examples
    model.load_state_dict(tensors)
    return model.requires_grad_(False).eval()
