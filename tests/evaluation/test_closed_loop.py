"""Closed loop: lock-step, replanning, plans that are not finite, independence of the batch."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import Feature, InitialStates, Observed
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.execution import ClosedLoop
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation import closed_loop
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, reset, roll_out, sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.model_config import Prepared


class Line(gymnasium.Env[Any, Any]):
    """A point on a line; an action is its next step. It ends beyond 3."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.x = np.array(options["scene"], dtype=np.float32)
        return self.seen(), {}

    def seen(self) -> dict[str, Any]:
        picture = np.full((3, 2, 2), abs(int(self.x[0])) % 256, dtype=np.uint8)
        return {"place": self.x.copy(), "picture": picture}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.x[0] == 100:
            raise RuntimeError("the simulator broke")
        self.x = self.x + action
        return self.seen(), 0.0, bool(self.x[0] > 3), False, {"x": float(self.x[0])}


LOOP = ClosedLoop(
    environment=Line,
    act=lambda plans, step, observed: plans[:, step + 1] - observed["place"],
    steps=8,
    judge=lambda goal, rollout: {"success": rollout.observed["place"][:, -1, 0] > 3},
    film=lambda rollout, plans: [],
)


def begin(*places: float) -> InitialStates:
    """Episodes that start from these places."""
    return reset(LOOP, torch.tensor(places)[:, None])


def ahead(observed: Observed, rows: list[int]) -> Tensor:
    """One unit a step from wherever one stands."""
    return observed["place"][:, None] + torch.arange(9)[None, :, None]


@pytest.mark.parametrize("replan", [1, 3, 8])
def test_plans_are_followed_until_the_environment_ends_an_episode(replan: int) -> None:
    calls = []

    def plan(observed: Observed, rows: list[int]) -> Tensor:
        calls.append(list(rows))
        return ahead(observed, rows)

    policy = PlanFollower(plan, LOOP.act, replan)
    found = roll_out(LOOP, begin(0.0, -9.0), policy)
    assert found.observed["place"][0, :, 0].tolist() == [0, 1, 2, 3, 4, 4, 4, 4, 4]  # padded with its last
    assert found.observed["place"][1, :, 0].tolist() == list(range(-9, 0))
    assert not found.failed.any()
    assert calls == [[0, 1] if start < 4 else [1] for start in range(0, 8, replan)]
    assert [int(plan[0, 0]) for plan in policy.followed[0]] == [step - step % replan for step in range(4)]


def test_an_episode_without_a_finite_plan_or_whose_simulator_raises_fails_alone(caplog: pytest.LogCaptureFixture) -> None:
    def plan(observed: Observed, rows: list[int]) -> Tensor:
        plans = ahead(observed, rows)
        if observed["place"][0, 0] == 2:
            plans[0, -1] = float("nan")
        return plans

    found = roll_out(LOOP, begin(0.0, -9.0), PlanFollower(plan, LOOP.act, 1))
    assert found.failed.tolist() == [True, False]
    assert found.observed["place"][0, :, 0].tolist() == [0, 1, 2, 2, 2, 2, 2, 2, 2]
    assert found.observed["place"][1, -1, 0] == -1
    assert "episode 0, step 2: the plan is not finite" in caplog.text
    nowhere = PlanFollower(lambda observed, rows: torch.full((2, 9, 1), float("inf")), LOOP.act, 1)
    none = roll_out(LOOP, begin(0.0, 0.0), nowhere)  # all may fail
    assert none.failed.all()
    assert (none.observed["place"] == 0).all()
    found = roll_out(LOOP, begin(100.0, -9.0), PlanFollower(ahead, LOOP.act, 1))
    assert found.failed.tolist() == [True, False]
    assert "episode 0, step 0: RuntimeError('the simulator broke')" in caplog.text
    assert [info.get("x") for info in found.infos] == [None, -1]
    assert [len(part.infos) for part in found.split([1, 1])] == [1, 1]


def test_the_bar_moves_with_every_step_of_every_episode_and_reaches_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    @contextmanager
    def counted(title: str, total: int, lines: bool = True) -> Iterator[Any]:
        yield lambda steps=1: told.append(steps)
        assert sum(told) == total == 3 * LOOP.steps

    monkeypatch.setattr(closed_loop, "bar", counted)
    roll_out(LOOP, begin(0.0, -9.0, 100.0), PlanFollower(ahead, LOOP.act, 1))
    assert told.count(1) >= 4 + LOOP.steps + 1  # one arrives, one runs on, one breaks at once


def test_a_rollout_keeps_the_features_that_are_asked_for_and_parts_keep_their_own() -> None:
    starts = begin(0.0, -9.0)
    every = roll_out(LOOP, starts, PlanFollower(ahead, LOOP.act, 1))
    assert every.observed["picture"].shape == (2, 9, 3, 2, 2)
    assert every.observed["picture"].dtype == torch.uint8
    assert every.observed["picture"][1, :, 0, 0, 0].tolist() == [9, 8, 7, 6, 5, 4, 3, 2, 1]
    seen: list[set[str]] = []

    def watched(plans: Tensor, step: int, observed: Observed) -> Tensor:
        seen.append(set(observed))
        return LOOP.act(plans, step, observed)

    some = roll_out(replace(LOOP, keeps=("place",)), starts, PlanFollower(ahead, watched, 1))
    assert set(some.observed) == {"place"}
    assert torch.equal(some.observed["place"], every.observed["place"])
    assert all(one == {"place", "picture"} for one in seen)  # a policy sees them all
    first, second = every.split([1, 1])
    assert first.starts.require_scenes().tolist() == [[0]]
    assert second.starts.require_scenes().tolist() == [[-9]]
    assert torch.equal(second.observed["picture"], every.observed["picture"][1:])


def test_what_is_observed_at_a_start_comes_from_the_environment_unless_it_is_given() -> None:
    found = begin(4.0, -2.0)
    assert found.observed["place"].tolist() == [[4], [-2]]
    assert found.observed["picture"][:, 0, 0, 0].tolist() == [4, 2]
    with pytest.raises(UserError, match=r"key 'scenes': expected \(sample, scene\)"):
        roll_out(LOOP, InitialStates(found.observed), PlanFollower(ahead, LOOP.act, 1))


def test_fixed_plans_are_chosen_by_episode() -> None:
    plans = torch.arange(3.0)[:, None, None]
    assert fixed_plans(plans)({"place": torch.zeros(2, 1)}, [2, 0]).flatten().tolist() == [2, 0]


def model() -> GenerativeModel:
    torch.manual_seed(0)
    sizes: dict[str, Any] = {"horizon": 16, "state_dim": 1, "observed": {"place": Feature((1,))}, "diffusion_steps": 10}
    sizes |= {"denoiser": "TemporalUNet", "denoiser_args": {"width": 8, "multipliers": [1, 2]}}
    config = DiffusionConfig(domain="agent", concept_dim=6, training_concepts=("a", "b"), encoder="none", **sizes)
    limited = Normalization(torch.tensor([-10.0]), torch.tensor([10.0]))
    return GenerativeModel(Prepared(config, load_domain("agent"), limited, torch.randn(3, 6), limited)).eval()


def test_episodes_do_not_depend_on_their_neighbours() -> None:
    net = model()
    starts = begin(-2, -1, 0, 1, 2)
    concepts = [Composition(torch.randn(k, 1, 6, generator=generator("cpu", k)), torch.ones(k)) for k in (1, 2, 1, 2, 1)]

    def run(rows: list[int]) -> Tensor:
        draws = [generator("cpu", 0, row) for row in rows]
        plan = sampled_plans(net, [concepts[row] for row in rows], Sampling("ddpm", 5, 0.5), draws)
        return roll_out(LOOP, starts.take(rows), PlanFollower(plan, LOOP.act, 2)).observed["place"]

    together = run([0, 1, 2, 3, 4])
    for rows in ([0], [3, 1], [4, 2, 0]):
        torch.testing.assert_close(run(rows), together[rows], rtol=1e-4, atol=1e-4)
