"""Each domain that ships, through the command line: a tiny fit, an inversion through it, samples of what it learned."""

from collections.abc import Callable
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


@pytest.mark.parametrize("domain", NEW)
def test_a_domain_is_fitted_inverted_and_sampled_from(domain: str, tiny_of: Callable[[str], Path]) -> None:
    pretrained = tiny_of(domain)
    model = load_model(pretrained)
    if domain == "own":
        np.savez("new.npz", states=strokes("heart", 3, 1), concepts="heart")
        new = "new.npz"
    else:
        new = "new.safetensors"
        model.domain.source(None).draw(NEW[domain], 2, 0).save(new)
    quick = ["--model.form=paper", "--data.steps=2", "--model.budget.samples=2", "--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.sampler=ddim", "--evaluation.references=false", "--evaluation.diversity=false", "--evaluation.figures=0", *QUIET]
    quick += ["--evaluation.closed_loop=false"] if model.domain.closed_loop else []
    invert = ["invert", f"--config={CONF / domain}.yaml", f"--model.pretrained={pretrained}", f"--data.demonstrations={new}", *quick]
    succeed(*invert, "--model.output=concepts")
    (file,) = Path("concepts").iterdir()
    concept = Concept.load(file)
    assert concept.origin.name == NEW[domain]
    (log,) = Path("logs").glob("*/invert")
    rows = read_rows(log / "results.csv")
    assert NEW[domain] in set(rows["task"])
    succeed("sample", f"--pretrained={pretrained}", f"--concept={file}", f"--initial={new}", "--steps=2", "--sampler=ddim")
    assert len(Demonstrations.load("states.safetensors")) > 0
