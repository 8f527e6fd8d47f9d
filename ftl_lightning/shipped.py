"""Files that come with the package: configurations (``conf/...``) and pretrained models (``pretrained/...``).

In the repository both folders stand at the root; the package holds links to them, which a wheel has as folders. So the paths in
the documentation are true in a checkout and, after ``pip install``, in any folder.
"""

import difflib
from pathlib import Path

from ftl_lightning.errors import short

FOLDERS = ("conf", "pretrained")
"""What is shipped."""
_PACKAGE = Path(__file__).parent
CONFIGURATIONS = _PACKAGE / "conf"
"""The configuration files that ship."""
MODELS = _PACKAGE / "pretrained"
"""The models that ship."""


def shipped(path: str | Path) -> Path:
    """The path as given, if something is there; else the same path among the shipped folders, if something is there.

    Args:
        path: for example ``conf/agent.yaml`` or ``pretrained/agent``, relative to the current folder.

    Returns:
        The path as given where nothing is found either way, so that errors name what the user wrote.
    """
    path = Path(path)
    if path.parts[:1] and path.parts[0] in FOLDERS and ".." not in path.parts and not path.exists():
        inside = _PACKAGE / path
        if inside.exists():
            return inside
    return path


def shipped_models() -> list[str]:
    """Names of the models that ship, such as ``agent``; baselines apart."""
    return sorted(path.parent.name for path in MODELS.glob("*/config.json"))


def list_models(baselines: bool = False) -> list[str]:
    """Names of the models that ship, which ``FewShot.from_pretrained`` takes.

    Args:
        baselines: name those of the baselines too, such as ``baseline/cvae/agent``.
    """
    others = sorted(str(path.parent.relative_to(MODELS)) for path in MODELS.glob("baseline/*/*/config.json"))
    return shipped_models() + (others if baselines else [])


def missing_model(place: str | Path) -> str:
    """What is told of a place where no model is, with the nearest names of those that ship."""
    place = short(str(place), 80)
    told = place.lower().replace(" ", "_").replace("-", "_").removeprefix("pretrained/")
    near = difflib.get_close_matches(told, list_models(baselines=True), n=2)
    ship = f"did you mean {' or '.join(near)}? all that ship:" if near else f"{', '.join(shipped_models())} ship, see"
    return (
        f"{Path(place) / 'config.json'}: expected a pretrained model, found nothing; {ship} ftl_lightning.list_models(); "
        "to make one, run: python -m ftl_lightning fit"
    )


def pretrained_folder(name: str | Path) -> Path:
    """The folder of a pretrained model by its path, or by the name of one that ships, such as ``agent``."""
    for path in (Path(name), shipped(name), shipped(Path("pretrained") / name)):
        if (path / "config.json").is_file():
            return path
    return Path(name)


def shipped_name(folder: Path) -> str:
    """The name of a model that ships, such as ``agent``, by its folder; empty for another one."""
    place, models = folder.resolve(), MODELS.resolve()
    return place.relative_to(models).as_posix() if place.is_relative_to(models) and place != models else ""
