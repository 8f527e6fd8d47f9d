"""The example package `ftl-metaworld`: its environment, experts, suites, and the rival with the network of our model."""

from collections.abc import Iterator
from pathlib import Path

import nbformat
import numpy as np
import pytest
import torch

pytest.importorskip("metaworld", reason="metaworld, of the extra 'dev', is not installed")

from ftl_lightning.cli.main import main
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.closed_loop import roll_out
from ftl_lightning.networks.text_encoder import TableEncoder
from tests.conftest import ROOT, succeed
from tests.domains.test_domain import offering

FOLDER = ROOT / "examples" / "ftl-metaworld"
POINTS = """[ftl_lightning.domains]
ml10 = ftl_metaworld:ML10
[ftl_lightning.methods]
bc-chunks = ftl_metaworld.cloning:METHOD
"""
DRAWER, PLACE = "pull a drawer open by its handle", "pick up a puck and carry it to a goal"


@pytest.fixture(autouse=True)
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package as if it were installed."""
    monkeypatch.syspath_prepend(FOLDER)
    with offering(tmp_path / "packages", "ftl-metaworld", POINTS, monkeypatch):
        yield
    load_domain.cache_clear()


@pytest.fixture
def ml10(offered: None) -> Domain:
    return load_domain("ml10")


def test_the_suites_are_those_of_the_benchmark(ml10: Domain) -> None:
    import ftl_metaworld
    from ftl_metaworld.tasks import NAMES, NUMBER
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ML10_V3, ML45_V3

    assert {f"{name}-v3" for name in NAMES} == set(ALL_V3_ENVIRONMENTS)
    for domain, tasks in ((ml10, ML10_V3), (ftl_metaworld.ML45, ML45_V3)):
        for suite, part in (("training", "train"), ("paper", "test")):
            assert {f"{NAMES[NUMBER[goal]]}-v3" for goal in domain.concepts.suites[suite].goals} == set(tasks[part])
    tuned = set(ml10.concepts.suites["validation"].goals)
    assert not tuned & {*ml10.concepts.training, *ml10.concepts.suites["paper"].goals}
    left_out = [goal for domain in ftl_metaworld.FOLDS for goal in domain.concepts.suites["paper"].goals]
    assert sorted(left_out) == sorted(ftl_metaworld.ML45.concepts.training)
    assert all(not {*fold.concepts.training} & {*fold.concepts.suites["paper"].goals} for fold in ftl_metaworld.FOLDS)
    assert ml10.concepts.table is not None
    assert len(TableEncoder(ml10.concepts.table)(list(NUMBER)).unique(dim=0)) == 50  # every text, and all differ


def test_an_episode_follows_from_scene_and_actions(ml10: Domain) -> None:
    from ftl_metaworld.environment import MetaWorld
    from ftl_metaworld.source import scenes

    first, other = (next(scenes(task, 3)) for task in (PLACE, DRAWER))
    moves = np.random.default_rng(0).uniform(-1, 1, (30, 4))

    def episode(env: MetaWorld) -> np.ndarray:
        seen = [env.reset(options={"scene": first})[0]["world"]]
        return np.stack(seen + [env.step(move)[0]["world"] for move in moves])

    fresh, used = MetaWorld(), MetaWorld()
    used.reset(options={"scene": other})
    used.step(moves[0])
    assert np.array_equal(episode(fresh), episode(used))
    assert np.array_equal(episode(fresh), episode(fresh))


def test_touches_are_those_of_the_benchmark(ml10: Domain) -> None:
    from ftl_metaworld.environment import MetaWorld
    from ftl_metaworld.source import act, scenes
    from metaworld.sawyer_xyz_env import SawyerXYZEnv

    env, touched = MetaWorld(), set()
    env.reset(options={"scene": next(scenes("pick up a block and put it on a shelf", 3))})
    for _ in range(60):
        env.step(act(env))
        geom = env._simulator._get_id_main_object()
        touched.add(env._simulator.touching_object(geom))
        assert env._simulator.touching_object(geom) == SawyerXYZEnv.touching_object(env._simulator, geom)
    assert touched == {False, True}


def test_demonstrations_succeed_and_hold_the_actions_of_the_expert(ml10: Domain) -> None:
    from ftl_metaworld.environment import MetaWorld
    from ftl_metaworld.source import act

    source = ml10.source(None)
    shown = source.draw(DRAWER, 2, 7)
    again = source.draw(DRAWER, 2, 7)
    assert shown.hash == again.hash
    assert source.draw(DRAWER, 2, 8).hash != shown.hash
    assert shown.states.abs().max() <= 1
    env = MetaWorld()
    assert shown.scenes is not None
    seen, _ = env.reset(options={"scene": shown.scenes[0].numpy()})
    np.testing.assert_array_equal(seen["world"], shown.observed["world"][0, 0])
    np.testing.assert_array_equal(act(env), shown.states[0, 1])  # a state is the action before it


def test_the_expert_and_the_demonstration_in_its_own_scene_succeed(ml10: Domain) -> None:
    loop = ml10.closed_loop
    assert loop is not None
    shown = ml10.source(None).draw(DRAWER, 2, 7)
    starts = ml10.source(None).starts(DRAWER, 2, 11)
    for name, initial in (("expert (oracle)", starts), ("shifted demonstration", shown.initial_states)):
        policy = loop.policies[name](DRAWER, initial, shown, 0)
        assert policy is not None
        assert loop.judge(DRAWER, roll_out(loop, initial, policy))["success"].all(), name
    policy = loop.policies["expert (oracle)"](DRAWER, starts, shown, 0)
    assert policy is not None
    assert not loop.judge(PLACE, roll_out(loop, starts, policy))["success"].any()  # its scenes are of another task
    assert loop.policies["shifted demonstration"](DRAWER, starts, None, 0) is None  # a training concept has none


def test_places_are_relative_to_the_hand_and_absent_objects_are_zero(ml10: Domain) -> None:
    from ftl_metaworld.domain import relative

    world = ml10.source(None).starts("reach a goal with the hand", 1, 0).observed["world"]
    moved = world.clone()
    shift = torch.tensor([0.1, -0.05, 0.02])
    for columns in (slice(0, 3), slice(4, 7), slice(18, 21)):  # hand, first object and goal
        moved[:, columns] += shift
    features, others = (relative({"world": each})["world"] for each in (world, moved))
    same = (features - others).abs()[0] < 1e-6
    assert same[22:].all()  # displacements
    assert not same[:3].any()
    assert (features[0, 7:10] == 0).all()  # there is no second object
    assert (features[0, 25:28] == 0).all()


def test_a_film_and_a_picture_are_drawn(ml10: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    from ftl_metaworld import rendering

    monkeypatch.setattr(rendering, "_renderer", lambda model: None)  # as without OpenGL
    loop = ml10.closed_loop
    assert loop is not None
    starts = ml10.source(None).starts(DRAWER, 1, 11)
    policy = loop.policies["expert (oracle)"](DRAWER, starts, None, 0)
    assert policy is not None
    rollout = roll_out(loop, starts, policy)
    film = rendering.vector_film(rollout)
    assert len({len(shape.points) for shape in film.shapes} - {1}) == 1
    frames = rendering.film(rollout, torch.zeros(4, 17, 4))
    assert frames[0].dtype == np.uint8
    assert frames[0].ndim == 3
    plans = torch.rand(2, 17, 4) * 2 - 1
    assert len(rendering.render(plans, [True, False], "plans", None).axes) >= 2


@pytest.mark.slow
def test_the_rival_is_pretrained_adapted_and_learned_from_scratch(ml10: Domain) -> None:
    """The commands of the README, small."""
    few = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--evaluation.samples=1"]
    few += ["--evaluation.references=false"]
    network = "--model.network={hidden_dim: 16, depth: 2, condition_dim: 8, initial_dim: 8}"
    fit = ["fit", f"--config={FOLDER / 'conf' / 'bc.yaml'}", *few, network, "--trainer.max_steps=2", "--data.steps_per_epoch=2"]
    fit += ["--data.samples_per_concept=1", "--data.validation_per_concept=1", "--data.batch_size=8"]
    succeed(*fit)
    small = [*few, "--data.steps=3", "--evaluation.closed_loop=false"]
    for number, names in enumerate((["bc"], ["bc", "lora"], ["bc", "full"], ["bc_scratch"])):
        configs = [f"--config={FOLDER / 'conf' / f'{name}.yaml'}" for name in names]
        assert main(["invert", *configs, *small, f"--model.output=concepts{number}"]) == 0
        assert len(list(Path(f"concepts{number}").glob("*.safetensors"))) == 5


@pytest.mark.notebook
def test_the_notebook_runs(ml10: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FOLDER)
    cells = [cell for cell in nbformat.read("meta_world.ipynb", as_version=4).cells if cell.cell_type == "code"]
    names: dict[str, object] = {}
    for cell in cells:
        exec(compile(cell.source, "meta_world.ipynb", "exec"), names)
        assert cell.outputs or cell is cells[0]
