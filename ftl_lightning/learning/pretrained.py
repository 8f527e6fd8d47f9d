"""Pretrained models by the folder they are kept in, whatever their method."""

from collections.abc import Sequence
from pathlib import Path

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.registry import is_known, load_domain
from ftl_lightning.errors import UserError, short
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.methods import kinds, method_of
from ftl_lightning.learning.model_config import CONFIG, read_config
from ftl_lightning.learning.model_folder import read_model
from ftl_lightning.shipped import pretrained_folder


def load_model(folder: str | Path, domain: Domain | str | None = None) -> ConceptModel:
    """Read a model; it is frozen.

    Args:
        folder: that :func:`~ftl_lightning.learning.model_folder.save_model` wrote, or the name of one that ships.
        domain: whose behaviour it is, in place of what the folder says: a name, ``'package.module:DOMAIN'``, or the domain itself.
            A folder alone gets no domain but those that installed packages offer, see :mod:`ftl_lightning.trust`.

    Raises:
        UserError: naming the file, if it is missing, damaged, of an unknown method, or its files do not belong together.
    """
    folder = pretrained_folder(folder)
    kind = read_config(folder)["kind"]
    if (method := method_of(kind)) is None:
        raise UserError(f"{Path(folder) / CONFIG}: key 'kind': expected one of {', '.join(kinds())}, found {short(kind)!r}")
    return read_model(method.model_class(), folder, load_domain(domain) if isinstance(domain, str) else domain)


def find_model(model_hash: str, places: Sequence[Path]) -> Path:
    """The folder of the model with this hash below one of some places; of several, one whose domain is known.

    The configurations of all folders there are read as data; nothing that they name is imported.

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
        told = ", ".join(map(str, places))
        raise UserError(f"pretrained: expected the model with the hash {model_hash} below {told}, found none; name its folder")
    return next((folder for folder, domain in matches if domain == OWN or is_known(domain)), matches[0][0])
