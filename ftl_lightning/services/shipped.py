"""Shipped files and optional packages."""

import difflib
import importlib.util
from collections.abc import Mapping
from pathlib import Path

from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.store import fetched, is_url

FOLDERS = ("conf", "pretrained")
"""Shipped folders."""
_PACKAGE = Path(__file__).parent.parent
CONFIGURATIONS = _PACKAGE / "conf"
"""Folder of the shipped configuration files."""
MODELS = _PACKAGE / "pretrained"
"""Folder of the shipped models."""
TOPICS: Mapping[str, str] = {"motion": "mocap", "navigation": "agent", "rearrangement": "object_rearrangement"}
"""Shipped models by topic, where their domain has another name."""
MODEL_FILES = ("model.safetensors", "demonstrations.safetensors", "config.json")
"""Files of a model's folder, the configuration last; only models of a user's data have demonstrations."""
FILM = Path(__file__).parent / "film.js"
"""Script that draws films on a page. It contains ``"use strict"``, so it must be the first script."""


def shipped(path: str | Path) -> Path:
    """Resolve a path, such as ``conf/agent.yaml`` or ``pretrained/agent``: as given, or else in the shipped folders.

    If neither exists, the path is returned as given, so that errors name it.
    """
    path = Path(path)
    ours = path.parts[:1] and path.parts[0] in FOLDERS and ".." not in path.parts and not path.exists()
    return _PACKAGE / path if ours and (_PACKAGE / path).exists() else path


def shipped_models() -> list[str]:
    """Names of the shipped models, such as ``agent``, without baselines."""
    return sorted(path.parent.name for path in MODELS.glob("*/config.json"))


def list_models(baselines: bool = False) -> list[str]:
    """Names of the shipped models for ``FewShot.from_pretrained``; with ``baselines`` also ``baseline/cvae/agent`` and so on."""
    others = sorted(str(path.parent.relative_to(MODELS)) for path in MODELS.glob("baseline/*/*/config.json"))
    return shipped_models() + (others if baselines else [])


def topic(domain: str) -> str:
    """Topic of a domain, such as ``navigation`` of ``agent``; the domain's name without one."""
    return next((topic for topic, name in TOPICS.items() if name == domain), domain)


def missing_model(place: str | Path) -> str:
    """Error message for ``place`` without a model, with the nearest shipped names."""
    place = short(str(place), 80)
    normalised = place.lower().replace(" ", "_").replace("-", "_").removeprefix("pretrained/")
    near = difflib.get_close_matches(normalised, [*list_models(baselines=True), *TOPICS], n=2)
    near = [str(inside) for inside in (Path(place) / "pretrained",) if (inside / "config.json").is_file()] or near
    ship = f"did you mean {' or '.join(near)}? shipped models:" if near else f"{', '.join(shipped_models())} ship, see"
    return (
        f"{Path(place) / 'config.json'}: expected a pretrained model, found nothing; {ship} ftl_lightning.list_models(); "
        "to make one, run: python -m ftl_lightning fit"
    )


def pretrained_folder(name: str | Path) -> Path:
    """Folder of a pretrained model by its path, shipped name or topic, such as ``agent`` or ``navigation``.

    The files of a URL, such as ``s3://bucket/model``, are copied to a temporary folder.

    Raises:
        UserError: if a store cannot be reached.
    """
    if is_url(name):
        return fetched(str(name), MODEL_FILES)
    for path in (Path(name), shipped(name), shipped(Path("pretrained") / TOPICS.get(str(name), name))):
        if (path / "config.json").is_file():
            return path
    return Path(name)


def shipped_name(folder: Path) -> str:
    """Name of a shipped model, such as ``agent``, by its folder; empty for other folders."""
    place, models = folder.resolve(), MODELS.resolve()
    return place.relative_to(models).as_posix() if place.is_relative_to(models) and place != models else ""


EXTRAS: Mapping[str, Mapping[str, str]] = {
    "driving": {"highway_env": "highway-env", "gymnasium": "gymnasium"},
    "hdf5": {"h5py": "h5py"},
    "lerobot": {"pyarrow": "pyarrow"},
    "minari": {"minari": "minari"},
    "mocap": {"sklearn": "scikit-learn"},
    "navigation": {"pybullet": "pybullet", "gymnasium": "gymnasium"},
    "notebooks": {"sklearn": "scikit-learn"},
    "play": {"starlette": "starlette", "uvicorn": "uvicorn"},
    "tabletop": {"pybullet": "pybullet", "gymnasium": "gymnasium"},
}
"""Late-imported modules and their packages, by extra."""


def check_extra(extra: str, user: str) -> None:
    """Require the packages of ``extra``, a key of :data:`EXTRAS`; nothing is imported.

    Raises:
        UserError: that ``user`` needs them, with the command that installs them.
    """
    for module, package in EXTRAS[extra].items():
        if importlib.util.find_spec(module) is None:
            command = f"pip install 'ftl-lightning[{extra}]'"
            raise UserError(f"{user} needs the package {package}, which is not installed; {command}")
