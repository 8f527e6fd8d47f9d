"""What works without the packages of the extras, and how a missing one is told."""

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.driving.shipped import SHIPPED
from ftl_lightning.errors import UserError
from ftl_lightning.extras import EXTRAS, expect_extra
from tests.conftest import CONF, ROOT
from tests.domains.test_from_file import walks

WITHOUT = """
import sys

HIDDEN = {"pybullet", "pybullet_data", "highway_env", "gymnasium", "pygame", "sklearn"}


class Hiding:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)


sys.meta_path[:] = [Hiding(finder) for finder in sys.meta_path]
"""
"""Python for a process in which the packages are as if they were not installed."""
VERBS = f"""{WITHOUT}
import json
from ftl_lightning.cli import main

for arguments in json.loads(sys.argv[1]):
    print("code:", main(arguments), file=sys.stderr, flush=True)
"""


def without(code: str, *arguments: str) -> str:
    """What a program writes to standard error that runs to its end without the packages."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


def told(*verbs: Sequence[str]) -> list[str]:
    """How verbs end that one process runs: exit codes and errors, in order."""
    return [line for line in without(VERBS, json.dumps(verbs)).splitlines() if line.startswith(("code: ", "error: "))]


def demonstrations(name: str, *texts: str, count: int) -> str:
    np.savez(name, states=np.concatenate([walks(text, count) for text in texts]), concepts=np.repeat(texts, count))
    return name


def test_own_data_and_reports_of_all_domains_need_no_simulator() -> None:
    fast = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--evaluation.samples=2", "--evaluation.steps=2"]
    many = demonstrations("many.npz", "go right", "go up", count=6)
    few = demonstrations("few.npz", "go between", count=3)
    small = ["--model.denoiser_args={hidden_dim: 16, depth: 1, condition_dim: 16}", "--trainer.max_steps=4"]
    small += ["--data.steps_per_epoch=4", "--data.batch_size=8", "--data.encoder=hashing"]
    concept = "logs/own/invert/concepts/go_between.safetensors"
    assert (
        told(
            ["fit", f"--config={CONF / 'own.yaml'}", f"--data.demonstrations={many}", *small, *fast],
            ["invert", f"--config={CONF / 'invert' / 'own.yaml'}", f"--data.demonstrations={few}", "--data.steps=2", *fast],
            ["sample", "--pretrained=logs/own/fit/pretrained", f"--concept={concept}", "--count=2", "--figure=samples.png"],
            ["report", f"--results={ROOT / 'results'}", "--out=report"],
        )
        == ["code: 0"] * 4
    )
    assert Path("samples.png").stat().st_size > 0
    report = "".join(path.read_text("utf-8") for path in Path("report").rglob("*.md"))
    for domain in ("agent", "driving", "mocap", "object_rearrangement", "tabletop"):
        assert domain in report


def test_a_missing_simulator_is_told_in_one_line() -> None:
    verbs, expected = [], []
    for domain, task, package, extra in (
        ("agent", "go to red bowl", "pybullet", "navigation"),
        ("driving", "roundabout", "highway-env", "driving"),
        ("tabletop", "pick green circle to book", "pybullet", "tabletop"),
    ):
        verbs += [["generate", domain, f"--task={task}", "--count=1"]]
        verbs += [["invert", f"--config={CONF / 'invert' / f'{domain}.yaml'}", "--trainer.accelerator=cpu"]]
        needed = f"error: domain {domain}: its simulator needs the package {package}, which is not installed; "
        expected += [f"{needed}pip install 'ftl-lightning[{extra}]'", "code: 2"] * 2
    assert told(*verbs) == expected
    assert not list(Path().rglob("*.safetensors"))


def test_plans_of_driving_are_made_without_the_simulator_and_executed_with_it() -> None:
    """Plans are made from the starts of demonstrations that ship."""
    Demonstrations.load(SHIPPED / "merge.safetensors").rows([0, 1]).save("two.safetensors")
    plans = ["sample", "--pretrained=driving", "--compose=merge", "--steps=2", "--sampler=ddim"]
    execute = ["--goal=merge", "--execute=true", "--out=other.safetensors"]
    made, error, refused = told([*plans, "--initial=two.safetensors"], [*plans, "--initial=two.safetensors", *execute])
    assert (made, refused) == ("code: 0", "code: 2")
    assert "ftl-lightning[driving]" in error
    assert len(Demonstrations.load("states.safetensors")) == 2
    assert not Path("other.safetensors").exists()  # told before the work


def test_what_needs_scikit_learn_says_so() -> None:
    calls = """
from ftl_lightning.errors import UserError
from ftl_lightning.domains.mocap.measures import learned_elsewhere
from ftl_lightning.reporting.figures import concept_map

for call, arguments in ((concept_map, (None, [])), (learned_elsewhere, ({}, {}))):
    try:
        call(*arguments)
    except UserError as error:
        print(error, file=sys.stderr)
"""
    needed = "needs the package scikit-learn, which is not installed; pip install"
    assert without(WITHOUT + calls).splitlines()[-2:] == [
        f"concept_map {needed} 'ftl-lightning[notebooks]'",
        f"learned_elsewhere {needed} 'ftl-lightning[mocap]'",
    ]


def test_extras_that_are_installed_are_expected_silently() -> None:
    for extra in EXTRAS:
        expect_extra(extra, "a test")


def test_an_extra_without_its_package_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "driving", {"no_such_module": "no-such-package"})  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"a test needs the package no-such-package.*'ftl-lightning\[driving\]'"):
        expect_extra("driving", "a test")


def test_the_project_offers_the_extras_with_their_packages() -> None:
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        assert set(packages.values()) <= {Requirement(text).name for text in offered[extra]}
    (together,) = [one for one in map(Requirement, offered["all"]) if one.name == "ftl-lightning"]
    assert together.extras == {"driving", "navigation", "play", "tabletop"}
