"""Names that the shipped configuration files had before, and what stands for each today. No other module knows them."""

import re
from dataclasses import dataclass
from pathlib import Path

FOLDER = "conf"
"""Of the shipped configuration files."""


@dataclass(frozen=True)
class Renamed:
    """What stands for a file of a former name.

    Attributes:
        root: what stands before the name in the path; it ends in ``conf/``.
        files: of today, relative to ``root``, to be merged in order; none for a file that said what classes say.
        section: ``'fit'`` or ``'invert'``, the one that counts in them; empty for none.
        advice: what to write today.
    """

    root: str
    files: tuple[str, ...]
    section: str
    advice: str


_BOTH = "(for fit and invert)"
_NAMES: tuple[tuple[str, tuple[str, ...], str, str], ...] = (
    (r"invert/(?P<x>\w+)\.yaml", ("{x}.yaml",), "invert", f"is now conf/{{x}}.yaml {_BOTH}"),
    (
        r"baseline/language/invert/(?P<x>object_rearrangement)\.yaml",
        ("verb.yaml", "domain/{x}.yaml", "method/language.yaml"),
        "invert",
        "is now conf/{x}.yaml and after it conf/method/language.yaml",
    ),
    (
        r"baseline/language/invert/(?P<x>\w+)\.yaml",
        ("verb.yaml", "domain/{x}.yaml", "sampling/{x}.yaml", "method/language.yaml"),
        "invert",
        "is now conf/{x}.yaml and after it conf/method/language.yaml",
    ),
    (r"baseline/(?P<m>\w+)/invert/(?P<x>\w+)\.yaml", ("{m}/{x}.yaml",), "invert", f"is now conf/{{m}}/{{x}}.yaml {_BOTH}"),
    (r"baseline/(?P<m>\w+)/(?P<x>\w+)\.yaml", ("{m}/{x}.yaml",), "fit", f"is now conf/{{m}}/{{x}}.yaml {_BOTH}"),
    (r"verb/common\.yaml", ("verb.yaml",), "", "is now conf/verb.yaml"),
    (r"verb/(?P<v>fit|invert)\.yaml", ("verb.yaml",), "{v}", f"is now conf/verb.yaml {_BOTH}"),
    (
        r"(?P<g>domain|method)/(?P<v>fit|invert)/(?P<x>\w+)\.yaml",
        ("{g}/{x}.yaml",),
        "{v}",
        f"is now conf/{{g}}/{{x}}.yaml {_BOTH}",
    ),
    (r"sampling/object_rearrangement\.yaml", (), "", "says what is the default; leave it out"),
)
"""Former names as patterns, relative to the folder; the first that fits counts."""


def renamed(path: str | Path) -> Renamed | None:
    """What stands for a path whose name is a former one; ``None`` for every other path.

    Whether the files of today are there is not looked at.
    """
    root, folder, name = str(path).rpartition(f"{FOLDER}/")
    if not folder or not (root == "" or root.endswith("/")):
        return None
    for pattern, files, section, advice in _NAMES:
        if found := re.fullmatch(pattern, name):
            parts = found.groupdict()
            today = tuple(file.format(**parts) for file in files)
            return Renamed(root + folder, today, section.format(**parts), advice.format(**parts))
    return None


def former_settings(domain: str, folder: str) -> str:
    """Where the settings of ``invert`` that go with a domain's models stood.

    Args:
        domain: its name.
        folder: of the configuration files of the models' method today, ``conf`` or ``conf/bc``.
    """
    group = folder.removeprefix(FOLDER).strip("/")
    return f"{FOLDER}/baseline/{group}/invert/{domain}.yaml" if group else f"{FOLDER}/invert/{domain}.yaml"
