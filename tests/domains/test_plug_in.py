"""A domain in a package of its own: found by its entry point or by its module, and what such a domain need not say."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import Concepts, Domain, Generated, Plans
from ftl_lightning.domains.registry import domain_names, load_domain, recorded_name
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import InversionData, PretrainingData
from tests.conftest import ROOT, Once, python, refused, succeed
from tests.domains.test_domain import offering

EXAMPLES = ROOT / "examples"
EXAMPLE = EXAMPLES / "ftl-strokes"
SMALL = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--model.denoiser_args={hidden_dim: 16, depth: 1}"]
SMALL += ["--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0", "--evaluation.sampler=ddim"]
SMALL += ["--evaluation.references=false", "--evaluation.diversity=false"]
FIT = ["fit", f"--config={EXAMPLE / 'strokes.yaml'}", *SMALL, "--trainer.max_steps=2", "--data.steps_per_epoch=2"]
FIT += ["--data.samples_per_concept=2", "--data.batch_size=8"]
INVERT = ["invert", f"--config={EXAMPLE / 'strokes_invert.yaml'}", *SMALL[:2], *SMALL[3:], "--data.steps=2"]
INVERT += ["--model.budget.samples=2"]
FOLDER = "logs/strokes/fit/pretrained"
SAMPLE = ["sample", f"--pretrained={FOLDER}", "--count=3", "--steps=2", "--sampler=ddim"]
LEARNED = ["--concept=logs/strokes/invert/concepts/wave_upwards.safetensors", "--goal=wave upwards"]
VERBS = """
import json, sys
from ftl_lightning.cli.main import main
for arguments in map(json.loads, sys.argv[1:]):
    if code := main(arguments):
        sys.exit(code)
"""


def installed(folder: Path) -> None:
    """Install examples as packages into ``packages``, with one start of pip."""
    sources = [folder / name for name in ("ftl-strokes", "ftl-flow")]
    for source in sources:
        shutil.copytree(EXAMPLES / source.name, source, ignore=shutil.ignore_patterns("logs", "build", "*.egg-info", "__pycache__"))
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(folder / "packages")]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, *map(str, sources)], check=True)


@pytest.fixture
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The example as if it were installed: its module and its entry points are on Python's path."""
    groups = tomllib.loads((EXAMPLE / "pyproject.toml").read_text("utf-8"))["project"]["entry-points"]
    ((group, points),) = groups.items()
    monkeypatch.syspath_prepend(EXAMPLE)
    text = "\n".join((f"[{group}]", *(f"{name} = {value}" for name, value in points.items())))
    with offering(tmp_path / "packages", "ftl-strokes", text, monkeypatch):
        yield


@pytest.mark.release
def test_an_installed_domain_is_used_by_its_name(once: Once) -> None:
    path = os.pathsep.join(map(str, (once("plug_ins", installed) / "packages", ROOT)))
    sample = [*SAMPLE, *LEARNED, "--figure=s.png", "--animation=s.gif"]
    done = python("-c", VERBS, *map(json.dumps, (FIT, INVERT, sample)), PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert json.loads(Path(FOLDER, "config.json").read_text())["domain"] == "strokes"
    assert sorted(path.stem for path in Path("logs/strokes/invert/concepts").iterdir()) == ["wave_upwards", "zigzag_leftwards"]
    assert "new concept,wave upwards" in Path("logs/strokes/invert/results.csv").read_text()
    assert "accuracy on 'wave upwards'" in done.stdout
    samples = Demonstrations.load("states.safetensors")
    assert samples.domain == "strokes"
    assert samples.states.shape == (3, 32, 2)
    assert Path("s.png").stat().st_size > 0
    assert Path("s.gif").stat().st_size > 0


def test_a_domain_that_an_entry_point_offers_is_used_by_its_name(offered: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert "strokes" in domain_names()
    assert recorded_name("ftl_strokes:DOMAIN") == "strokes"
    succeed(*FIT)
    assert json.loads(Path(FOLDER, "config.json").read_text())["domain"] == "strokes"
    succeed(*SAMPLE, "--compose=arc upwards", "--goal=arc upwards")
    assert "accuracy on 'arc upwards'" in capsys.readouterr().out
    assert Demonstrations.load("states.safetensors").domain == "strokes"


@pytest.mark.slow
def test_a_domain_that_is_not_installed_is_used_by_its_module(strokes: Domain, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (FIT, INVERT):
        succeed(*arguments, "--data.domain=ftl_strokes:DOMAIN")
    # By this name, and no other, the domain is found again.
    assert json.loads(Path(FOLDER, "config.json").read_text())["domain"] == "ftl_strokes:DOMAIN"
    sample = [*SAMPLE, "--compose=arc upwards"]
    refused(capsys, sample, "give --trust ftl_strokes")  # a folder names no code: a person does
    succeed(*sample, "--trust=ftl_strokes")
    succeed(*sample, f"--settings={EXAMPLE / 'strokes_invert.yaml'}", "--trust=ftl_strokes")
    names = "agent, driving, driving_wide, mocap, mocap_root, object_rearrangement, tabletop, tabletop_wide"
    refused(capsys, ["generate", "strokes"], f"domain: expected one of {names}, or package.module:DOMAIN, found 'strokes'")


@pytest.fixture
def strokes(monkeypatch: pytest.MonkeyPatch) -> Domain:
    monkeypatch.syspath_prepend(EXAMPLE)
    return load_domain("ftl_strokes:DOMAIN")


def test_the_example_is_small_and_its_strokes_of_each_kind_are_recognised_as_that_kind_alone(strokes: Domain) -> None:
    source, measure = strokes.source(None), strokes.metrics["accuracy"].measure
    for kind in strokes.concepts.descriptions:
        drawn = source.draw(kind, 50, 0).states
        for goal in strokes.concepts.descriptions:
            assert measure(goal, drawn, None).float().mean() == float(goal == kind)
    assert not measure("arc upwards", torch.randn(50, 32, 2), None).any()
    assert len((EXAMPLE / "ftl_strokes.py").read_text().splitlines()) <= 50


def test_the_expert_s_pushes_are_right_in_open_and_closed_loop_and_a_random_target_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES / "ftl-pushes")
    pushes = load_domain("ftl_pushes:DOMAIN")
    source, measure, loop = pushes.source(None), pushes.metrics["accuracy"].measure, pushes.closed_loop
    assert loop is not None
    for task in pushes.concepts.descriptions:
        drawn = source.draw(task, 40, 0)
        starts = drawn.initial_states
        assert torch.equal(starts.observed["world"], starts.require_scenes())
        assert measure(task, drawn.states, starts).all()
        assert measure(task, pushes.comparison.references["random target"](task, 40, starts, 0), starts).float().mean() < 0.8
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
    rearranged = InversionData("ftl_lightning.domains.object_rearrangement:DOMAIN", suite="validation")
    assert rearranged.domain_name == "object_rearrangement"
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
