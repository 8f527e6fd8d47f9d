"""Optional packages of extras: simulators, other programs' data sets, and requirements of a few measures and figures.

Without extras, all modules import, and a user's data can be learned from. Code that needs an extra checks it here before a late
import.
"""

import importlib.util
from collections.abc import Mapping

from ftl_lightning.services.errors import UserError

EXTRAS: Mapping[str, Mapping[str, str]] = {
    "driving": {"highway_env": "highway-env", "gymnasium": "gymnasium"},
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
    """Require an extra's packages; nothing is imported.

    Args:
        extra: a key of :data:`EXTRAS`.
        user: subject of the error message: what needs the packages.

    Raises:
        UserError: with the command that installs them.
    """
    for module, package in EXTRAS[extra].items():
        if importlib.util.find_spec(module) is None:
            command = f"pip install 'ftl-lightning[{extra}]'"
            raise UserError(f"{user} needs the package {package}, which is not installed; {command}")
