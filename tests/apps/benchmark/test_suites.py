"""The suites are frozen: their concepts are the domains', their data have the hashes that they had."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark import families
from ftl_lightning.apps.benchmark.families import CHANCE, ORACLE
from ftl_lightning.apps.benchmark.suite import DEMONSTRATIONS, FAMILIES, SEEDS, STARTS, TRAINING, load_suite, suite_names
from ftl_lightning.cli.main import main
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT


def test_there_are_five_domains_and_four_families() -> None:
    assert set(FAMILIES) == {"beats", "pictures", "reaches", "strokes"}
    assert set(suite_names()) == {*FAMILIES, "object_rearrangement", "agent", "driving", "mocap", "tabletop"}


@pytest.mark.parametrize("name", suite_names())
def test_a_suite_asks_what_its_domain_does(name: str) -> None:
    suite = load_suite(name)
    domain = load_domain(suite.domain_reference)
    assert suite.name == name
    assert ":" not in suite.domain  # the suite's hash does not depend on a module
    assert tuple(suite.training.concepts) == domain.concepts.training
    asked = {(task.setting, task.name): task for task in domain.concepts.suites[suite.test_suite].tasks}
    assert {(task.setting, task.concept) for task in suite.test} <= set(asked)
    learned = {concept for task in suite.test for concept in asked[task.setting, task.concept].learned}
    assert learned
    assert not learned & {*suite.training.concepts, *suite.validation}
    assert not {*suite.validation} & {*suite.training.concepts}
    known = {*domain.metrics, "coverage"}
    if suite.closed_loop:
        assert domain.closed_loop is not None
    else:
        assert {*suite.measures} <= known


@pytest.mark.parametrize("name", [name for name in suite_names() if name != "mocap"])
def test_every_seed_has_hashes(name: str) -> None:
    suite = load_suite(name)
    parts = {DEMONSTRATIONS, STARTS} if load_domain(suite.domain_reference).observed else {DEMONSTRATIONS, TRAINING}
    assert {seed: parts <= set(found) for seed, found in suite.data.items()} == {str(seed): True for seed in SEEDS}


@pytest.mark.parametrize("name", [*FAMILIES, "object_rearrangement"])
def test_demonstrations_are_the_frozen_ones(name: str) -> None:
    suite = load_suite(name)
    suite.check_data(0, None, (DEMONSTRATIONS,))
    found = suite.fingerprints(1, None, (DEMONSTRATIONS,))[DEMONSTRATIONS]
    assert found.is_near(suite.data["1"][DEMONSTRATIONS])
    assert not found.is_near(suite.data["0"][DEMONSTRATIONS])


def test_a_changed_generator_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    suite = load_suite("beats")
    source = families.BEATS.source(None)
    changed = replace(source, states=lambda task, count, seed: 1.1 * source.states(task, count, seed))  # type: ignore
    monkeypatch.setattr(families, "BEATS", replace(families.BEATS, source=lambda root: changed))
    load_domain.cache_clear()
    try:
        with pytest.raises(
            UserError, match=r"suite beats, seed 0, demonstrations: expected data with the hash \w{16}, found \w{16}"
        ):
            suite.check_data(0, None, (DEMONSTRATIONS,))
        assert main(["benchmark", "cvae", "--suites", "beats"]) == 2
        assert "the generator was changed" in capsys.readouterr().err
    finally:
        load_domain.cache_clear()


def test_rounding_in_another_way_is_no_other_data() -> None:
    suite = load_suite("beats")
    own = suite.data["0"][DEMONSTRATIONS]
    rounded = replace(own, hash="0" * 16, mean=own.mean + 1e-7)
    one = replace(suite, data={"0": {DEMONSTRATIONS: rounded}})
    assert suite.check_data(0, None, (DEMONSTRATIONS,))
    assert not one.check_data(0, None, (DEMONSTRATIONS,))


@pytest.mark.parametrize("name", FAMILIES)
def test_the_judge_knows_fresh_behaviour_and_nothing_else(name: str) -> None:
    suite = load_suite(name)
    domain = load_domain(suite.domain_reference)
    every = len(suite.training.concepts) + len(suite.validation) + len(suite.test)
    for task in suite.test[:2]:
        rates = {
            line: float(
                domain.measure(task.concept, domain.comparison.references[line](task.concept, 40, None, 0), None)["accuracy"]
                .float()
                .mean()
            )
            for line in (ORACLE, CHANCE)
        }
        assert rates[ORACLE] >= 0.95
        assert rates[CHANCE] <= 1.5 / every + 0.05
        broken = torch.full((3, domain.plans.horizon, len(domain.plans.columns)), np.nan)
        assert not domain.measure(task.concept, broken, None)["accuracy"].any()


def test_the_table_of_suites_is_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "benchmark.md").read_text(encoding="utf-8")
    assert main(["benchmark", "--list", "true"]) == 0
    table = capsys.readouterr().out
    assert f"<!-- suites: begin -->\n{table}<!-- suites: end -->" in page, (
        "write there what `ftl-lightning benchmark --list true` prints"
    )
