"""The command line: help, configuration files, and every mistake of a user's as one clear line with exit code 2."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from ftl_lightning.cli import COMMANDS, TRAINER_VERBS, main
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.configuration import load
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.trainer import Trainer
from tests.conftest import CONF, ROOT, TINY

OURS = ("agent", "driving", "mocap", "object_rearrangement", "own", "tabletop", "tabletop_wide")
BASELINES = ("bc", "cvae", "in_context")
FITS = [*OURS, *sorted(f"{method}/{path.stem}" for method in BASELINES for path in (CONF / method).glob("*.yaml"))]
INVERSIONS = [[name] for name in (*FITS, "mocap_adapter", "tabletop_adapter")] + [[name, "method/language"] for name in OURS]
CONFIGS = [
    *(("fit", [name]) for name in FITS),
    *(("fit", [name, "size/paper"]) for name in OURS),
    *(("invert", names) for names in INVERSIONS),
    *(("ablate", [f"ablation/{path.stem}"]) for path in sorted((CONF / "ablation").glob("*.yaml"))),
]
"""Verbs with the files that are added to one another for them."""
PRETRAINING = str(CONF / "object_rearrangement.yaml")
INVERSION = str(CONF / "object_rearrangement.yaml")


def error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run, expect exit code 2, and return what standard error says."""
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told
    return told


@pytest.mark.parametrize("verb", [*TRAINER_VERBS, *COMMANDS])
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    assert verb in capsys.readouterr().out


def test_the_overview_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in (*TRAINER_VERBS, *COMMANDS))


def test_verbs_without_a_trainer_start_at_once() -> None:
    code = (
        "import sys; from ftl_lightning.cli import COMMANDS, TRAINER_VERBS, main; main(['generate', '--help']);"
        "sys.exit(any(m in sys.modules for m in ('lightning', 'torch', 'transformers')))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize(("verb", "names"), CONFIGS, ids=str)
def test_every_configuration_file_parses(verb: str, names: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    files = [CONF / f"{name}.yaml" for name in names]
    assert main([verb, *(f"--config={path}" for path in files), "--print_config"]) == 0
    told = capsys.readouterr()
    printed = yaml.safe_load(told.out)
    for path in files:
        assert set(load(path, verb)) <= set(printed)
    assert told.err == ""


@pytest.mark.parametrize("name", [name for name, *more in INVERSIONS if not more])
def test_rows_of_the_configurations_that_ship_are_known_without_the_trainer(name: str) -> None:
    """So were they before its options counted."""
    trainer = load(CONF / f"{name}.yaml", "invert")["trainer"]
    options = {key: value for key, value in trainer.items() if key != "logger"}
    assert not Trainer(accelerator="cpu", logger=False, **options).unusual


def test_a_missing_input_file_is_told_before_anything_slow_is_imported() -> None:
    for arguments in (
        ["invert", "--config", "nothing.yaml"],
        ["invert", "--config", INVERSION, "--model.pretrained", "nowhere"],
        ["fit", "--config", PRETRAINING, "--ckpt_path=no.ckpt"],
        ["sample", "--pretrained", "nowhere"],
    ):
        code = (
            f"import sys; from ftl_lightning.cli import COMMANDS, TRAINER_VERBS, main; code = main({arguments!r});"
            "sys.exit(code if not {'lightning', 'torch', 'transformers', 'jsonargparse'} & sys.modules.keys() else 99)"
        )
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True, text=True)
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1


def test_configurations_are_found_in_a_folder_without_any(capsys: pytest.CaptureFixture[str]) -> None:
    assert not Path("conf").exists()
    assert main(["fit", "--config", "conf/bc/agent.yaml", "--print_config"]) == 0
    assert "CloningPretraining" in capsys.readouterr().out


def test_a_mistaken_key_in_a_part_is_told_with_the_part(capsys: pytest.CaptureFixture[str]) -> None:
    Path("part.yaml").write_text("model: {init_args: {depht: 3}}\n")
    Path("whole.yaml").write_text(f"defaults: ['{PRETRAINING}', part.yaml]\ntrainer: {{max_steps: 1}}\n")
    told = error(capsys, "fit", "--config", "whole.yaml")
    assert told.startswith("error: part.yaml: ")
    assert "'depht' is not accepted" in told


def test_configuration_keys_can_be_read_back(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--config", PRETRAINING, "--seed_everything=7", "--print_config"]) == 0
    config = yaml.safe_load(capsys.readouterr().out)
    # One seed decides all of them, wherever it is given.
    assert config["model"]["init_args"]["seed"] == config["data"]["init_args"]["seed"] == config["evaluation"]["seed"] == 7


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fly"], "verb: expected one of fit, invert"),
        (["fit", "--config", "nothing.yaml"], "nothing.yaml: expected a configuration file, found nothing"),
        (["fit", "--config", "conf/nothing.yaml"], "conf/nothing.yaml: expected a configuration file, found nothing; conf holds"),
        (["fit", f"--config={CONF}"], "conf: expected a configuration file, found a folder"),
        (["fit", "--config", PRETRAINING, "--model.depht=3"], "depht"),
        (["fit", "--config", PRETRAINING, "--trainer.max_steps=many"], "max_steps"),
        (["fit", "--config", PRETRAINING, "--ckpt_path=no.ckpt"], "ckpt_path: no.ckpt: expected a checkpoint file, found nothing"),
        (["fit", "--config", PRETRAINING, *TINY, "--model.denoiser=Transformer"], "denoiser: expected one of MLPDenoiser"),
        (
            ["fit", "--config", PRETRAINING, *TINY, "--model.denoiser_args={width: 3}"],
            "key 'denoiser_args.width': expected",
        ),
        (["fit", "--config", PRETRAINING, *TINY, "--evaluation.sampler=euler"], "evaluation.sampler: expected one of ddpm"),
        (["fit", "--config", PRETRAINING, *TINY, "--data.encoder=no/such/model"], "encoder: expected a folder"),
        (["invert", "--config", INVERSION, "--model.pretrained=nowhere"], "nowhere/config.json: expected a pretrained model"),
        (["sample", "--pretrained=nowhere"], "nowhere/config.json: expected a pretrained model"),
        (["sample", "--pretrained", "nowhere"], "nowhere/config.json: expected a pretrained model"),
        (["explain", "--concept", "no.safetensors"], "no.safetensors: expected a concept file, found nothing"),
        (
            ["invert", "--config", INVERSION, "--data.demonstrations", "no.npz"],
            "no.npz: expected a demonstrations file, found nothing",
        ),
        (["generate", "chess"], "domain: expected one of"),
        (["generate", "object_rearrangement", "--task=circle on square"], "expected 'A <relation> B'"),
        (["generate", "object_rearrangement", "--task=circle above squaretriangle above square"], "found 'triangle above square'"),
        (["generate", "object_rearrangement", "--seed=-1"], "0 or more"),
        (["generate", "object_rearrangement", "--count=0"], "count: expected 1 or more"),
        (["generate", "object_rearrangement", "--count=5", "--out=/proc/d.safetensors"], "cannot be written"),
        (["report", "--results=nothing"], "expected"),
        (["ablate", "--stages=[]"], "results"),
    ],
)
def test_mistakes_are_one_clear_line(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in error(capsys, *arguments)
    assert not list(Path().rglob("*.safetensors"))  # nothing half-written


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--compose=circle left of square:1"], "concept 'circle left of square': expected a training concept"),
        (["--compose=circle right of square:heavy"], "expected 'concept:weight"),
        ([], "expected a learned concept, training concepts or both"),
        (["--compose=circle right of square", "--steps=1000"], "steps: expected 1 to 100"),
        (["--compose=circle right of square", "--count=0"], "count: expected 1 or more"),
        (["--concept=no.safetensors"], "no.safetensors: expected a concept file, found nothing"),
        (["--compose=circle right of square + no.safetensors:1"], "no.safetensors: expected a concept file, found nothing"),
        (["--compose=circle right of square:"], "expected 'concept:weight"),
        (["--compose=circle right of square", "--temperature=-1"], "temperature: expected 0 or more"),
        (["--compose=circle right of square", "--goal=chaos"], "goal: expected a task"),
        (["--compose=circle right of square", "--figure=a.foo"], "figure: expected a name"),
    ],
)
def test_mistakes_in_sampling(tiny: Path, options: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in error(capsys, "sample", f"--pretrained={tiny}", *options)
    assert not list(Path().iterdir())  # nothing half-written


def test_a_concept_of_another_model_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str], invert: Callable[..., Path]) -> None:
    log = invert("--data.suite=validation", "--evaluation.suites=[training]")
    file = next((log / "concepts").iterdir())
    concept = Concept.load(file)
    for key in ("pretrained", "encoder", "domain"):
        origin = type(concept.origin)(**{**concept.origin.__dict__, key: "other"})
        Concept(concept.embeddings, concept.weights, origin).save("c.safetensors")
        told = error(capsys, "sample", f"--pretrained={tiny}", "--concept=c.safetensors")
        assert f"c.safetensors: key '{key}': expected" in told
        assert "found 'other'" in told
    told = error(capsys, "sample", f"--pretrained={tiny}", f"--concept={tiny / 'model.safetensors'}")
    assert "expected a concept file, found a generative model file" in told


def demonstrations(states: torch.Tensor, domain: str = "object_rearrangement") -> Demonstrations:
    count, time, columns = states.shape
    names = tuple(map(str, range(columns)))
    return Demonstrations(states, torch.full((count,), time), domain, names, names, ("task",) * count)


def test_demonstrations_that_do_not_fit(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demonstrations(torch.zeros(2, 1, 21), "driving").save("other.safetensors")
    demonstrations(torch.zeros(2, 1, 20)).save("size.safetensors")
    Path("cut.safetensors").write_bytes(Path("size.safetensors").read_bytes()[:100])
    np.savez("nan.npz", states=np.full((1, 1, 21), np.nan))
    np.savez("none.npz", states=np.zeros((0, 1, 21)))
    np.savez("keys.npz", state=np.zeros((1, 1, 21)))
    Path("empty.npz").touch()
    np.save("array.npy", np.zeros((1, 1, 21)))
    Path("array.npy").rename("array.npz")
    Path("empty.npz").touch()
    np.save("array.npy", np.zeros((1, 1, 21)))
    Path("array.npy").rename("array.npz")
    for file, expected in {
        "missing.safetensors": "found nothing",
        "other.safetensors": "key 'domain': expected 'object_rearrangement', found 'driving'",
        "size.safetensors": "key 'states': expected shape (demo, time, 21), found (2, 1, 20)",
        "cut.safetensors": "damaged or foreign",
        "nan.npz": "expected finite numbers, found nan",
        "none.npz": "expected at least one demonstration, found none",
        "keys.npz": "key 'states': expected (demo, time, state)",
        "empty.npz": "damaged",
        "array.npz": "damaged",
    }.items():
        told = error(capsys, "invert", "--config", INVERSION, f"--model.pretrained={tiny}", f"--data.demonstrations={file}")
        assert file in told
        assert expected in told
    assert not Path("logs/object_rearrangement/invert/concepts").exists()


def test_a_checkpoint_of_the_other_module_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = tiny.parent / "checkpoints" / "last.ckpt"
    options = [f"--model.pretrained={tiny}", f"--ckpt_path={checkpoint}", "--trainer.enable_progress_bar=false"]
    told = error(capsys, "invert", "--config", INVERSION, *options)
    assert "ckpt_path: key 'module_class': expected InversionModule, found PretrainingModule" in told
    Path("damaged.ckpt").write_bytes(checkpoint.read_bytes()[:1000])
    told = error(capsys, "test", "--config", PRETRAINING, "--ckpt_path=damaged.ckpt")
    assert "damaged.ckpt: expected a checkpoint, found a damaged or foreign file" in told


def test_fit_says_where_the_model_is_and_how_accurate(capsys: pytest.CaptureFixture[str]) -> None:
    options = [*TINY, "--trainer.max_steps=4", "--data.steps_per_epoch=2", "--evaluation.samples=2"]
    assert main(["fit", "--config", PRETRAINING, *options]) == 0
    assert "pretrained model: logs/object_rearrangement/fit/pretrained, accuracy 0." in capsys.readouterr().out
    assert Path("logs/object_rearrangement/fit/pretrained/config.json").is_file()


def test_progress_is_all_that_fit_and_invert_write_to_standard_error(
    invert: Callable[..., Path], capfd: pytest.CaptureFixture[str]
) -> None:
    options = [*TINY, "--trainer.max_steps=10", "--data.steps_per_epoch=5", "--evaluation.samples=2"]
    assert main(["fit", "--config", PRETRAINING, *options, "--trainer.enable_progress_bar=true"]) == 0
    told = capfd.readouterr()
    lines = told.err.splitlines()
    assert lines[0] == "fit: 0/10"
    assert [line.split(",")[0] for line in lines[1:-1]] == [f"fit: {step}/10" for step in range(1, 10)]
    assert lines[-1].startswith("fit: 10 steps, 0:")
    assert ", loss " in lines[-1]
    assert "accuracy" in lines[-1]
    assert told.out.count("\n") == 1  # the model's folder
    invert("--data.suite=validation", "--evaluation.suites=[validation]", "--trainer.enable_progress_bar=true")
    told = capfd.readouterr()
    assert [line.split(",")[0] for line in told.err.splitlines()[:-1]] == [
        *(f"invert: {step}/5" for step in range(5)),
        "invert: 5 steps",
        "evaluation",
    ]
    assert told.err.splitlines()[-1].startswith("evaluation: 0:")
    assert "\x1b" not in told.err + told.out
    assert "v_num" not in told.out


def test_an_inversion_overwrites_no_other(invert: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    short = [
        "--data.suite=validation",
        "--evaluation.suites=[validation]",
        "--evaluation.samples=1",
        "--evaluation.references=false",
    ]
    first = invert(*short)
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    assert capsys.readouterr().out.endswith("logged in logs/object_rearrangement/invert\n")
    invert(*short)
    assert capsys.readouterr().out.endswith("logged in logs/object_rearrangement/invert_1\n")
    assert before == {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    assert (first.parent / "invert_1" / "results.csv").is_file()


def test_fit_validate_and_test_of_a_checkpoint_agree(tiny: Path) -> None:
    checkpoint = f"--ckpt_path={tiny.parent / 'checkpoints' / 'last.ckpt'}"
    for verb in ("validate", "test"):
        assert main([verb, "--config", PRETRAINING, *TINY, checkpoint, "--evaluation.samples=4"]) == 0
    assert Path("logs/object_rearrangement/fit/results.csv").is_file()


def test_the_model_card_and_config_of_the_shipped_model(shipped: Path) -> None:
    config = json.loads((shipped / "config.json").read_text())
    assert config["domain"] == "object_rearrangement"
    assert (shipped / "model.safetensors").stat().st_size <= 8e6
    assert config["hash"] in (shipped / "README.md").read_text()
    assert main(["sample", f"--pretrained={shipped}", "--compose=circle right of square:1.2", "--count=5", "--steps=10"]) == 0


def test_a_mistaken_key_is_told_in_one_line_with_its_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.yaml").write_text("model: {init_args: {depht: 3}}\n")
    told = error(capsys, "fit", "--config", PRETRAINING, "--config", "bad.yaml")
    assert told.startswith("error: bad.yaml: ")
    assert "'depht' is not accepted" in told
    assert told.count("\n") == 1
    told = error(capsys, "fit", "--config", PRETRAINING, "--model.depht=3")
    assert "'depht' is not accepted" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize("verb", ["test", "validate"])
def test_evaluation_needs_a_checkpoint(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"ckpt_path: {verb} expected a checkpoint" in error(capsys, verb, "--config", PRETRAINING, *TINY)


def test_a_checkpoint_of_another_form_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = f"--ckpt_path={tiny.parent / 'checkpoints' / 'last.ckpt'}"
    wider = "--model.denoiser_args={hidden_dim: 96, depth: 2, condition_dim: 32}"
    told = error(capsys, "test", "--config", PRETRAINING, *TINY, wider, checkpoint)
    assert "key 'denoiser_args': expected {'hidden_dim': 96" in told


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--evaluation.suites=[trainig]"], "evaluation.suites: expected some of training"),
        (["--evaluation.steps=1000"], "evaluation.steps: expected 1 to 100"),
        (["--model.budget.restarts=0"], "model.budget.restarts: expected 1 or more"),
        (["--model.loss.timestep_power=0.5"], "model.loss.timestep_power: expected 1 or more"),
        (["--data.steps=0"], "data.steps, data.demonstrations_per_concept: expected 1 or more"),
        (["--trainer.logger.init_args.save_dir=/proc/logs"], "choose a writable place"),
    ],
)
def test_mistakes_are_told_before_anything_is_learned(
    tiny: Path, options: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    told = error(capsys, "invert", "--config", INVERSION, f"--model.pretrained={tiny}", *options)
    assert expected in told
    assert not list(Path().rglob("concepts"))


# Without options `play` opens the page of a model that ships, and serves it until it is told to end.
@pytest.mark.parametrize("verb", [verb for verb in (*TRAINER_VERBS, *COMMANDS) if verb != "play"])
def test_a_verb_without_options_says_what_it_needs(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb]) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("error: ")
    assert "expected" in told or "required" in told
    assert "\n" not in told


# Modes and the stopping rule


def one_concept(invert: Callable[..., Path], *options: str) -> Path:
    """The file of a new relation that is learned from five demonstrations."""
    task = "circle right of square and square above triangle"
    assert main(["generate", "object_rearrangement", f"--task={task}", "--count=5", "--out=five.safetensors"]) == 0
    log = invert("--data.demonstrations=five.safetensors", *options)
    (file,) = (log / "concepts").iterdir()
    return file


@pytest.mark.parametrize(("modes", "how"), [("each", "one of them"), ("auto", "")])
def test_modes_are_learned_explained_and_sampled_from(
    tiny: Path, invert: Callable[..., Path], capsys: pytest.CaptureFixture[str], modes: str, how: str
) -> None:
    file = one_concept(invert, f"--model.modes.sets={modes}")
    learned = Concept.load(file)
    assert learned.modes is not None
    assert len(learned.modes) == 5
    capsys.readouterr()
    assert main(["explain", f"--concept={file}", f"--pretrained={tiny}"]) == 0
    told = capsys.readouterr().out
    how = how or ("a random mixture of them" if learned.modes.mixed else "one of them")
    assert f"alone it generates from {how}: 5 modes; composed, from the components that have no mode\n" in told
    assert told.count("nearest: ") == 2 + 5 * 2 + 1  # the components, those of every mode, the weighted sum
    assert "\nmode 5, component 2, weight 1.20: nearest: " in told
    Concept(learned.embeddings, learned.weights, learned.origin).save("centre.safetensors")
    options = [f"--pretrained={tiny}", "--count=6", "--steps=3", "--out=states.safetensors"]
    states = []
    for more in ([], ["--compose=circle above square"]):
        for concept in (file, "centre.safetensors"):
            assert main(["sample", *options, f"--concept={concept}", *more]) == 0
            states.append(Demonstrations.load("states.safetensors").states)
    assert not torch.equal(states[0], states[1])
    assert torch.equal(states[2], states[3])


def test_a_run_that_stops_by_itself_says_after_how_many_steps(
    invert: Callable[..., Path], capfd: pytest.CaptureFixture[str]
) -> None:
    options = ["--data.steps=150", "--model.budget.tolerance=0.5", "--trainer.enable_progress_bar=true"]
    one_concept(invert, *options)
    told = capfd.readouterr().err
    (steps,) = [int(line.split()[1]) for line in told.splitlines() if line.startswith("invert: ") and " steps, " in line]
    assert 20 <= steps < 150
    log = Path("logs/object_rearrangement/invert")
    assert (log / "results.csv").is_file()


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("--model.modes.sets=0", "model.modes.sets: expected 1 or more, 'each' or 'auto', found 0"),
        ("--model.modes.sets=some", "modes"),
        ("--model.budget.tolerance=1", "model.budget.tolerance: expected null or a share from 0 up to 1, found 1.0"),
        ("--model.budget.tolerance=much", "tolerance"),
    ],
)
def test_modes_and_tolerances_that_are_none_are_one_clear_line(
    tiny: Path, option: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    told = error(capsys, "invert", "--config", INVERSION, f"--model.pretrained={tiny}", option)
    assert expected in told
    assert not list(Path().rglob("concepts"))


# Outputs, and Ctrl-C


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["generate", "object_rearrangement", "--count=1000000000", "--out=pipe.safetensors"], "out"),
        (["sample", "--pretrained=object_rearrangement", "--out=pipe.safetensors"], "out"),
        (["sample", "--pretrained=object_rearrangement", "--figure=pipe.safetensors"], "figure"),
        (["sample", "--pretrained=object_rearrangement", "--animation", "link"], "animation"),
        (["sample", "--pretrained=mocap", "--export=pipe.safetensors"], "export"),
        (["encode", "object_rearrangement", "--out=folder"], "out"),
        (["report", "--out=pipe.safetensors"], "out"),
        (["fit", "--config", PRETRAINING, "--model.output=pipe.safetensors"], "model.output"),
        (["test", "--config", PRETRAINING, "--evaluation.results=link"], "evaluation.results"),
        (["invert", "--config", INVERSION, "--evaluation.results=folder"], "evaluation.results"),
    ],
)
def test_outputs_that_are_no_files_are_refused_before_any_work(
    arguments: list[str], key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo("pipe.safetensors")
    Path("folder").mkdir()
    Path("link").symlink_to("pipe.safetensors")
    told = error(capsys, *arguments)
    assert told.startswith(f"error: {key}: ")
    assert "or nothing there, found a " in told
    assert told.count("\n") == 1
    assert Path("pipe.safetensors").is_fifo()
    assert len(list(Path().iterdir())) == 3


@pytest.mark.parametrize(
    "arguments",
    [["generate", "object_rearrangement", "--count=1"], ["fit", "--config", PRETRAINING, *TINY, "--trainer.max_steps=9"]],
)
def test_ctrl_c_is_one_line_and_130(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from ftl_lightning.learning import PretrainingModule

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PretrainingModule, "training_step", stop)
    monkeypatch.setattr(Demonstrations, "save", stop)
    before = signal.getsignal(signal.SIGINT)
    try:
        assert main(arguments) == 130
    finally:
        signal.signal(signal.SIGINT, before)  # Lightning ignores it from then on
    assert capsys.readouterr().err == "interrupted: what was written before is whole\n"
    assert not list(Path().rglob("*.safetensors"))


# Options out of their ranges

SHORT = [*TINY, "--trainer.max_steps=2", "--data.steps_per_epoch=1", "--evaluation.samples=2", "--evaluation.figures=0"]


@pytest.mark.parametrize(
    "option",
    [
        "--seed_everything=-1",
        "--seed_everything=99999999999",
        "--model.seed=-1",
        "--model.seed=1",
        "--model.warmup_steps=-1",
        "--trainer.max_steps=0",
        "--trainer.max_steps=-5",
        "--trainer.max_epochs=0",
        "--trainer.limit_train_batches=0",
        "--trainer.gradient_clip_val=-1",
        "--trainer.devices=0",
        "--model.learning_rate=-1",
        "--model.learning_rate=.nan",
        "--model.weight_decay=-1",
        "--model.loss.condition_dropout=2",
        "--model.ema_decay=5",
        "--model.guidance=.inf",
        "--model.diffusion_steps=0",
        "--model.codes.knots=0",
        "--model.denoiser_args.hidden_dim=0",
        "--model.denoiser_args.depth=0",
        "--model.denoiser_args.condition_dim=-1",
        "--model.denoiser_args.dropout=2",
        "--data.seed=-1",
        "--evaluation.seed=-1",
        "--evaluation.figures=-1",
    ],
)
def test_options_of_fit_out_of_their_ranges_are_one_line(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    told = error(capsys, "fit", "--config", PRETRAINING, *SHORT, option)
    assert told.count("\n") == 1
    assert option[2:].split("=")[0].split(".")[-1] in told
    assert not list(Path().rglob("*.safetensors"))


@pytest.mark.parametrize(
    ("method", "option"),
    [("bc", "hidden_dim"), ("bc", "plan_horizon"), ("cvae", "hidden_dim"), ("cvae", "latent_dim")],
)
def test_sizes_of_baselines_out_of_their_ranges_are_one_line(method: str, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    configuration = str(CONF / method / "object_rearrangement.yaml")
    told = error(capsys, "fit", "--config", configuration, *SHORT[1:], f"--model.{option}=0")
    assert told == f"error: model.{option}: expected 1 or more, found 0\n"


@pytest.mark.parametrize(
    "option",
    [
        "--model.budget.learning_rate=-1",
        "--model.weights.learning_rate=.inf",
        "--model.adapter.learning_rate=-1",
        "--model.embeddings.initial_spread=-1",
        "--model.weights.initial=.nan",
        "--model.omega=.nan",
        "--model.weights.training=.nan",
        "--model.seed=-1",
        "--data.seed=-1",
        "--trainer.max_epochs=0",
    ],
)
def test_options_of_invert_out_of_their_ranges_are_one_line(tiny: Path, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--data.suite=validation", "--data.steps=1", "--evaluation.samples=1", "--evaluation.steps=2"]
    told = error(capsys, "invert", "--config", INVERSION, f"--model.pretrained={tiny}", *more, option)
    assert told.count("\n") == 1
    assert option[2:].split("=")[0].split(".")[-1] in told
    assert not list(Path().rglob("*.safetensors"))


def test_no_warm_up_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--config", PRETRAINING, *SHORT, "--model.warmup_steps=0"]) == 0


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"model: {a: \xff\xfe}\n", "odd.yaml: expected a configuration file (YAML)"),
        (b"a: \x00\n", "odd.yaml: expected a configuration file (YAML)"),
        (b"trainer: {max_steps: '${unknown}'}\n", "configuration: Interpolation key"),
    ],
)
def test_odd_configuration_files_are_one_line(content: bytes, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("odd.yaml").write_bytes(content)
    told = error(capsys, "fit", "--config", PRETRAINING, "--config", "odd.yaml")
    assert expected in told
    assert told.count("\n") == 1


def test_an_empty_name_of_a_configuration_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("ablation.yaml").write_text("stages: [{verb: fit, config: ''}]\nresults: r.csv\n")
    assert error(capsys, "ablate", "--config", "ablation.yaml").count("\n") == 1


def test_no_table_is_written_under_a_name_that_tells_another_form(capsys: pytest.CaptureFixture[str]) -> None:
    told = error(capsys, "encode", "object_rearrangement", "--encoder=hashing", "--out=x.npz")
    assert told == "error: out: expected a name that ends in .safetensors, which is what is written, found 'x.npz'\n"
    assert not list(Path().iterdir())
