"""The lock file: what runs is in it, with the pinned versions and with hashes."""

import re
import tomllib
from importlib.metadata import requires

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.conftest import ROOT

LATER = {"torch", "triton"}
"""Installed before, in the build that fits the machine; on some machines that build brings packages of its own."""


def pinned(file: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([\w.+!-]+)", (ROOT / file).read_text("utf-8"), re.M)
    return {canonicalize_name(name): version for name, version in found}


def needed(requirement: Requirement, seen: set[tuple[str, str]]) -> None:
    """Add a package, and what it needs at run time, to those that were seen (name, extra)."""
    for extra in ("", *requirement.extras):
        key = (canonicalize_name(requirement.name), extra)
        if key in seen or key[0] in LATER or key[0].startswith(("nvidia-", "cuda-")):
            continue
        seen.add(key)
        for other in map(Requirement, requires(requirement.name) or ()):
            if other.marker is None or other.marker.evaluate({"extra": extra}):
                needed(other, seen)


def test_the_lock_holds_what_runs_with_the_pinned_versions_and_hashes() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras, seen = project["optional-dependencies"], set[tuple[str, str]]()
    own = [text for text in extras["all"] if Requirement(text).name == project["name"]]
    simulators = [text for one in own for extra in Requirement(one).extras for text in extras[extra]]
    everything = [text for text in extras["all"] if text not in own]
    for text in (*project["dependencies"], *simulators, *everything, *(requires("torch") or ())):
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            needed(requirement, seen)
    locked, constraints = pinned("requirements.lock"), pinned("constraints.txt")
    assert {"gymnasium", "highway-env", "pybullet", "scikit-learn"} <= {name for name, _ in seen} <= locked.keys()
    assert {name: version for name, version in locked.items() if name != "setuptools"}.items() <= constraints.items()
    blocks = re.split(r"^(?=[\w.-]+==)", (ROOT / "requirements.lock").read_text("utf-8"), flags=re.M)[1:]
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", block) for block in blocks)
