"""A task of one's own, from arrays: what the page says to do."""

import re
from typing import Any

import pytest

from ftl_lightning.domains.tabletop import DOMAIN
from ftl_lightning.domains.tabletop.interface import IMAGE, POSE, PUSH_TO_WHITE
from ftl_lightning.few_shot.learner import FewShot
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "domains" / "table-top.md"
COUNT = 2


@pytest.mark.slow
def test_a_task_of_ones_own_is_learned_from_arrays(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    drawn = DOMAIN.source(None).draw(PUSH_TO_WHITE, COUNT, 5)
    lengths = drawn.lengths.tolist()

    def arrays(values: Any) -> list[Any]:
        return [values[row, :length].numpy() for row, length in enumerate(lengths)]

    plain = FewShot.learn
    monkeypatch.setattr(FewShot, "learn", lambda self, *own, **options: plain(self, *own, **options, steps=4))
    known: dict[str, Any] = {
        "commands": arrays(drawn.states),
        "images": arrays(drawn.observed[IMAGE]),
        "poses": arrays(drawn.observed[POSE]),
    }
    exec(compile(example, str(PAGE), "exec"), known)
    assert f"{COUNT} demonstrations of {min(lengths)} to {max(lengths)} steps, 4 columns" in capsys.readouterr().out
    assert known["plans"].states.shape == (1, DOMAIN.plans.horizon, 4)
    assert known["concept"].concept.origin.name == "my task"
