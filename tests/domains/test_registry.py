"""Domains are found by the name under which a package offers them, or where they are."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from ftl_lightning.domains.object_rearrangement import DOMAIN
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.errors import UserError

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
    card = tmp_path / "chess_domain-1.0.dist-info"
    card.mkdir()
    (card / "METADATA").write_text("Metadata-Version: 2.1\nName: chess-domain\nVersion: 1.0\n")
    (card / "entry_points.txt").write_text(OFFERED)
    monkeypatch.syspath_prepend(tmp_path)
    load_domain.cache_clear()
    yield
    load_domain.cache_clear()


def test_the_built_in_domains_are_offered_like_any_other() -> None:
    assert set(BUILT_IN) <= set(domain_names())
    for name in BUILT_IN:
        assert load_domain(name).name == name
    assert load_domain("object_rearrangement") is DOMAIN


def test_a_package_of_ones_own_offers_a_domain(package: None) -> None:
    assert domain_names() == tuple(sorted((*BUILT_IN, "chess", "checkers")))
    found = load_domain("chess")
    assert found.name == "chess"
    assert load_domain("chess") is found
    assert found.plans == DOMAIN.plans


def test_a_domain_is_named_by_where_it_is(package: None) -> None:
    assert load_domain("chess_domain:DOMAIN").name == "chess"
    assert load_domain("ftl_lightning.domains.object_rearrangement:DOMAIN") is DOMAIN


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
