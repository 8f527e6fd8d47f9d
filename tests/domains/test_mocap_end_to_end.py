"""The shipped model of human motion: behaviour, films and learning without recordings, and with a folder of made-up ones."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap.measures import bone_error
from ftl_lightning.domains.mocap.skeleton import GROUPS, HORIZON, POSE
from ftl_lightning.domains.mocap.source import Recorded
from ftl_lightning.evaluation.results import read_rows
from tests.conftest import CONF, ROOT, succeed
from tests.domains.mocap_samples import folder
from tests.tiny import QUIET

SHIPPED = ROOT / "pretrained" / "mocap"
JACKS = SHIPPED / "jumping_jacks.safetensors"


def test_motion_is_generated_and_filmed_without_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--compose=walk:0.6", "--count=2", "--steps=10", "--animation=jj.gif", "--out=jj.safetensors"]
    succeed("sample", f"--pretrained={SHIPPED}", f"--concept={JACKS}", *more)
    assert "jj.gif" in capsys.readouterr().out
    with Image.open("jj.gif") as film:
        assert film.n_frames >= HORIZON / 2  # type: ignore[attr-defined]
    found = Demonstrations.load("jj.safetensors")
    assert found.states.shape == (2, HORIZON, 42)
    starts = Recorded(None).starts("jumping jacks", 2, 0).observed[POSE]
    assert torch.allclose(found.states[:, 0], starts, atol=0.1)


@pytest.mark.slow
def test_most_of_what_the_shipped_concept_generates_raises_both_arms_and_legs_can_walk_below() -> None:
    model = FewShot.from_pretrained(SHIPPED)
    jacks, starts = model.load(JACKS), model.starts("jumping jacks", 20)
    plans = model.sample(jacks, observed=starts)
    assert model.evaluate(plans, "jumping jacks")["rise"] >= 0.5
    assert float(bone_error("jumping jacks", plans.states, starts).max()) < 1e-4
    assert model.evaluate(model.sample(model["walk"], observed=starts), "jumping jacks")["rise"] == 0
    both = model.sample(model.compose(f"walk@legs:1.8 + {JACKS}@arms,trunk"), observed=starts)
    legs = (both.states - plans.states)[..., list(GROUPS["legs"])].abs().amax(dim=(1, 2))
    assert (legs > 0.05).float().mean() > 0.5
    assert model.evaluate(both, "jumping jacks + walk")["rise"] >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("config", ["mocap.yaml", "mocap_adapter.yaml"])
def test_concepts_are_learned_judged_and_filmed_from_a_folder(config: str, tiny_of: Callable[[str], Path], tmp_path: Path) -> None:
    quick = ["--data.steps=2", "--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.figures=1", "--seed_everything=3"]
    quick += ["--data.demonstrations_per_concept=2", "--evaluation.sampler=ddim", *QUIET]
    arguments = [f"--data.root={folder(tmp_path / 'recordings')}", f"--model.pretrained={tiny_of('mocap')}"]
    suites = ["--data.suite=validation", "--evaluation.suites=[validation]"]
    succeed("invert", f"--config={CONF / config}", *arguments, *quick, *suites)
    rows = read_rows("logs/mocap/invert/results.csv")
    assert {"frozen frame", "demonstrations replayed"} < set(rows["method"])
    assert {"accuracy", "rise", "bone error", "jerk"} < set(rows["metric"])
    assert set(rows["setting"]) == {"new concept", "new concept, demonstrated poses"}
    events = EventAccumulator("logs/mocap/invert", size_guidance={"images": 0}).Reload()
    assert "2 plans in motion/new concept/knee raise" in events.Tags()["images"]
