"""Older configuration files and options mean what they meant, and are told in one line."""

import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning import regrouped
from ftl_lightning.configuration import load
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.rows import config_hash, configuration
from ftl_lightning.lightning_cli import build, parse
from ftl_lightning.regrouped import CLASSES, INVERSION, class_of, regrouped_arguments
from ftl_lightning.tuned import Tuned
from tests.conftest import CONF, refused

Told = pytest.CaptureFixture[str]
INVERSION_CLASS = "ftl_lightning.learning.InversionModule"
FIT = CONF / "object_rearrangement.yaml"
BASE = """
data:
  class_path: ftl_lightning.domains.data.InversionData
  init_args: {domain: object_rearrangement, suite: validation, steps: 5}
trainer: {max_epochs: 1, logger: false, enable_checkpointing: false, enable_progress_bar: false, accelerator: cpu}
"""
OLD = f"""
model:
  class_path: ftl_lightning.learning.inversion_module.InversionModule
  init_args: {{pretrained: object_rearrangement, components: 3, omega: learned, initial_omega: 0.7, off_span: 0.5,
    initial_spread: 0.2, start: concepts, restarts: 2, screening: 3, learning_rate: 0.02, weight_learning_rate: 0.004, samples: 5,
    mode_samples: 6, modes: each, tolerance: null, precision: 32-true, knots: 1, guidance_scale: 1.5, adapter: 0,
    adapter_learning_rate: 0.01, adapter_scope: all, loss: v, timestep_power: 2.0, training_omega: 0.9}}
{BASE}"""
NEW = f"""
model:
  class_path: ftl_lightning.learning.inversion_module.InversionModule
  init_args:
    pretrained: object_rearrangement
    components: 3
    omega: learned
    embeddings: {{knots: 1, off_span: 0.5, initial_spread: 0.2, start: concepts}}
    weights: {{initial: 0.7, learning_rate: 0.004, scale: 1.5, training: 0.9}}
    modes: {{sets: each, samples: 6}}
    adapter: {{rank: 0, learning_rate: 0.01, scope: all}}
    budget: {{samples: 5, restarts: 2, screening: 3, learning_rate: 0.02, tolerance: null, precision: 32-true}}
    loss: {{kind: v, timestep_power: 2.0}}
{BASE}"""
BUDGET = {"samples": 5, "restarts": 2, "screening": 3, "learning_rate": 0.02, "tolerance": None, "precision": "32-true"}
"""That of both files."""


@pytest.fixture(autouse=True)
def _not_told_yet() -> Iterator[None]:
    regrouped._tell.cache_clear()
    yield
    regrouped._tell.cache_clear()


def write(name: str, text: str) -> str:
    Path(name).write_text(text)
    return name


def notes(capsys: Told) -> list[str]:
    """What went to standard error since it was last asked, which is nothing but notes."""
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("note: ") for line in lines)
    return lines


def model(verb: str, *options: str) -> dict[str, Any]:
    found: dict[str, Any] = parse(verb, list(options))["model"]
    return found


def identity(*options: str) -> str:
    line = build("invert", list(options))
    return config_hash(configuration(line.model, line.datamodule, {}, line.trainer))


@pytest.mark.slow
def test_an_older_file_means_the_same_as_a_new_one_and_is_told_in_one_line(capsys: Told) -> None:
    old, new = write("old.yaml", OLD), write("new.yaml", NEW)
    expected = model("invert", f"--config={new}")
    assert notes(capsys) == []
    assert model("invert", f"--config={old}") == expected
    (told,) = notes(capsys)
    assert told.startswith("note: old.yaml: model.initial_omega is now model.weights.initial, ")
    assert all(f"model.{name} is now model.{place}" in told for name, place in INVERSION.items())
    assert identity("--config", old) == identity("--config", new)
    assert load(old, "invert") == load(new, "invert")
    assert notes(capsys) == []  # once in a process


def test_an_older_file_in_another_folder_is_told_too(capsys: Told) -> None:
    Path("deep").mkdir()
    write("deep/one.yaml", OLD)
    write("deep/two.yaml", OLD)
    load("deep/one.yaml")
    load("deep/two.yaml")
    assert [line.split(": ")[1] for line in notes(capsys)] == ["deep/one.yaml", "deep/two.yaml"]


@pytest.mark.parametrize(("old", "new"), CLASSES.items(), ids=lambda path: str(path).rpartition(".")[2])
def test_each_older_class_path_leads_to_the_class_of_today(old: str, new: str, capsys: Told) -> None:
    write("own.yaml", f"model: {{class_path: {old}}}\n")
    assert load("own.yaml") == {"model": {"class_path": new}}
    assert notes(capsys) == [f"note: own.yaml: {old} is now {new}"]
    module, _, name = new.rpartition(".")
    assert inspect.isclass(getattr(__import__(module, fromlist=[name]), name))
    for given in ([f"--model={old}"], ["--model", old], [f"--model.class_path={old}"]):
        assert regrouped_arguments(given, "fit")[0].endswith(f"={new}")


def test_an_own_file_beside_the_class_path_of_another_says_only_what_differs(capsys: Told) -> None:
    write("base.yaml", NEW)
    own = write("own.yaml", "defaults: [base.yaml]\nmodel: {init_args: {samples: 4, learning_rate: 0.5}}\n")
    found = model("invert", f"--config={own}")["init_args"]
    assert found["budget"] == BUDGET | {"samples": 4, "learning_rate": 0.5}
    assert found["weights"]["learning_rate"] == 0.004
    assert notes(capsys) == [
        "note: own.yaml: model.samples is now model.budget.samples, model.learning_rate is now model.budget.learning_rate"
    ]


def test_a_new_file_wins_over_an_older_one_that_it_builds_on(capsys: Told) -> None:
    write("base.yaml", "model: {init_args: {samples: 4, learning_rate: 0.5, loss: v}}\n")
    text = "model: {class_path: %s, init_args: {budget: {learning_rate: 0.25}, loss: {timestep_power: 3.0}}}"
    write("own.yaml", f"defaults: [base.yaml]\n{text % INVERSION_CLASS}\n")
    found = load("own.yaml")["model"]["init_args"]
    assert found == {"budget": {"samples": 4, "learning_rate": 0.25}, "loss": {"kind": "v", "timestep_power": 3.0}}
    assert len(notes(capsys)) == 1


def test_a_second_file_without_a_class_is_read_as_the_verb_says(capsys: Told) -> None:
    base, own = write("base.yaml", NEW), write("own.yaml", "model: {init_args: {samples: 4, learning_rate: 0.5}}\n")
    found = model("invert", f"--config={base}", f"--config={own}")["init_args"]["budget"]
    assert (found["samples"], found["learning_rate"], found["restarts"]) == (4, 0.5, 2)
    assert len(notes(capsys)) == 1
    own = write("rate.yaml", "model: {init_args: {learning_rate: 0.5, loss: v}}\n")
    fitted = model("fit", f"--config={FIT}", f"--config={own}")["init_args"]
    assert (fitted["learning_rate"], fitted["loss"]["kind"]) == (0.5, "v")


def test_the_settings_of_a_learner_can_be_in_an_older_file(capsys: Told) -> None:
    write("own.yaml", "model: {init_args: {samples: 4, learning_rate: 0.5, modes: auto}}\nevaluation: {steps: 7}\n")
    found = Tuned.read("own.yaml").inversion
    assert (found.budget.samples, found.budget.learning_rate, found.modes.sets) == (4, 0.5, "auto")
    Tuned.read("own.yaml")
    Tuned.domains("own.yaml")
    assert len(notes(capsys)) == 1
    write("wrong.yaml", "model: {init_args: {samples: 0}}\n")
    with pytest.raises(UserError, match=r"model\.budget\.samples: expected 1 or more, found 0"):
        Tuned.read("wrong.yaml")


SPELLINGS = [
    ["--model.samples", "4", "--model.learning_rate", "0.5"],
    ["--model.samples=4", "--model.learning_rate=0.5"],
    ["--model.init_args.samples=4", "--model.init_args.learning_rate=0.5"],
    ["--model.init_args.samples", "4", "--model.init_args.learning_rate", "0.5"],
    ["--model.init_args={samples: 4, learning_rate: 0.5}"],
    ["--config={model: {init_args: {samples: 4, learning_rate: 0.5}}}"],
    ["--config", "{model: {init_args: {samples: 4, learning_rate: 0.5}}}"],
]
TODAY = ["--config=new.yaml", "--model.budget.samples=4", "--model.budget.learning_rate=0.5"]


@pytest.fixture(scope="module")
def of_today(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the spelling of today comes to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("today"))
        write("new.yaml", NEW)
        return model("invert", *TODAY)


@pytest.mark.parametrize("given", SPELLINGS, ids=str)
def test_older_options_of_an_inversion_mean_the_same_as_new_ones_in_every_spelling(
    given: Sequence[str], of_today: dict[str, Any], capsys: Told
) -> None:
    write("new.yaml", NEW)
    assert model("invert", "--config=new.yaml", *given) == of_today
    (told,) = notes(capsys)
    for name in ("samples", "learning_rate"):
        assert f"{name} is now " in told
        assert f"model.budget.{name}" in told


@pytest.mark.slow
def test_rows_of_older_options_are_known_as_those_of_new_ones(capsys: Told) -> None:
    write("new.yaml", NEW)
    expected = identity(*TODAY)
    assert notes(capsys) == []
    assert identity("--config=new.yaml", *SPELLINGS[0]) == expected


def test_the_learning_rate_of_a_pretraining_stays_where_it_is(capsys: Told) -> None:
    found = model("fit", f"--config={FIT}", "--model.learning_rate", "0.5", "--model.condition_dropout=0.25")["init_args"]
    assert found["learning_rate"] == 0.5
    assert found["loss"]["condition_dropout"] == 0.25
    assert [line for line in notes(capsys) if "--model" in line] == [
        "note: --model.condition_dropout is now --model.loss.condition_dropout"
    ]
    write("own.yaml", "model: {class_path: ftl_lightning.learning.PretrainingModule, init_args: {learning_rate: 0.5}}\n")
    assert load("own.yaml", "fit")["model"]["init_args"] == {"learning_rate": 0.5}
    assert notes(capsys) == []


@pytest.mark.parametrize(
    "given",
    [
        ["--model.tolerance=null", "--model.training_omega", "null"],
        ["--model.budget.tolerance", "null", "--model.weights.training=null"],
        ["--model.init_args.budget.tolerance=null", "--model.init_args.training_omega=null"],
    ],
    ids=str,
)
def test_null_in_a_group_is_null_and_the_rest_of_the_group_stays(given: Sequence[str]) -> None:
    config = write("own.yaml", NEW.replace("tolerance: null", "tolerance: 0.1"))
    found = model("invert", "--config", config, "--model.budget.samples=7", *given)["init_args"]
    assert found["budget"] == BUDGET | {"samples": 7}
    assert found["weights"] == {"initial": 0.7, "learning_rate": 0.004, "scale": 1.5, "training": None}


def test_null_of_an_option_that_is_in_no_group_leaves_the_others_beside_it() -> None:
    found = model("fit", f"--config={FIT}", "--model.denoiser_args.dropout=null")["init_args"]["denoiser_args"]
    assert "hidden_dim" in found


def test_a_mistaken_value_under_an_older_name_is_one_line(capsys: Told) -> None:
    invert = ["invert", "--config", write("new.yaml", NEW)]
    refused(capsys, [*invert, "--model.samples=0"], "model.budget.samples: expected 1 or more, found 0")
    refused(capsys, [*invert, "--model.modes=some"], "modes")
    refused(capsys, [*invert, "--model.sample=3"], "sample")
    write("old.yaml", OLD.replace("samples: 5", "samples: many"))
    refused(capsys, ["invert", "--config=old.yaml"], "samples")
    write("old.yaml", OLD.replace("InversionModule", "Inversions"))
    refused(capsys, ["invert", "--config=old.yaml"], "Inversions")


def test_options_of_a_plug_in_s_classes_are_its_own() -> None:
    keys = {"model": {"class_path": "my_method.Pretraining", "init_args": {"samples": 3, "knots": 2, "loss": "huber"}}}
    assert regrouped.regrouped(keys, "mine.yaml", class_of([keys], "fit")) == keys
    options = ["--model.samples=3", "--model.loss", "huber"]
    same = ["--model.samples=3", "--model.loss=huber"]
    assert regrouped_arguments(["--model=my_method.Pretraining", *options], "fit")[1:] == same
    assert regrouped_arguments(options, "invert", [keys]) == same
    assert regrouped_arguments(options, "invert") == ["--model.budget.samples=3", "--model.loss.kind=huber"]
