"""Loading of pretrained models of any method."""

from collections.abc import Sequence
from pathlib import Path

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.registry import is_known, load_domain
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.shipped import pretrained_folder
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.methods import kinds, model_class
from ftl_lightning.training.model_config import CONFIG, read_config
from ftl_lightning.training.model_folder import read_model


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
        raise UserError(f"{Path(folder) / CONFIG}: key 'kind': expected one of {', '.join(kinds())}, found {short(kind)!r}")
    return read_model(network, folder, load_domain(domain) if isinstance(domain, str) else domain)


def find_model(model_hash: str, places: Sequence[Path]) -> Path:
    """Find the folder of the model with this hash below ``places``; a known domain is preferred.

    Configurations are read as data; nothing that they name is imported.

    Raises:
        UserError: if there is none.
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
