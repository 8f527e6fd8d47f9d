import itertools
import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from lightning.pytorch import LightningDataModule
from matplotlib.figure import Figure
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.metadata import parse_session_start_info_plugin_data

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import Domain, Metric
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.evaluation.generation import (
    Generation,
    TaskResult,
    demonstrations_of,
    execute,
    generate,
    share,
    standard_error,
    tasks_of,
)
from ftl_lightning.evaluation.results import Row, append_rows, config_hash, configuration, read_rows, reference_hash
from ftl_lightning.evaluation.tensorboard import picture
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Point
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.model_folder import read_model
from tests.evaluation.rows import row as usual_row


class Trained:
    """The least that an evaluated module offers: a model and its training concepts."""

    method = "trained"
    form = ""
    variant = ""
    concepts: tuple[str, ...] = ()

    def __init__(self, model: GenerativeModel, seed: int = 0) -> None:
        self.model, self.hparams = model, {"seed": seed}

    @property
    def domain(self) -> Domain:
        return self.model.domain

    def demonstrated(self, concept: str) -> Demonstrations | None:
        return None

    def composition(self, task: EvaluationTask) -> Composition | None:
        if task.learned:
            return None
        return Composition(torch.stack([self.model.concept(text)[None] for text in task.texts]), torch.ones(len(task.texts)))

    def concept_points(self) -> list[Point]:
        return self.model.points()


def test_accuracy_is_the_share_of_right_samples_and_its_error_is_over_tasks() -> None:
    domain = load_domain("object_rearrangement")
    task = domain.concepts.suites["training"].tasks[0]
    source = domain.source(None)
    good = source.draw(task.goal, 3, 0).states
    bad = source.draw("square right of circle", 1, 0).states
    assert TaskResult.of(task, torch.cat((good, bad)), None, domain).values == {"accuracy": pytest.approx(0.75)}
    assert standard_error([0.1, 0.5, 0.6, 1.0]) == pytest.approx(float(np.std([0.1, 0.5, 0.6, 1.0], ddof=1)) / 2)
    assert standard_error([0.3]) == 0


def test_a_metric_may_be_a_number_of_each_sample_or_of_the_whole_set_and_less_may_be_better() -> None:
    base = load_domain("object_rearrangement")
    goals: list[str] = []

    def distance(goal: str, states: torch.Tensor, starts: object) -> torch.Tensor:
        goals.append(goal)
        return states[:, 0, 0]

    spread = Metric(lambda goal, states, starts: states.std(dim=0).mean(), identity="judge 1")
    metrics = {"spread": spread, "distance": Metric(distance, less_is_better=True), "accuracy": base.metrics["accuracy"]}
    domain = replace(base, metrics=metrics, comparison=Comparison(headline="distance"))
    task = base.concepts.suites["training"].tasks[0]
    states = base.source(None).draw(task.goal, 4, 0).states
    one = TaskResult.of(task, states, None, domain)
    assert one.measured["spread"].shape == ()
    assert one.measured["distance"].shape == (4,)
    assert list(one.values) == ["spread", "distance", "accuracy"]
    assert one.values["spread"] == pytest.approx(states.std(dim=0).mean().item())
    assert one.values["distance"] == pytest.approx(states[:, 0, 0].mean().item())
    assert one.values["accuracy"] == 1
    assert goals == [task.goal]
    assert one.right.tolist() == [True] * 4  # a number of the whole set, or of a sample, does not say what is right
    assert domain.main_metric == "spread"
    assert [domain.less_is_better(name) for name in domain.metrics] == [False, True, False]
    assert not domain.less_is_better("closed loop distance")  # there is no closed loop
    assert TaskResult.of(task, states, None, replace(domain, metrics={"distance": Metric(distance, True)})).right is None
    driving = load_domain("driving")
    assert driving.less_is_better("closed loop crash")
    assert driving.less_is_better("closed loop crash (step veto)")
    assert not driving.less_is_better("closed loop success (step veto)")
    assert not driving.less_is_better("closed loop success")
    assert driving.main_metric == "closed loop success"


def test_plans_of_which_a_metric_says_nothing_do_not_count_and_without_any_it_is_not_reported() -> None:
    assert share(torch.tensor([1.0, torch.nan, 0.0, torch.nan])) == pytest.approx(0.5)
    assert share(torch.tensor([True, True, False, False])) == pytest.approx(0.5)
    measured = {
        "right": torch.tensor([True, False]),
        "level": torch.tensor([math.nan, 1.0]),
        "turned": torch.tensor([math.nan] * 2),
    }
    judged = TaskResult(EvaluationTask("s", "walk"), torch.zeros(2, 3, 1), measured)
    assert judged.values == {"right": 0.5, "level": 1.0}


def test_tasks_without_a_learned_concept_are_left_out_and_a_seed_repeats(tiny: Path) -> None:
    module = Trained(read_model(GenerativeModel, tiny))
    tasks = tasks_of(module.domain, ["training", "paper"], ())
    assert {task.learned for task in tasks} > {()}
    first, again = (generate(module, tasks, Generation(3, "ddim", 4)) for _ in range(2))
    assert len(first) == 12
    assert all(torch.equal(one.states, other.states) for one, other in zip(first, again, strict=True))
    with pytest.raises(UserError, match="suites: expected some of training, paper"):
        tasks_of(module.domain, ["exam"], ())


def test_what_cannot_be_generated_or_executed_is_told(tiny: Path) -> None:
    module = Trained(read_model(GenerativeModel, tiny))
    (judged,) = generate(module, tasks_of(module.domain, ["training"], ())[:1], Generation(2, "ddim", 2))
    with pytest.raises(UserError, match="expected a domain with an environment, found object_rearrangement, which has none"):
        execute(module, [judged], Generation())
    for key in ("samples", "replan"):
        with pytest.raises(UserError, match=f"^evaluation.{key}: expected 1 or more, found 0"):
            Generation(**{key: 0})
    with pytest.raises(UserError, match=r"^evaluation\.sampler: expected"):
        Generation(sampler="euler")


def test_a_task_that_starts_in_demonstrations_needs_some(tiny: Path) -> None:
    class Driver(Trained):
        domain = load_domain("driving")

        def composition(self, task: EvaluationTask) -> Composition | None:
            return Composition(torch.zeros(1, 1, 384), torch.ones(1))

    task = EvaluationTask("s", "merge", learned=("merge",), initial="demonstrated")
    with pytest.raises(UserError, match="evaluation task 'merge': initial: expected demonstrations of 'merge', found none"):
        generate(Driver(read_model(GenerativeModel, tiny)), [task], Generation(1))


def test_the_keys_of_generation_stand_beside_those_of_the_callback() -> None:
    evaluator = Evaluator(suites=["paper"], figures=0, samples=3, sampler="ddim", steps=4, environments=["step veto"], seed=7)
    assert evaluator.generation == Generation(3, "ddim", 4, environments=["step veto"], seed=7)
    expected = {"suites": "paper", "samples": 3, "sampler": "ddim", "steps": 4, "environments": ["step veto"]}
    assert evaluator.settings(LightningDataModule()) == expected | {"temperature": 0.1, "sample_seed": 7, "replan": None}
    with pytest.raises(TypeError, match="sample"):
        Evaluator(sample=3)


def test_what_a_task_is_learned_from_is_that_of_all_its_concepts() -> None:
    source = load_domain("object_rearrangement").source(None)
    shown = {text: source.draw(text, count, 0) for text, count in (("circle above square", 3), ("square above circle", 4))}
    one, other = shown
    assert demonstrations_of(EvaluationTask("s", one, learned=(one,)), shown.get) is shown[one]
    both = demonstrations_of(EvaluationTask("s", "g", learned=(one, other)), shown.get)
    assert both.concepts == (one,) * 3 + (other,) * 4
    assert demonstrations_of(EvaluationTask("s", one, texts=(one,)), shown.get) is None
    assert demonstrations_of(EvaluationTask("s", "g", learned=("unknown",)), shown.get) is None


def row(**changes: Any) -> Row:
    usual = {"domain": "d", "setting": "s", "method": "m", "variant": "", "model_hash": "00e1"}
    return usual_row(**(usual | changes))


def test_rows_are_added_replaced_and_keep_their_types_and_a_foreign_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    append_rows(path, [row(), row(task="u")])
    append_rows(path, [row(value=0.75), row(omega="learned")])
    table = read_rows(tmp_path)
    assert len(table) == 3
    assert table.loc[(table["task"] == "t") & (table["omega"] == "1.2"), "value"].tolist() == [0.75]
    assert set(table["omega"]) == {"1.2", "learned"}
    assert set(table["model_hash"]) == {"00e1"}  # not read as a number
    pd.DataFrame({"a": [1]}).to_csv(path, index=False)
    with pytest.raises(UserError, match=r"r\.csv: expected the columns domain, setting"):
        read_rows(tmp_path)


def test_a_configuration_knows_demonstrations_by_their_content_or_as_a_data_set_by_name_and_version(tiny: Path) -> None:
    module, data = Trained(read_model(GenerativeModel, tiny)), LightningDataModule()
    found = []
    for content, name in ((b"one", "a.npz"), (b"one", "b.npz"), (b"two", "a.npz")):
        Path(name).write_bytes(content)
        data.hparams["demonstrations"] = name
        found.append(configuration(module, data, {})["data/demonstrations"])
    assert found[0] == found[1] != found[2]
    data.hparams["demonstrations"] = "strokes/test-v0"
    assert configuration(module, data, {})["data/demonstrations"] == "strokes/test-v0"
    data.hparams.update({"demonstrations": None, "root": "/somewhere"})
    described = configuration(module, data, {})
    assert {key: value for key, value in described.items() if key.startswith("data/")} == {"data/demonstrations": None}


def test_a_hash_has_a_version_and_changes_with_every_option_but_not_with_folders(tiny: Path) -> None:
    module, data = Trained(read_model(GenerativeModel, tiny)), LightningDataModule()
    module.hparams |= {"pretrained": "here", "output": "there", "knots": 1}
    settings = {"samples": 3, "sample_seed": 0, "replan": None}
    first = configuration(module, data, settings)
    assert re.fullmatch("2:[0-9a-f]{16}", config_hash(first))
    assert {first[key] for key in ("domain", "method", "model/knots")} == {"object_rearrangement", "trained", 1}
    module.hparams |= {"pretrained": "elsewhere", "output": None, "_class_path": "package.Module"}
    assert configuration(module, data, settings) == first
    other = configuration(module, data, settings | {"temperature": 0.5})
    assert config_hash(other) != config_hash(first)
    assert reference_hash(other) == reference_hash(first)
    assert reference_hash(configuration(module, data, settings | {"samples": 4})) != reference_hash(first)


def test_tensorboard_gets_scalars_figures_hparams_and_projector(log: Path, tiny: Path) -> None:
    assert {path.parent for path in log.rglob("events.out.tfevents.*")} == {log}  # one run
    events = EventAccumulator(str(log), size_guidance={"images": 0, "scalars": 0}).Reload()
    fitted = EventAccumulator(str(tiny.parent), size_guidance={"images": 0, "scalars": 0}).Reload()
    # In TensorBoard's order pictures come first, then curves, accuracy and loss before the others, then numbers of one point.
    tags = {tag: "curve" for run in (events, fitted) for tag in run.Tags()["scalars"] if len(run.Scalars(tag)) > 1}
    tags |= {tag: "picture" for run in (events, fitted) for tag in run.Tags()["images"]}
    tags |= {tag: "point" for run in (events, fitted) for tag in run.Tags()["scalars"] if tag not in tags}
    order = sorted(tags)
    curves = [tag for tag in order if tags[tag] == "curve"]
    assert curves[:4] == ["accuracy/training concept", "loss/train", "loss/val", "optimizer/learning rate"]
    assert [kind for kind, _ in itertools.groupby(tags[tag] for tag in order)] == ["picture", "curve", "point"]
    assert len(events.Scalars("loss/train")) == 5
    for setting in ("training concept", "training composition", "new concept", "new + training"):
        assert 0 <= events.Scalars(f"test results/accuracy/{setting}")[0].value <= 1
    image = events.Images("1 pictures/new concept/square diagonal to triangle")[0]
    assert image.encoded_image_string.startswith(b"\x89PNG")
    labels = [row.split("\t") for row in next(log.rglob("metadata.tsv")).read_text().splitlines()]
    assert labels[0] == ["text", "set", "component", "part"]
    assert Counter(row[1] for row in labels[1:]) == {"empty concept": 1, "training concept": 12, "new component": 10 * 2}
    assert ["square diagonal to triangle", "new component", "2", "component 2"] in labels


def test_hparams_and_words_in_tables_are_what_a_person_chose_and_stand_with_the_curves(log: Path, tiny: Path) -> None:
    events = EventAccumulator(str(log)).Reload()
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    values = parse_session_start_info_plugin_data(content).hparams
    # TensorBoard shows the first five by name.
    assert sorted(values)[:9] == ["K", "domain", "form", "method", "omega", "seed", "steps", "tasks", "variant"]
    assert (values["K"].number_value, values["omega"].number_value, values["seed"].number_value) == (2, 1.5, 3)
    assert values["steps"].number_value == 5
    words = [values[name].string_value for name in ("domain", "method", "form")]
    assert words == ["object_rearrangement", "FTL-IGM", "usual"]
    assert values["with model/pretrained"].string_value == str(tiny)
    assert "loss/train" in events.Tags()["scalars"]
    known = read_rows(log / "results.csv")
    assert set(known.loc[known["role"] == "method", "variant"]) == {"without a hat"} == {values["variant"].string_value}
    hashes = {*known["config_hash"], *known["model_hash"]}
    assert not (hashes - {""}) & {value.string_value for value in values.values()}


@pytest.mark.slow
def test_the_rate_of_each_step_is_a_curve_and_so_is_the_loss_of_an_inversion(tiny: Path, invert: Callable[..., Path]) -> None:
    fitted = EventAccumulator(str(tiny.parent)).Reload()
    rates = [event.value for event in fitted.Scalars("optimizer/learning rate")]
    assert max(rates) > rates[-1] > 0  # cosine decay
    events = EventAccumulator(str(invert("--trainer.log_every_n_steps=1", "--evaluation.suites=[]"))).Reload()
    assert [event.step for event in events.Scalars("loss/train")] == [1, 2, 3, 4, 5]


def test_without_suites_no_episode_is_executed() -> None:
    module = SimpleNamespace(domain=load_domain("driving"))
    assert Evaluator(suites=[], closed_loop=True)._acted(module, [], 1) == []  # type: ignore[arg-type]


def test_demonstrations_are_drawn_above_the_samples_that_are_framed_by_outcome(tiny: Path) -> None:
    domain = load_domain("object_rearrangement")
    source, (task, other) = domain.source(None), ("square diagonal to triangle", "circle right of square")
    states = torch.cat((source.draw(task, 3, 0).states, source.draw(other, 1, 0).states))
    seen: list[tuple[int, list[bool] | None]] = []

    def drawn(states: torch.Tensor, right: list[bool] | None, title: str, starts: object) -> Figure:
        seen.append((len(states), right))
        return domain.show.picture(states, right, title, None)

    watched = replace(domain, show=replace(domain.show, picture=drawn))
    behaviour = TaskResult.of(EvaluationTask("new concept", task, (task,)), states, None, domain, source.draw(task, 5, 1))
    figure = picture(behaviour, watched, 16)
    assert seen == [(5, None), (4, [True, True, True, False])]
    assert [text.get_text() for text in figure.texts] == [
        f"{task}: 0.75 right",
        f"demonstrations: {task}",
        "samples: 3 right (green), 1 wrong (red)",
    ]
    assert figure.axes[0].get_position().y0 > figure.axes[1].get_position().y1
    seen.clear()
    picture(replace(behaviour, demonstrations=None), watched, 2)
    assert seen == [(2, [True, True])]


def test_figures_frame_right_green_and_wrong_red(tmp_path: Path) -> None:
    domain = load_domain("object_rearrangement")
    states = domain.source(None).draw("circle right of square", 2, 0).states
    domain.show.picture(states, [True, False], "two scenes", None).savefig(tmp_path / "f.png", dpi=100)
    pixels = np.asarray(Image.open(tmp_path / "f.png").convert("RGB")).reshape(-1, 3).astype(int)
    for colour in ((46, 158, 70), (208, 58, 58)):
        assert (np.abs(pixels - colour).sum(axis=1) < 12).sum() > 200
