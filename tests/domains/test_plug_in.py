"""A domain in a package of its own: found by its entry point or by its module, and what such a domain need not say."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.data import InversionData, PretrainingData
from ftl_lightning.domains.domain import Concepts, Domain, Plans
from ftl_lightning.domains.generated import Generated
from ftl_lightning.domains.registry import domain_names, load_domain, recorded_name
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from tests.conftest import ROOT

PUSHES = ROOT / "examples" / "ftl-pushes"
EXAMPLE = ROOT / "examples" / "ftl-strokes"
SMALL = [
    "--trainer.enable_progress_bar=false",
    "--trainer.accelerator=cpu",
    "--evaluation.samples=4",
    "--evaluation.steps=3",
    "--evaluation.figures=0",
]
Run = Callable[..., str]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder into which the example was installed as a package."""
    folder = tmp_path_factory.mktemp("installed")
    shutil.copytree(EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("logs", "build", "*.egg-info", "__pycache__"))
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(folder / "packages")]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(folder / "source")], check=True)
    return folder / "packages"


def runner(packages: Path) -> Run:
    """The program, with another folder of packages."""

    def run(*arguments: str, code: int = 0) -> str:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (packages, ROOT))), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "ftl_lightning", *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
        return done.stdout + done.stderr

    return run


def learn(run: Run, *options: str) -> Path:
    """A little pretraining and a little learning; the folder of the pretrained model."""
    fit = ["--trainer.max_steps=60", "--data.steps_per_epoch=60", "--data.samples_per_concept=20", "--data.batch_size=32"]
    run("fit", "--config", str(EXAMPLE / "strokes.yaml"), *SMALL, *fit, *options)
    run("invert", "--config", str(EXAMPLE / "strokes_invert.yaml"), *SMALL, "--data.steps=5", *options)
    return Path("logs/strokes/fit/pretrained")


def test_an_installed_domain_is_used_by_its_name(installed: Path) -> None:
    run = runner(installed)
    folder = learn(run)
    assert json.loads((folder / "config.json").read_text())["domain"] == "strokes"
    assert sorted(path.stem for path in Path("logs/strokes/invert/concepts").iterdir()) == ["wave_upwards", "zigzag_leftwards"]
    rows = Path("logs/strokes/invert/results.csv").read_text()
    assert "new concept,wave upwards" in rows
    learned = "--concept=logs/strokes/invert/concepts/wave_upwards.safetensors"
    options = ["--goal=wave upwards", "--count=3", "--steps=3", "--sampler=dpm_solver", "--figure=s.png", "--animation=s.gif"]
    told = run("sample", f"--pretrained={folder}", learned, *options)
    assert "accuracy on 'wave upwards'" in told
    samples = Demonstrations.load("states.safetensors")
    assert samples.domain == "strokes"
    assert samples.states.shape == (3, 32, 2)
    assert Path("s.png").stat().st_size > 0
    assert Path("s.gif").stat().st_size > 0


def test_a_domain_that_is_not_installed_is_used_by_its_module() -> None:
    run = runner(EXAMPLE)
    folder = learn(run, "--data.domain=ftl_strokes:DOMAIN")
    # By this name, and no other, the domain is found again.
    assert json.loads((folder / "config.json").read_text())["domain"] == "ftl_strokes:DOMAIN"
    sample = ["sample", "--pretrained", str(folder), "--compose=arc upwards", "--count=2", "--steps=3", "--sampler=dpm_solver"]
    assert "give --trust ftl_strokes" in run(*sample, code=2)  # a folder names no code: a person does
    run(*sample, "--trust=ftl_strokes")
    run(*sample, f"--settings={EXAMPLE / 'strokes_invert.yaml'}", "--trust=ftl_strokes")
    told = run("generate", "strokes", code=2)
    names = "agent, driving, mocap, object_rearrangement, tabletop, tabletop_wide"
    assert f"domain: expected one of {names}, or package.module:DOMAIN, found 'strokes'" in told


def test_the_example_is_small() -> None:
    assert len((EXAMPLE / "ftl_strokes.py").read_text().splitlines()) <= 50


@pytest.fixture
def strokes(monkeypatch: pytest.MonkeyPatch) -> Domain:
    monkeypatch.syspath_prepend(EXAMPLE)
    return load_domain("ftl_strokes:DOMAIN")


def test_the_strokes_of_each_kind_are_recognised_as_that_kind_alone(strokes: Domain) -> None:
    source, measure = strokes.source(None), strokes.metrics["accuracy"].measure
    for kind in strokes.concepts.descriptions:
        drawn = source.draw(kind, 50, 0).states
        for goal in strokes.concepts.descriptions:
            assert measure(goal, drawn, None).float().mean() == float(goal == kind)
    assert not measure("arc upwards", torch.randn(50, 32, 2), None).any()


def test_the_expert_s_pushes_are_right_in_open_and_closed_loop_and_a_random_target_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(PUSHES)
    pushes = load_domain("ftl_pushes:DOMAIN")
    source, measure, loop = pushes.source(None), pushes.metrics["accuracy"].measure, pushes.closed_loop
    assert loop is not None
    for task in pushes.concepts.descriptions:
        drawn = source.draw(task, 40, 0)
        starts = drawn.initial_states
        assert torch.equal(starts.observed["world"], starts.require_scenes())
        assert measure(task, drawn.states, starts).all()
        assert measure(task, pushes.references["random target"](task, 40, starts, 0), starts).float().mean() < 0.8
        rollout = roll_out(loop, starts, PlanFollower(fixed_plans(drawn.states), loop.act, loop.steps))
        assert loop.judge(task, rollout)["success"].all()
        assert len(loop.film(rollout.take(0, 1), drawn.states[:1])) > 1
    held_out = source.split("validation", 5, 0)
    assert not torch.equal(held_out.states, source.split("train", 5, 0).states)


def test_a_domain_is_recorded_by_the_name_that_a_package_offers(strokes: Domain) -> None:
    assert recorded_name("agent") == "agent"
    assert recorded_name("ftl_lightning.domains.agent:DOMAIN") == "agent"
    assert recorded_name("ftl_strokes:DOMAIN") == "ftl_strokes:DOMAIN"
    assert PretrainingData("ftl_strokes:DOMAIN", encoder="hashing").domain_name == "ftl_strokes:DOMAIN"
    assert (
        InversionData("ftl_lightning.domains.object_rearrangement:DOMAIN", suite="validation").domain_name == "object_rearrangement"
    )
    with pytest.raises(UserError, match=r"domain 'ftl_strokes:NONE': cannot be imported"):
        recorded_name("ftl_strokes:NONE")
    assert "strokes" not in domain_names()


def bends(task: str, count: int, seed: int) -> list[Tensor]:
    """Of different lengths."""
    return [torch.full((2 + row, 3), float(seed % 7)) for row in range(count)]


def test_a_source_from_a_function_gives_demonstrations() -> None:
    source = Generated("bends", Plans(4, ("x", "y", "z"), ("m",) * 3), ("left", "right"), bends)
    training = source.split("train", 3, 1)
    assert training.concepts == ("left",) * 3 + ("right",) * 3
    assert training.lengths.tolist() == [2, 3, 4, 2, 3, 4]
    assert training.states.shape == (6, 4, 3)
    assert training.state_names == ("x", "y", "z")
    assert not torch.equal(training.states, source.split("validation", 3, 1).states)
    assert torch.equal(source.draw("left", 3, 1).states, training.select("left").states)
    assert source.starts("left", 3, 1) is None


def test_what_a_domain_does_not_say_has_a_default() -> None:
    plans = Plans(4, ("x", "y", "z"), ("m",) * 3)
    concepts = Concepts(("left", "right"), few_shot_suites(("left", "right"), ("up",)))
    domain = Domain("bends", plans, concepts, lambda root: Generated("bends", plans, concepts.training, bends))
    assert concepts.descriptions == ("left", "right", "up")
    assert concepts.reads("up")
    assert not concepts.reads("down")
    assert concepts.suites["new"].learned == ("up",)
    assert [task.setting for task in concepts.suites["training"].tasks] == ["training concept"] * 2
    assert domain.show.film is not None
    assert len(domain.show.film(torch.rand(4, 3))) == 4
    assert len(domain.show.picture(torch.rand(2, 4, 3), None, "bends", None).axes) == 2
    only = Concepts(("left",))
    assert only.suites["training"].goals == ("left",)
    assert only.descriptions == ("left",)
