"""The programs in ``examples`` that are single files: their experts do what they show."""

import runpy
from typing import Any

import pytest

from tests.conftest import ROOT


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "examples" / name))


def test_the_pendulum_swings_by_its_amplitude() -> None:
    make, right = example("pendulum.py")["Swing"], 0
    for seed in range(5):  # they begin at any angle, and some are not calm after half of the time
        swing = make(1.4)
        shown = swing.demonstrations(1, seed)
        assert shown.actions is not None
        assert shown.actions.shape == (1, 121, 1)
        right += abs(max(swing.angles) - 1.4) < 0.2
    assert right >= 4


def test_the_arm_reaches_its_targets() -> None:
    pytest.importorskip("panda_gym", reason="the extra 'arm' is not installed")
    module = example("panda.py")
    assert not module["TASKS"].keys() & module["NEW"].keys()
    for task in module["NEW"].values():
        arm = module["Arm"](task)
        arm.reset(seed=3)
        for _ in range(module["STEPS"]):
            *_, info = arm.step(arm.expert())
        assert info["is_success"]
        arm.close()
