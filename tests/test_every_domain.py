"""Each domain that ships, through the command line: a tiny fit, an inversion through it, samples of what it learned."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.testing.strokes import strokes
from tests.conftest import CONF, succeed
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


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("domain", NEW)
def test_a_domain_is_fitted_inverted_and_sampled_from(domain: str, tiny_of: Callable[[str], Path]) -> None:
    pretrained, new = tiny_of(domain), "new.npz" if domain == "own" else "new.safetensors"
    known = load_model(pretrained).domain
    if domain == "own":
        np.savez(new, states=strokes("heart", 2, 1), concepts="heart")
    else:
        recordings = pretrained.parents[3] / "recordings"  # of human motion
        source = known.source(recordings if recordings.is_dir() else None)
        drawn = (
            source.split("train", 1, 0) if domain == "driving" else source.draw(NEW[domain], 2, 0)
        )  # which an expert drives slowly
        replace(drawn.rows([0, 1]), concepts=(NEW[domain],) * 2).save(new)
    invert = ["invert", f"--config={CONF / domain}.yaml", f"--model.pretrained={pretrained}", f"--data.demonstrations={new}"]
    succeed(*invert, *QUICK, *(["--evaluation.closed_loop=false"] if known.closed_loop else []))
    (log,) = Path("logs").glob("*/invert")
    (file,) = (log / "concepts").iterdir()
    concept = Concept.load(file)
    assert concept.origin.name == NEW[domain]
    assert concept.embeddings.isfinite().all()
    if known.metrics:
        assert set(read_rows(log / "results.csv")["task"]) == {NEW[domain]}
    starts = [f"--initial={new}"] if known.observed else ["--count=2"]
    succeed("sample", f"--pretrained={pretrained}", f"--concept={file}", *starts, "--steps=2", "--sampler=ddim")
    samples = Demonstrations.load("states.safetensors").states
    assert len(samples) == 2
    assert samples.isfinite().all()
