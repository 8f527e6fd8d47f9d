"""Domains are found by the name under which a package offers them, or where they are."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ftl_lightning.domains.object_rearrangement import DOMAIN
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.services.errors import UserError

BUILT_IN = ("agent", "driving", "mocap", "object_rearrangement", "tabletop", "tabletop_wide")
MODULE = """
from dataclasses import replace
from ftl_lightning.domains.object_rearrangement import DOMAIN as OTHER
DOMAIN = replace(OTHER, name="chess")
NOTHING = "a text"
"""
OFFERED = """[ftl_lightning.domains]
chess = chess_domain:DOMAIN
checkers = not_installed_anywhere:DOMAIN
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed package that offers two domains, of which one cannot be imported."""
    (tmp_path / "chess_domain.py").write_text(MODULE)
    with offering(tmp_path, "chess-domain", OFFERED, monkeypatch):
        yield


@contextmanager
def offering(folder: Path, name: str, points: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder on Python's path in which a package of some entry points is installed."""
    card = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    card.mkdir(parents=True)
    (card / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (card / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(folder)
    load_domain.cache_clear()
    yield
    load_domain.cache_clear()


def test_the_built_in_domains_and_that_of_a_package_are_offered_alike_and_also_named_by_where_they_are(package: None) -> None:
    assert domain_names() == tuple(sorted((*BUILT_IN, "chess", "checkers")))
    found = load_domain("chess")
    assert found.name == load_domain("chess_domain:DOMAIN").name == "chess"
    assert load_domain("chess") is found
    assert found.plans == DOMAIN.plans
    assert load_domain("ftl_lightning.domains.object_rearrangement:DOMAIN") is DOMAIN
    for name in BUILT_IN:
        assert load_domain(name).name == name
    assert load_domain("object_rearrangement") is DOMAIN


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("go", r"domain: expected one of agent, checkers, chess, driving, .*, or package.module:DOMAIN, found 'go'"),
        ("", "or package.module:DOMAIN, found ''"),
        ("checkers", r"domain 'checkers': cannot be imported \(No module named 'not_installed_anywhere'\); install its package"),
        ("chess_domain:GAME", r"domain 'chess_domain:GAME': cannot be imported \(.*has no attribute 'GAME'\)"),
        ("nowhere.at_all:DOMAIN", r"domain 'nowhere.at_all:DOMAIN': cannot be imported \(No module named 'nowhere'\)"),
        ("chess_domain:NOTHING", "domain 'chess_domain:NOTHING': expected a Domain, found str"),
        ("chess_domain:", "domain 'chess_domain:': cannot be imported"),
        (":DOMAIN", "domain ':DOMAIN': cannot be imported"),
        (".chess_domain:DOMAIN", "domain '.chess_domain:DOMAIN': cannot be imported"),
    ],
)
def test_each_mistake_in_a_name_is_told(name: str, message: str, package: None) -> None:
    with pytest.raises(UserError, match=message):
        load_domain(name)
