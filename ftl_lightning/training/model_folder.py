"""Folder of a pretrained model: ``config.json``, ``model.safetensors``, and examples of a user's data."""

import json
import shlex
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import OWN, Domain
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.domains.registry import domain_of_file, is_known, load_domain
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.shipped import MODEL_FILES, pretrained_folder
from ftl_lightning.services.store import is_url, put
from ftl_lightning.services.tensor_file import alone, check_finite, file_hash, load_tensors, save_tensors, write_text
from ftl_lightning.services.validation import from_mapping
from ftl_lightning.training.concept_model import KIND, ConceptModel
from ftl_lightning.training.method import kinds, methods
from ftl_lightning.training.model_config import CONFIG, VERSION, blank, check_domain, read_config

M = TypeVar("M", bound=ConceptModel)
WEIGHTS, EXAMPLES, _ = MODEL_FILES
"""File names of a model's weights and examples."""


def save_model(model: ConceptModel, folder: str | Path) -> None:
    """Write ``config.json``, ``model.safetensors`` and any examples, each atomically; weights in half precision.

    The folder may be in a store, such as ``s3://bucket/model``.

    Raises:
        UserError: before writing, for weights that are not finite or too large for half precision; for a store that cannot be
            reached.
    """
    if is_url(folder):
        with tempfile.TemporaryDirectory() as local:
            save_model(model, local)
            put(Path(local), str(folder), [name for name in MODEL_FILES if (Path(local) / name).is_file()])
        return
    folder, stored = Path(folder), model.stored()
    check_finite(stored, str(folder), "nothing was written; train it again")
    header = {"format": VERSION, "hash": model.hash, "kind": model.kind}
    with alone(folder):  # concurrent writes do not mix
        save_tensors(folder / WEIGHTS, KIND, stored, {"domain": model.config.domain})
        if model.examples is not None:
            model.examples.save(folder / EXAMPLES)
        write_text(folder / CONFIG, json.dumps(header | asdict(model.config), indent=2) + "\n")


@usual_modes()
def read_model(kind: type[M], folder: str | Path, domain: Domain | None = None) -> M:
    """Read a folder written by :func:`save_model`; the model is frozen and in evaluation mode.

    Args:
        folder: folder to read.
        domain: replaces the folder's domain; ``None`` for the folder's, which must be installed or given by the user with the
            folder.

    Raises:
        UserError: with the file, if it is missing or damaged, or if the files do not match.
    """
    path = Path(folder) / CONFIG
    content = read_config(folder)
    with about(path):
        if (actual := content.pop("kind")) != kind.kind:
            raise UserError(f"key 'kind': expected {kind.kind!r}, found {actual!r}, the model of another method")
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
    if tensors["normalization.low"].dtype == torch.float64:
        model.normalization.double()
    model.load_state_dict(tensors)
    return model.requires_grad_(False).eval()


MOST_PARAMETERS = 10_000
"""Maximum number of parameter tensors in a model from a file."""
SPARE = 4
"""Maximum ratio of parameters built to parameters in the file: layers that are stacked afterwards are built twice."""


@contextmanager
def at_most(numbers: int) -> Iterator[None]:
    """Within the block, abort the construction of a network much larger than ``numbers`` parameters.

    Raises:
        UserError: for a network that is larger or cannot be built.
    """
    tensors, left = 0, SPARE * numbers

    def count(module: nn.Module, name: str, parameter: Tensor | None) -> None:
        nonlocal tensors, left
        if parameter is not None:
            tensors, left = tensors + 1, left - parameter.numel()
        if tensors > MOST_PARAMETERS or left < 0:
            raise UserError(f"expected the sizes of the {numbers} numbers in {WEIGHTS}, found those of a larger network")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # torch and the networks raise many kinds for inconsistent sizes
        raise UserError(f"expected sizes that make a network, found others ({short(str(error), 100)})") from error
    finally:
        handle.remove()


def check_weights(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse tensors that do not fit a model or are not finite; ``UserError`` with the first such tensor."""
    for name in [*expected, *tensors]:
        if name not in tensors or name not in expected:
            message = "expected it, found nothing" if name not in tensors else "expected nothing, found it"
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: {message}")
        tensor, like = tensors[name], expected[name]
        if tensor.shape != like.shape or tensor.is_floating_point() != like.is_floating_point():
            kinds = [f"{str(each.dtype).removeprefix('torch.')} {tuple(each.shape)}" for each in (like, tensor)]
            raise UserError(f"does not fit {CONFIG}: key {short(name)!r}: expected {kinds[0]}, found {kinds[1]}")
        if tensor.is_floating_point() and tensor.numel() and not torch.stack(tensor.aminmax()).isfinite().all():
            raise UserError(f"key {short(name)!r}: expected finite numbers, found others; take another copy of both files")


def kinds_for(adapts: Callable[[type[ConceptModel]], bool]) -> list[str]:
    """Kinds of models whose class satisfies ``adapts``."""
    return [method.kind for method in methods() if method.model and adapts(method.model())]


def model_class(kind: str) -> type[ConceptModel] | None:
    """The network's class for a kind of models; ``None`` if no installed package offers it."""
    return next((method.model() for method in methods() if method.model and method.kind == kind), None)


def load_model(folder: str | Path, domain: Domain | str | None = None) -> ConceptModel:
    """Load a frozen model.

    Args:
        folder: folder written by :func:`~ftl_lightning.training.model_folder.save_model`, or the name of a shipped model.
        domain: replaces the folder's domain: a name, ``'package.module:DOMAIN'``, or a domain. A folder alone can only name
            domains of installed packages, see :mod:`ftl_lightning.services.trust`.

    Raises:
        UserError: with the file, if it is missing, damaged or of an unknown method, or if the files do not match.
    """
    folder = pretrained_folder(folder)
    kind = read_config(folder)["kind"]
    if (network := model_class(kind)) is None:
        expected = f"{Path(folder) / CONFIG}: key 'kind': expected one of {', '.join(kinds())}"
        raise UserError(f"{expected}, found {short(kind)!r}; install the package that offers this method")
    return read_model(network, folder, load_domain(domain) if isinstance(domain, str) else domain)


def find_model(model_hash: str, places: Sequence[Path]) -> Path:
    """Find the folder of the model with this hash below ``places``, preferably of a known domain; ``UserError`` if there is none.

    Configurations are read as data; classes that they name are not imported.
    """
    matches = []
    for path in (path for place in places for path in sorted(place.rglob(CONFIG))):
        try:
            content = read_config(path.parent)
        except UserError:  # the configuration of something else
            continue
        if content["hash"] == model_hash:
            matches.append((path.parent, content["domain"]))
    if not matches:
        searched = ", ".join(map(str, places))
        raise UserError(f"pretrained: expected the model with the hash {model_hash} below {searched}, found none; name its folder")
    return next((folder for folder, domain in matches if domain == OWN or is_known(domain)), matches[0][0])


def sampling_command(pretrained: str, name: str, path: Path, domain: Domain) -> str:
    """Command that samples a learned concept ``name`` of the model ``pretrained`` in a file."""
    parts = ["python -m ftl_lightning sample --pretrained", shlex.quote(pretrained), "--concept", shlex.quote(str(path))]
    if domain.observed:
        parts += ["--goal", shlex.quote(name)] if domain.concepts.reads(name) else ["--initial FILE"]
    return " ".join((*parts, "--count 10 --figure samples.png"))
