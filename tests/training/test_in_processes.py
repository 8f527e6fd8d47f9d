"""``invert`` in several processes learns the concepts of one process."""

from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
import torch

from ftl_lightning.apps.lightning_cli import build
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.igm.concept import Concept, file_name
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.services.errors import UserError
from ftl_lightning.training import in_processes
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.in_processes import learned_in_processes
from ftl_lightning.training.trainer import Trainer
from tests.conftest import CONF, ROOT, inversion_module, refused, succeed

STEPS = 5


class Here:
    """In the place of processes: what they are to do is done in this one at once."""

    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, work: Callable[..., str], *arguments: object) -> "Future[str]":
        future: Future[str] = Future()
        with torch.inference_mode(False), torch.enable_grad():  # as in a new process
            future.set_result(work(*arguments))
        return future


class Stopped(Here):
    """In the place of processes of which one was killed from outside."""

    def submit(self, work: Callable[..., str], *arguments: object) -> "Future[str]":
        future: Future[str] = Future()
        future.set_exception(BrokenProcessPool())
        return future


@pytest.fixture(params=["here", pytest.param("elsewhere", marks=pytest.mark.slow)])
def _work(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What processes do, done by them or in this one."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    if request.param == "here":
        monkeypatch.setattr(in_processes, "ProcessPoolExecutor", Here)
        monkeypatch.setattr(in_processes, "silence", lambda: None)


def inversion(pretrained: Path, name: str, *options: str) -> list[str]:
    arguments = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), f"--model.pretrained={pretrained}"]
    arguments += [f"--data.steps={STEPS}", "--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0"]
    arguments += ["--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
    return [*arguments, f"--model.output={name}/concepts", f"--trainer.logger.init_args.save_dir={name}", *options]


@pytest.mark.slow
@pytest.mark.usefixtures("_work")
def test_two_processes_learn_the_concepts_of_one(tiny: Path) -> None:
    line = build("invert", inversion(tiny, "one")[1:])
    alone = line.model.model.learn_concepts(line.datamodule.demonstrations, line.model.settings, STEPS)
    assert len(alone) == 10
    succeed(*inversion(tiny, "two", "--trainer.processes=2"))
    assert len(list(Path("two/concepts").iterdir())) == len(alone)
    for name, one in alone.items():
        two = Concept.load(Path("two/concepts") / f"{file_name(name)}.safetensors")
        torch.testing.assert_close(two.embeddings, one.embeddings, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(two.weights, one.weights, rtol=1e-4, atol=1e-5)
        assert two.origin.demonstrations == one.origin.demonstrations
    hashes = set(read_rows(next(Path("two").rglob("results.csv")))["config_hash"])
    evaluator = next(callback for callback in line.trainer.callbacks if isinstance(callback, Evaluator))
    assert evaluator.config_hash(line.model, line.datamodule, line.trainer) in hashes  # how many learned is no part of a result


def demonstrations() -> Demonstrations:
    states = torch.rand(4, 1, 2, generator=torch.Generator().manual_seed(0))
    return Demonstrations(states, torch.ones(4, dtype=torch.int64), "", ("x", "y"), ("", ""), ("a", "a", "b", "b"))


@pytest.mark.usefixtures("_work")
def test_a_mistake_in_one_process_is_told_by_the_first(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere"):
        learned_in_processes(str(tmp_path / "nowhere"), torch.device("cpu"), demonstrations(), InversionSettings(), 1, 1)


def test_a_process_that_is_stopped_from_outside_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_processes, "ProcessPoolExecutor", Stopped)
    with pytest.raises(UserError, match=r"trainer\.processes: expected 2 processes to the end, one was stopped"):
        learned_in_processes("anything", torch.device("cpu"), demonstrations(), InversionSettings(), 1, 3)


def test_what_several_processes_do_not_look_at_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = InversionData("object_rearrangement", suite="validation", steps=STEPS)
    for options, told in (
        ({"processes": 0}, "trainer.processes: expected 1 or more"),
        ({"processes": 1000}, "trainer.processes: expected a number from 1 to 256"),
        ({"processes": 2, "gradient_clip_val": 0.5}, "trainer.gradient_clip_val: expected no such option"),
    ):
        with pytest.raises(UserError, match=told):
            Trainer(accelerator="cpu", logger=False, **options).invert(inversion_module(tiny), data)
    refused(capsys, inversion(tiny, "run", "--trainer.processes=0"), "trainer.processes: expected 1 or more")
