"""Each domain that ships, through the command line: a tiny fit, an inversion through it, samples of what it learned."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.igm.concept import Concept
from ftl_lightning.training.model_folder import load_model
from tests.conftest import CONF, Once, succeed
from tests.tiny import QUIET

NEW = {
    "agent": "go to red bowl",
    "driving": "roundabout",
    "mocap": "jumping jacks",
    "object_rearrangement": "square diagonal to triangle",
    "own": "heart",
    "tabletop": "push green circle to orange triangle on book",
}
"""A concept of each domain that is learned."""
QUICK = [
    "--model.form=paper",
    "--data.steps=2",
    "--model.budget.samples=2",
    *QUIET,
    "--evaluation.samples=1",
    "--evaluation.steps=2",
]
QUICK += ["--evaluation.sampler=ddim", "--evaluation.references=false", "--evaluation.diversity=false", "--evaluation.figures=0"]


@pytest.fixture(params=NEW)
def learned(request: pytest.FixtureRequest, once: Once, tiny_of: Callable[[str], Path], drawn: None) -> tuple[str, Path, Path]:
    """A domain, its tiny model, and a folder with demonstrations of a new concept and the logs of its inversion."""
    domain, pretrained = request.param, tiny_of(request.param)

    def invert(folder: Path) -> None:
        known, new = load_model(pretrained).domain, demonstrations(domain)
        if domain == "own":
            np.savez(new, states=strokes("heart", 2, 1), concepts="heart")
        else:
            recordings = pretrained.parents[3] / "recordings"  # of human motion
            source = known.source(recordings if recordings.is_dir() else None)
            # An expert drives slowly.
            drawn = source.split("train", 1, 0) if domain == "driving" else source.draw(NEW[domain], 2, 0)
            replace(drawn.rows([0, 1]), concepts=(NEW[domain],) * 2).save(new)
        options = [*QUICK, *(["--evaluation.closed_loop=false"] if known.closed_loop else [])]
        options += [f"--model.pretrained={pretrained}", f"--data.demonstrations={new}"]
        succeed("invert", f"--config={CONF / domain}.yaml", *options)

    return domain, pretrained, once(f"learned_{domain}", invert)


def demonstrations(domain: str) -> str:
    """The name of the file of the new concept."""
    return "new.npz" if domain == "own" else "new.safetensors"


def concept(folder: Path) -> Path:
    """The file of the concept that was learned."""
    (file,) = folder.glob("logs/*/invert/concepts/*")
    return file


def test_a_domain_is_fitted_and_a_new_concept_is_learned_and_evaluated(learned: tuple[str, Path, Path]) -> None:
    domain, pretrained, folder = learned
    found = Concept.load(concept(folder))
    assert found.origin.name == NEW[domain]
    assert found.embeddings.isfinite().all()
    if load_model(pretrained).domain.metrics and domain != "own":  # a few demonstrations do not calibrate its metric
        (log,) = folder.glob("logs/*/invert")
        assert set(read_rows(log / "results.csv")["task"]) == {NEW[domain]}


def test_what_was_learned_is_sampled_from(learned: tuple[str, Path, Path]) -> None:
    domain, pretrained, folder = learned
    observed = load_model(pretrained).domain.observed
    starts = [f"--initial={folder / demonstrations(domain)}"] if observed else ["--count=2"]
    succeed("sample", f"--pretrained={pretrained}", f"--concept={concept(folder)}", *starts, "--steps=2", "--sampler=ddim")
    samples = Demonstrations.load("states.safetensors").states
    assert len(samples) == 2
    assert samples.isfinite().all()
