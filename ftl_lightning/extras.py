"""Packages that come with an extra of this one: simulators, other programs' data sets, and what a few measures and figures need.

Without them everything is imported, and learns and generates from data of one's own. What truly needs one asks here first and then
imports it where it is used.
"""

import importlib.util
from collections.abc import Mapping

from ftl_lightning.errors import UserError

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
"""Modules that are imported late, and the packages that they come with, by extra."""


def expect_extra(extra: str, user: str) -> None:
    """Refuse to go on without an extra's packages; nothing is imported.

    Args:
        extra: a key of :data:`EXTRAS`.
        user: what needs them, as the line begins that tells it.

    Raises:
        UserError: with the command that installs them.
    """
    for module, package in EXTRAS[extra].items():
        if importlib.util.find_spec(module) is None:
            command = f"pip install 'ftl-lightning[{extra}]'"
            raise UserError(f"{user} needs the package {package}, which is not installed; {command}")
