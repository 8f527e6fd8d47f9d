"""Whatever the program of a user has set or does, learning and sampling give the same numbers: modes of torch, other processes."""

import multiprocessing
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import load_tensors
from tests import tiny
from tests.conftest import environment, refused, succeed

FIVE = strokes(TRAINING[0], 5, 7)


@contextmanager
def double() -> Iterator[None]:
    """Double precision by default."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
        assert torch.get_default_dtype() == torch.float64  # it is given back
    finally:
        torch.set_default_dtype(torch.float32)


MODES: dict[str, Callable[[], AbstractContextManager[object]]] = {
    "float64": double,
    "no_grad": torch.no_grad,
    "inference": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
}


def measured(states: np.ndarray | Tensor = FIVE) -> list[Tensor]:
    """Numbers of all calls of the API."""
    model = FewShot.from_pretrained("strokes")
    concept = model[TRAINING[0]]
    plans = model.sample(concept, 2, steps=3)
    learned = model.learn(states, steps=3, form="paper")
    known = model.check(states).known
    assert known is not None
    mixed = model.sample(0.5 * learned + concept, 2, steps=3)
    record = learned.quality.record
    numbers = [*known.losses, record.spread, record.novelty, *model.evaluate(plans, TRAINING[0]).values()]
    every = [plans.states, mixed.states, learned.concept.embeddings, learned.concept.weights]
    assert {values.dtype for values in every} == {torch.float32}
    return [*every, torch.tensor(numbers, dtype=torch.float64)]


@pytest.fixture(scope="module")
def usual() -> list[Tensor]:
    return measured()


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_numbers_are_the_same_in_every_mode_of_torch(mode: str, usual: list[Tensor]) -> None:
    with MODES[mode]():
        found = measured(torch.as_tensor(FIVE) + 0)  # an inference tensor, in its mode
    assert all(torch.equal(one, other) for one, other in zip(found, usual, strict=True))


@pytest.mark.slow
def test_fit_writes_the_same_bytes_with_another_default_dtype() -> None:
    fit = [*tiny.fit(Path("own.yaml")), "--trainer.max_steps=3", "--data.batch_size=8", "--evaluation.samples=2"]
    fit += ["--trainer.limit_val_batches=0", "--evaluation.figures=0"]
    succeed(*fit, "--model.output=single")
    with double():
        succeed(*fit, "--model.output=double")
    for name in ("config.json", "model.safetensors"):
        assert Path("double", name).read_bytes() == Path("single", name).read_bytes()
    assert {values.dtype for values in load_tensors(Path("double/model.safetensors"), "generative model")[0].values()} == {
        torch.float16,
        torch.float32,
    }


@pytest.mark.parametrize("precision", ["bf16-true", "16-true", "64-true", "64", "transformer-engine"])
def test_other_precisions_are_refused(precision: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, [*tiny.fit(Path("own.yaml")), f"--trainer.precision={precision}"], "trainer")


def test_the_refusal_names_what_is_supported(capsys: pytest.CaptureFixture[str]) -> None:
    expected = "trainer.precision: expected one of 32-true, bf16-mixed, 16-mixed, found '64-true'"
    refused(capsys, [*tiny.fit(Path("own.yaml")), "--trainer.precision=64-true"], expected)


@pytest.mark.parametrize("option", ["--optimizer=Adam", "--lr_scheduler=StepLR", "--optimizer.lr=1"])
def test_optimisers_are_no_option(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, [*tiny.fit(Path("own.yaml")), option], option.removeprefix("--").partition("=")[0])


# Other processes


def sampled(model: FewShot, concept: LearnedConcept, mixed: Composition) -> list[np.ndarray]:
    """Samples, in whatever process."""
    assert concept.model is model.model
    return [model.sample(one, 2, steps=2).states.numpy() for one in (concept, mixed)]


@pytest.mark.slow
def test_a_model_its_concepts_and_compositions_go_to_another_process() -> None:
    model = FewShot.from_pretrained("strokes")
    learned = model.learn(FIVE, steps=2, form="paper")
    mixed = 0.5 * learned + model[TRAINING[1]]
    here = sampled(model, learned, mixed)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(sampled, (model, learned, mixed))
    assert all(np.array_equal(one, other) for one, other in zip(here, there, strict=True))
    again, concept = pickle.loads(pickle.dumps((model, learned)))
    assert concept.quality.record == learned.quality.record
    assert again.model.hash == model.model.hash
    assert again.learn(FIVE, steps=2, form="paper").concept.origin == learned.concept.origin
    alone = pickle.loads(pickle.dumps(model[TRAINING[0]]))
    assert torch.equal(alone.embeddings, model[TRAINING[0]].embeddings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["agent", "driving", "mocap", "object_rearrangement"])
def test_every_shipped_model_comes_back_with_its_domain(name: str) -> None:
    model = FewShot.from_pretrained(name)
    again = pickle.loads(pickle.dumps(model))
    assert again.domain is model.domain
    assert again.model.view is model.model.view
    assert again.model.hash == model.model.hash


def test_a_domain_that_no_module_holds_is_not_pickled() -> None:
    known = load_domain("agent")
    with pytest.raises(UserError, match=r"pickle: expected a domain of a module, such as my_domain:DOMAIN, found 'mine' of none"):
        pickle.dumps(Domain("mine", known.plans, known.concepts, known.source))


# Readers that end first


@pytest.mark.slow
def test_an_inversion_whose_reader_ends_writes_every_concept() -> None:
    np.savez("two.npz", states=np.concatenate([FIVE, FIVE + 1]), concepts=np.repeat(["one", "two"], 5))
    command = f"{sys.executable} -m ftl_lightning invert strokes two.npz --steps 2 --form paper"
    run = subprocess.run(
        ["bash", "-c", f"{command} | head -1; exit ${{PIPESTATUS[0]}}"], env=environment(), capture_output=True, text=True
    )
    assert (run.returncode, run.stdout.count("\n")) == (0, 1), run.stderr
    assert "error" not in run.stderr.lower()
    assert sorted(path.name for path in Path("concepts").iterdir()) == ["one.safetensors", "two.safetensors"]


@pytest.mark.parametrize("words", ["--help", "concepts strokes", "check --help", "--version"])
def test_every_verb_ends_well_without_a_reader(words: str) -> None:
    command = f"{sys.executable} -m ftl_lightning {words} | true; exit ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", command], env=environment(), capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")
