"""What works without the packages of the extras, and how a missing one is told."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from packaging.requirements import Requirement

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.traffic import SHIPPED
from ftl_lightning.reporting.concept_figures import concept_map
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import EXTRAS, check_extra
from tests.conftest import CONF, ROOT, environment, refused
from tests.domains.mocap_samples import script
from tests.domains.test_from_file import walks
from tests.tiny import QUIET

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
import json, os
from ftl_lightning.cli.main import main

for line in sys.stdin:
    folder, arguments = json.loads(line)
    os.chdir(folder)
    print("code:", main(arguments), file=sys.stderr, flush=True)
"""


SIMULATORS = (
    ("agent", "go to red bowl", "pybullet", "navigation"),
    ("driving", "roundabout", "highway-env", "driving"),
    ("tabletop", "pick green circle to book", "pybullet", "tabletop"),
)
"""Domains with a task, the package of the simulator, and its extra."""
DOMAINS = ("agent", "driving", "mocap", "object_rearrangement", "tabletop")
NEEDED = "error: domain {}: its simulator needs the package {}, which is not installed; pip install 'ftl-lightning[{}]'"


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory) -> Iterator["subprocess.Popen[str]"]:
    """A process without the packages and with nothing kept, which runs the verbs that it is sent."""
    empty, pipe = str(tmp_path_factory.mktemp("empty")), subprocess.PIPE
    known = environment(XDG_CACHE_HOME=empty, XDG_DATA_HOME=empty)
    command = [sys.executable, "-c", VERBS]
    with subprocess.Popen(command, env=known, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe, text=True) as process:
        yield process
        process.stdin.close()


@pytest.fixture
def told(without: "subprocess.Popen[str]") -> Callable[..., list[str]]:
    """How verbs end that run one after another: exit codes and errors, in order."""

    def run(*verbs: Sequence[str]) -> list[str]:
        lines: list[str] = []
        for verb in verbs:
            print(json.dumps([str(Path.cwd()), verb]), file=without.stdin, flush=True)
            for line in iter(without.stderr.readline, ""):
                assert "Traceback" not in line
                lines += [line.strip()] if line.startswith(("code: ", "error: ")) else []
                if line.startswith("code: "):
                    break
        return lines

    return run


def demonstrations(name: str, *texts: str, count: int) -> str:
    np.savez(name, states=np.concatenate([walks(text, count) for text in texts]), concepts=np.repeat(texts, count))
    return name


@pytest.mark.slow
def test_own_data_and_reports_of_all_domains_need_no_simulator(told: Callable[..., list[str]]) -> None:
    fast = [*QUIET, "--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.figures=0"]
    Path("results").mkdir()
    for domain in DOMAINS:  # some rows of each
        rows = pd.read_csv(ROOT / "results" / f"{domain}.csv", dtype=str, keep_default_na=False)
        rows.head(60).to_csv(f"results/{domain}.csv", index=False)
    many = demonstrations("many.npz", "go right", "go up", count=6)
    few = demonstrations("few.npz", "go between", count=3)
    small = ["--model.denoiser_args={hidden_dim: 16, depth: 1, condition_dim: 16}", "--trainer.max_steps=4"]
    small += ["--data.steps_per_epoch=4", "--data.batch_size=8", "--data.encoder=hashing"]
    concept = "logs/own/invert/concepts/go_between.safetensors"
    codes = told(
        ["fit", f"--config={CONF / 'own.yaml'}", f"--data.demonstrations={many}", *small, *fast],
        ["invert", f"--config={CONF / 'own.yaml'}", f"--data.demonstrations={few}", "--data.steps=2", *fast],
        ["sample", "--pretrained=logs/own/fit/pretrained", f"--concept={concept}", "--count=2", "--figure=samples.png"],
        ["report", "--results=results", "--out=report"],
    )
    assert codes == ["code: 0"] * 4
    assert Path("samples.png").stat().st_size > 0
    report = "".join(path.read_text("utf-8") for path in Path("report").rglob("*.md"))
    assert all(domain in report for domain in DOMAINS)


@pytest.mark.slow
def test_a_missing_simulator_is_told_in_one_line(told: Callable[..., list[str]]) -> None:
    verbs, expected = [], []
    for domain, task, package, extra in SIMULATORS:
        verbs += [["generate", domain, f"--task={task}", "--count=1"]]
        verbs += [["invert", f"--config={CONF / f'{domain}.yaml'}", "--trainer.accelerator=cpu"]]
        expected += [NEEDED.format(domain, package, extra), "code: 2"] * 2
    assert told(*verbs) == expected
    assert not list(Path().rglob("*.safetensors"))


@pytest.mark.slow
def test_plans_of_driving_are_made_without_the_simulator_and_executed_with_it(told: Callable[..., list[str]]) -> None:
    """Plans are made from the starts of demonstrations that ship."""
    Demonstrations.load(SHIPPED / "merge.safetensors").rows([0, 1]).save("two.safetensors")
    plans = ["sample", "--pretrained=driving", "--compose=merge", "--steps=2", "--sampler=ddim", "--initial=two.safetensors"]
    execute = ["--goal=merge", "--execute=true", "--out=other.safetensors"]
    made, error, refused = told(plans, [*plans, *execute])
    assert (made, refused) == ("code: 0", "code: 2")
    assert "ftl-lightning[driving]" in error
    assert len(Demonstrations.load("states.safetensors")) == 2
    assert not Path("other.safetensors").exists()  # told before the work


def test_what_needs_scikit_learn_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn", None)  # as if it was not installed
    for call, extra in (
        (lambda: concept_map(None, []), "notebooks"),
        (lambda: script("mocap_distances").learned_elsewhere({}, {}), "mocap"),
    ):
        told = rf"needs the package scikit-learn, which is not installed; .*'ftl-lightning\[{extra}\]'"
        with pytest.raises(UserError, match=told):
            call()


@pytest.mark.parametrize(("domain", "task", "package", "extra"), SIMULATORS)
def test_a_simulator_that_is_not_there_is_missed_before_the_work(
    domain: str, task: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, package.replace("-", "_"), None)
    refused(capsys, ["generate", domain, f"--task={task}", "--count=1"], NEEDED.format(domain, package, extra))


def test_extras_are_those_of_the_project_and_a_missing_package_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        check_extra(extra, "a test")  # silently, since it is installed
        assert set(packages.values()) <= {Requirement(text).name for text in offered[extra]}
    (together,) = [one for one in map(Requirement, offered["all"]) if one.name == "ftl-lightning"]
    assert together.extras == {"driving", "navigation", "play", "tabletop"}
    monkeypatch.setitem(EXTRAS, "driving", {"no_such_module": "no-such-package"})  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"a test needs the package no-such-package.*'ftl-lightning\[driving\]'"):
        check_extra("driving", "a test")
