"""A file of demonstrations with texts is a domain."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import warped_distances
from ftl_lightning.data.features import Feature
from ftl_lightning.domains.from_file import METRICS, domain_from_file, own_domain, read_own
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.settings import BudgetOptions
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from ftl_lightning.networks.text_encoder import HashingEncoder
from ftl_lightning.services.errors import Note, UserError
from ftl_lightning.training.data import InversionData, OwnData
from ftl_lightning.training.inversion_module import InversionModule
from ftl_lightning.training.model_folder import load_model, save_model
from ftl_lightning.training.quality import calibration_of, judged, right_plans
from ftl_lightning.training.trainer import Trainer

SLOPES = {"go right": (1.0, 0.0), "go up": (0.0, 1.0), "go between": (0.5, 0.5)}
TIME = 12


def walks(text: str, count: int, seed: int = 0, time: int = TIME) -> np.ndarray:
    """Straight walks ``(count, time, 2)`` with a little noise, of one unit a step."""
    noise = 0.05 * np.random.default_rng(seed).standard_normal((count, time, 2))
    return np.arange(time)[None, :, None] * np.array(SLOPES[text]) + noise


def write(path: Path, texts: tuple[str, ...] = ("go right", "go up"), count: int = 6, **more: object) -> str:
    """A file of walks, those of the second text shorter."""
    states = np.concatenate([walks(text, count, seed) for seed, text in enumerate(texts)])
    lengths = np.repeat([TIME - 4 * (number == 1) for number in range(len(texts))], count)
    for row, length in enumerate(lengths):
        states[row, length:] = states[row, length - 1]
    np.savez(path, states=states, lengths=lengths, concepts=np.repeat(texts, count), **more)  # type: ignore[arg-type]
    return str(path)


@pytest.fixture
def file(tmp_path: Path) -> str:
    return write(tmp_path / "walks.npz")


def examples(**texts: np.ndarray) -> Demonstrations:
    """Demonstrations of full length by their text, with ``_`` for a blank."""
    states = torch.cat([torch.from_numpy(values).float() for values in texts.values()])
    concepts = tuple(name.replace("_", " ") for name, values in texts.items() for _ in values)
    return Demonstrations(states, torch.full((len(states),), states.shape[1]), "", ("x", "y"), ("m", "m"), concepts)


def test_a_file_is_a_domain_which_has_no_headline_without_metrics(file: str) -> None:
    domain = domain_from_file(file, None, {"end_point_within": 1.0, "dtw_to_demonstrations": 1}, 0.1)
    assert domain.concepts.training == ("go right", "go up")
    assert domain.concepts.table is None
    assert domain.plans.horizon == TIME  # the longest demonstration
    assert domain_from_file(file, 5, {}, 0.1).plans.horizon == 5
    assert [task.goal for task in domain.concepts.suites["training"].tasks] == ["go right", "go up"]
    assert domain.concepts.reads("go up")
    assert not domain.concepts.reads("go between")
    assert domain.main_metric == domain.comparison.headline == "end_point_within"
    assert [domain.less_is_better(name) for name in domain.metrics] == [False, True]
    assert domain.show.film is not None
    assert domain.observed == {}
    known = examples(go_right=walks("go right", 2), go_up=walks("go up", 2, 1))
    domain = own_domain(known, ("go right",), TIME, {})
    assert domain.metrics == {}
    assert domain.comparison.headline == ""
    assert domain.concepts.reads("go up")  # it can be compared with, though it is no training concept
    assert domain.concepts.training == ("go right",)


def test_random_demonstrations_of_each_concept_are_held_out_and_a_task_has_the_first(file: str) -> None:
    everything = Demonstrations.load(file)
    for share, held in ((0.01, 1), (0.1, 1), (0.34, 2), (0.5, 3)):
        source = domain_from_file(file, None, {}, share).source(None)
        train, validation = (source.split(name, 99, 0) for name in ("train", "validation"))  # type: ignore[arg-type]
        assert validation.concepts == ("go right",) * held + ("go up",) * held
        rows = [bytes(states.numpy()) for states in everything.states]
        out = [rows.index(bytes(states.numpy())) for states in validation.states]
        assert out == sorted(set(out))
        assert [row < 6 for row in out] == [True] * held + [False] * held
        assert sorted([*out, *(rows.index(bytes(states.numpy())) for states in train.states)]) == list(range(12))
        assert domain_from_file(file, None, {}, share).source(None).split("validation", 9, 9).hash == validation.hash
    assert out != [3, 4, 5, 9, 10, 11]  # not the last, which may be of another session
    assert torch.equal(source.split("train", 1, 7).states, train.states)  # count and seed are the file's matter
    source = domain_from_file(file, None, {}, 0.1).source(None)
    assert torch.equal(source.draw("go up", 2, 0).states, everything.states[6:8])
    for task, count, found in (("go up", 7, 6), ("go between", 1, 0)):
        with pytest.raises(UserError, match=f"task: expected {count} demonstrations of {task!r} in the file, found {found}"):
            source.draw(task, count, 0)
    assert source.starts("go up", 3, 0) is None


def test_recognised_is_shown_only_where_ten_held_out_demonstrations_of_each_concept_calibrate_it(tmp_path: Path) -> None:
    for held, shown in ((10, True), (9, False)):
        known = examples(go_right=walks("go right", held), go_up=walks("go up", 10, 1), go_between=walks("go between", 5, 2))
        domain = own_domain(known, ("go right", "go up"), TIME, {"recognised": 0.98, "end_point_within": 1.0})
        plans = examples(go_between=walks("go between", 20, 3))
        assert (right_plans(domain.measure("go between", plans.states, None)) or ("", 0))[0] == METRIC[shown]
        text = calibration_of(domain, "go between")
        if shown:
            assert re.fullmatch(r"accepts [01]\.\d\d of held-out demonstrations by 5 others of their concept", text)
            assert judged(domain, plans, "go between")["recognised"] > 0.5
            continue
        assert text == (
            "recognised is not shown: it needs 10 held-out demonstrations of each training concept, and 'go right' has 9; "
            "fit with a larger data.validation_share"
        )
        with pytest.warns(Note, match="recognised is not shown"):
            assert list(judged(domain, plans, "go between")) == ["end_point_within"]
    few = write(tmp_path / "few.npz")
    with pytest.warns(Note, match="few.npz: recognised is not shown: it needs 10 held-out demonstrations of .* 'go right' has 1;"):
        OwnData(few, {"recognised": 0.98}, encoder="hashing").setup("fit")
    many = write(tmp_path / "many.npz", count=20)
    with pytest.warns(Note, match=r"many.npz: recognised accepts [01]\.\d\d of held-out demonstrations by 10 others"):
        OwnData(many, {"recognised": 0.98}, validation_share=0.5, encoder="hashing").setup("fit")


METRIC = {True: "recognised", False: "end_point_within"}


def test_initial_states_are_those_of_held_out_demonstrations(tmp_path: Path) -> None:
    places = np.arange(12.0)[:, None]
    domain = domain_from_file(write(tmp_path / "w.npz", **{"observed/place": places}), None, {}, 0.34)
    assert domain.observed == {"place": Feature((1,))}
    starts = domain.source(None).starts("go up", 50, 3)
    assert starts is not None
    held_out = domain.source(None).split("validation", 0, 0).observed["place"]
    assert set(starts.observed["place"].flatten().tolist()) == set(held_out.flatten().tolist())
    again, other = (domain.source(None).starts("go up", 50, seed) for seed in (3, 4))
    assert again is not None
    assert other is not None
    assert torch.equal(again.observed["place"], starts.observed["place"])
    assert not torch.equal(other.observed["place"], starts.observed["place"])


def test_files_and_options_that_are_no_domain_are_told_and_files_without_texts_give_their_names(tmp_path: Path, file: str) -> None:
    one = write(tmp_path / "one.npz", ("go up",))
    few = write(tmp_path / "few.npz", count=1)
    for path, message in (
        (one, r"one\.npz: key 'concepts': expected texts of two concepts or more to pretrain on, found only 'go up'"),
        (few, r"few\.npz: concept 'go right': expected two demonstrations or more \(one is held out\), found 1"),
        (str(tmp_path / "none.npz"), r"none\.npz: expected a demonstrations file, found nothing"),
    ):
        with pytest.raises(UserError, match=message):
            domain_from_file(path, None, {}, 0.1)
    with pytest.raises(UserError, match=r"data\.metrics: expected some of recognised, nearest_demonstration, .*, found accuracy"):
        domain_from_file(file, None, {"accuracy": 1}, 0.1)
    options: dict[str, Any]
    for options, message in (
        ({"validation_share": 0.0}, r"data\.validation_share: expected a share between 0 and 1, found 0.0"),
        ({"validation_share": 1.0}, r"data\.validation_share: expected a share between 0 and 1, found 1.0"),
        ({"encoder": "table"}, "encoder: expected 'minilm', 'hashing' or a language model, found 'table'"),
        ({"metrics": {"fid": 1}}, r"data\.metrics: expected some of"),
        ({"horizon": 0}, r"data\.horizon: expected 1 or more, found 0"),
    ):
        with pytest.raises(UserError, match=message):
            OwnData(file, **({"encoder": "hashing"} | options))
    np.savez(tmp_path / "wave.npz", states=np.zeros((2, 3, 1)))
    assert read_own(str(tmp_path / "wave.npz")).concepts == ("wave", "wave")  # without texts, named after the file


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), columns=st.integers(1, 3))
def test_warping_is_that_of_a_plain_double_loop(seed: int, columns: int) -> None:
    draw = np.random.default_rng(seed)
    states, others = draw.standard_normal((3, 6, columns)), draw.standard_normal((4, 8, columns))
    lengths, other_lengths = draw.integers(1, 7, 3), draw.integers(1, 9, 4)

    def plain(one: np.ndarray, other: np.ndarray) -> float:
        total = np.full((len(one) + 1, len(other) + 1), np.inf)
        total[0, 0] = 0
        for i, here in enumerate(one):
            for j, there in enumerate(other):
                total[i + 1, j + 1] = np.linalg.norm(here - there) + min(total[i, j], total[i, j + 1], total[i + 1, j])
        return float(total[-1, -1] / max(len(one), len(other)))

    found = warped_distances(
        torch.from_numpy(states), torch.from_numpy(lengths), torch.from_numpy(others), torch.from_numpy(other_lengths)
    )
    expected = [
        [plain(one[:length], other[:end]) for other, end in zip(others, other_lengths, strict=True)]
        for one, length in zip(states, lengths, strict=True)
    ]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_pace_does_not_matter_when_time_is_warped() -> None:
    even, whole = torch.linspace(0, 1, 9)[None, :, None], torch.tensor([9])
    slow_then_fast = torch.tensor([0.0, 0, 0, 0, 0.25, 0.5, 0.75, 1, 1])[None, :, None]
    same, pace, other = (warped_distances(one, whole, even, whole).item() for one in (even, slow_then_fast, 1 - even))
    assert same == 0
    assert pace < 0.06
    assert other > 0.3


def test_most_of_the_nearest_demonstrations_decide() -> None:
    known = examples(go_right=walks("go right", 5), go_up=walks("go up", 5, 1))
    plans = torch.from_numpy(np.concatenate([walks("go right", 2, 7), walks("go up", 2, 8)])).float()
    for count in (1, 3, 5, 10, 50):
        measure = METRICS["nearest_demonstration"](known, TIME, count).measure
        # Of ten neighbours half are of each concept, which is not most of them.
        expected = [count < 10] * 2 + [False] * 2
        assert measure("go right", plans, None).tolist() == expected
        assert measure("go up", plans, None).tolist() == expected[::-1]
    for name in ("nearest_demonstration", "nearest_shape"):
        with pytest.raises(UserError, match=rf"data\.metrics\.{name}: expected 1 or more neighbours, found 0"):
            METRICS[name](known, TIME, 0)


def test_a_known_concept_by_another_name_is_not_judged() -> None:
    known = examples(go_right=walks("go right", 40), go_right_2=walks("go right", 6, 1), go_up=walks("go up", 6, 2))
    plans = torch.from_numpy(walks("go right", 3, 7)).float()
    for name in ("nearest_demonstration", "nearest_shape"):
        metric = METRICS[name](known, TIME, 1)
        assert metric.calibration is not None
        assert metric.measure("go right 2", plans, None).isnan().all()
        assert "of 'go right 2' are like those of other concepts" in metric.calibration("go right 2")
        assert metric.measure("go up", plans, None).dtype == torch.bool
        assert not metric.calibration("go up")


def test_a_shape_is_known_wherever_it_is_and_whatever_its_size() -> None:
    time = np.linspace(0, 1, TIME)
    bow, line = np.stack((time, time * (1 - time)), axis=-1), np.stack((time, time), axis=-1)
    known = examples(bow=np.stack((bow, 2 * bow + 5)), line=np.stack((line, 3 * line - 1)))
    plans = torch.from_numpy(np.stack((0.1 * bow - 40, 7 * line + 9))).float()
    measure = METRICS["nearest_shape"](known, TIME, 1).measure
    assert measure("bow", plans, None).tolist() == [True, False]
    assert measure("line", plans, None).tolist() == [False, True]


def test_columns_are_scaled_alike_where_neighbours_are_looked_for() -> None:
    # The second column is what tells the concepts apart, and a thousandth as large as the noise in the first.
    draw = np.random.default_rng(0)
    wide = 1000 * draw.standard_normal((12, TIME, 1)) @ np.array([[1.0, 0.0]])
    step = np.array([0.0, 1.0])
    known = examples(low=wide[:5], high=wide[5:10] + step)
    plans = torch.from_numpy(np.stack((wide[10], wide[11] + step))).float()
    measure = METRICS["nearest_demonstration"](known, TIME, 3).measure
    assert measure("low", plans, None).tolist() == [True, False]
    high = np.zeros((2, TIME, 2)) + np.array([0.0, 1.0])
    constant = examples(low=np.zeros((2, TIME, 2)), high=high)  # the first column never varies
    measure = METRICS["nearest_demonstration"](constant, TIME, 1).measure
    assert measure("high", constant.states, None).tolist() == [False] * 2 + [True] * 2


def test_a_plan_is_right_near_the_end_of_a_demonstration_of_its_goal_or_as_far_from_all_of_it() -> None:
    known = examples(go_right=walks("go right", 3), go_up=walks("go up", 3, 1))
    end = known.states[0, -1]
    plans = torch.zeros(3, TIME, 2)
    plans[:, -1] = end + torch.tensor([[0.0, 0.0], [1.9, 0.0], [2.5, 0.0]])
    measure = METRICS["end_point_within"](known, TIME, 2.0).measure
    assert measure("go right", plans, None).tolist() == [True, True, False]
    assert not measure("go up", plans, None).any()
    # A shorter plan is compared with where demonstrations are by then, a shorter demonstration with its own end.
    short = METRICS["end_point_within"](known, 4, 0.5).measure
    assert short("go right", known.states[:3, :4], None).all()
    assert not short("go right", known.states[:3], None).any()
    plans = torch.stack((known.states[1], known.states[1] + torch.tensor([0.0, 0.5]), known.states[4]))
    number = METRICS["dtw_to_demonstrations"](known, TIME, 1)
    assert number.less_is_better
    assert number.identity == known.hash
    found = number.measure("go right", plans, None)
    assert found.shape == (3,)
    assert found[0] == pytest.approx(0, abs=1e-5)
    assert found[1] == pytest.approx(0.5, abs=0.1)
    assert found[2] > 2
    assert number.measure("go up", plans, None)[2] == pytest.approx(0, abs=1e-5)
    for radius, right in ((0.1, [True, False, False]), (1.0, [True, True, False])):
        within = METRICS["dtw_within"](known, TIME, radius)
        assert not within.less_is_better
        assert within.measure("go right", plans, None).tolist() == right


@pytest.mark.parametrize("name", METRICS)
def test_a_goal_that_was_never_shown_cannot_be_judged(name: str) -> None:
    known = examples(go_right=walks("go right", 2), go_up=walks("go up", 2, 1))
    with pytest.raises(UserError, match="goal: expected a concept with demonstrations to compare with, found 'go between'"):
        METRICS[name](known, TIME, 1).measure("go between", known.states, None)


def trainer(**options: object) -> Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(accelerator="cpu", default_root_dir="logs", **(quiet | options))  # type: ignore[arg-type]


JUDGED = {"nearest_demonstration": 1.0, "dtw_to_demonstrations": 1.0}


def fit(folder: Path, steps: int, size: int) -> Path:
    """Folder of a small model of a file, and beside it the file."""
    own = {"metrics": JUDGED, "validation_share": 0.34, "batch_size": 16, "steps_per_epoch": steps, "encoder": "hashing"}
    network = {"hidden_dim": size, "depth": 2, "condition_dim": size // 2}
    module = PretrainingModule(denoiser_args=network, diffusion_steps=20, learning_rate=2e-3, output=str(folder / "model"))
    judge = Evaluator(samples=4, sampler="ddim", steps=10, results=str(folder / "r.csv"))
    data = OwnData(write(folder / "walks.npz"), **own)  # type: ignore[arg-type]
    trainer(max_steps=steps, callbacks=[judge]).fit(module, datamodule=data)
    return folder / "model"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that has learned next to nothing."""
    return fit(tmp_path_factory.mktemp("own"), steps=5, size=16)


def test_a_model_of_ones_own_data_keeps_what_it_is_judged_by(fitted: Path) -> None:
    model = load_model(fitted)
    assert isinstance(model, GenerativeModel)
    assert model.config.domain == "own"
    assert model.config.training_concepts == ("go right", "go up")
    assert model.config.encoder == HashingEncoder().identity
    assert model.config.metrics == JUDGED
    held_out = domain_from_file(str(fitted.parent / "walks.npz"), None, {}, 0.34).source(None).split("validation", 0, 0)
    assert model.examples is not None
    assert model.examples.hash == held_out.hash
    assert model.domain.plans.horizon == TIME
    assert list(model.domain.metrics) == list(JUDGED)
    save_model(model, "copy")
    again = load_model("copy")
    assert again.hash == model.hash
    assert again.examples is not None
    assert again.examples.hash == held_out.hash
    assert {path.name for path in Path("copy").iterdir()} == {"config.json", "demonstrations.safetensors", "model.safetensors"}


def invert(pretrained: Path, steps: int, form: str) -> tuple[TaskResult, Any]:
    """What is generated of a new concept that was learned, and its rows."""
    np.savez("between.npz", states=walks("go between", 4, 5), concepts="go between")
    data = InversionData("own", demonstrations="between.npz", steps=steps)
    module = InversionModule(str(pretrained), budget=BudgetOptions(samples=16), components=1, output="concepts", form=form)
    judge = Evaluator(samples=8, sampler="ddim", steps=10, temperature=0.1, results="r.csv")
    trainer(max_epochs=1, callbacks=[judge]).invert(module, data)
    assert [path.name for path in Path("concepts").iterdir()] == ["go_between.safetensors"]
    (one,) = judge.judged
    return one, read_rows("r.csv")


def test_a_new_concept_is_generated_and_judged_beside_the_known_ones(fitted: Path) -> None:
    one, rows = invert(fitted, 2, "paper")
    assert one.task.goal == "go between"
    assert one.measured["dtw_to_demonstrations"].shape == (8,)
    assert set(rows["metric"]) == {*JUDGED, "novelty"}
    assert set(rows["task"]) == {"go between"}
    assert set(rows["demonstrations"]) == {4}
    with pytest.raises(UserError, match=r"data\.demonstrations: expected a file of the new concepts' demonstrations, found none"):
        InversionData("own")


@pytest.mark.slow
def test_a_new_concept_and_the_training_concepts_are_learned(tmp_path_factory: pytest.TempPathFactory) -> None:
    learned = fit(tmp_path_factory.mktemp("learned"), steps=500, size=64)
    one, _ = invert(learned, 100, "auto")
    # The walks it was shown lead along the diagonal; what the model knows leads right and up.
    x, y = one.states[:, -1].mean(dim=0).tolist()
    assert 3 < x < 8
    assert 2 < y < 6.5
    assert one.values["nearest_demonstration"] > 0.5
    model = FewShot.from_pretrained(learned)
    for concept in ("go right", "go up"):
        plans = model.sample(model[concept], 8, steps=10, sampler="ddim")
        assert model.evaluate(plans, concept)["nearest_demonstration"] > 0.8


def test_new_demonstrations_that_do_not_fit_are_refused(fitted: Path, tmp_path: Path) -> None:
    np.savez("wide.npz", states=np.zeros((2, 5, 3)), concepts="wide")
    file = write(tmp_path / "windy.npz", **{"observed/wind": np.zeros((12, 2))})
    module = PretrainingModule(denoiser_args={"hidden_dim": 16, "depth": 2, "condition_dim": 8}, output="model")
    trainer(max_steps=1).fit(module, datamodule=OwnData(file, batch_size=4, steps_per_epoch=1, encoder="hashing"))
    np.savez("calm.npz", states=walks("go between", 2), concepts="calm")
    wind = r"data.demonstrations: key 'observed/wind': expected float32 of shape \(2,\) each, found none"
    for pretrained, name, expected in (
        (str(fitted), "wide.npz", r"expected states of 2 columns \(own\), found 3"),
        ("model", "calm.npz", wind),
    ):
        with pytest.raises(UserError, match=expected):
            trainer(max_epochs=1).invert(
                InversionModule(pretrained, output="concepts"), InversionData("own", demonstrations=name, steps=2)
            )
