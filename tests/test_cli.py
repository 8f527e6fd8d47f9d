"""The command line: help, configuration files, what the verbs with a trainer write and say, and Ctrl-C."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml

from ftl_lightning.apps.lightning_cli import parse
from ftl_lightning.cli.main import COMMANDS, TRAINER_VERBS, main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.configuration import parts
from ftl_lightning.training.trainer import Trainer
from tests.conftest import CONF, python, refused, succeed
from tests.tiny import CONFIGURATIONS, OURS, QUIET, fit

FITS = [str(path.with_suffix("")) for path in CONFIGURATIONS]
INVERSIONS = [[name] for name in (*FITS, "mocap_adapter", "tabletop_adapter")] + [[name, "method/language"] for name in OURS]
CONFIGS = [
    *(("fit", [name]) for name in FITS),
    *(("fit", [name, "size/paper"]) for name in OURS),
    *(("invert", names) for names in INVERSIONS),
    *(("ablate", [f"ablation/{path.stem}"]) for path in sorted((CONF / "ablation").glob("*.yaml"))),
]
"""Verbs with the files that are added to one another for them."""
QUICKLY = [*(("fit", [name]) for name in OURS), ("invert", ["agent"])]
"""Those that are read each time."""
SCENES = f"--config={CONF / 'object_rearrangement.yaml'}"
QUICK = ["--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0", "--evaluation.diversity=false"]
QUICK += ["--evaluation.references=false", *QUIET]
SHORT = ["--data.batch_size=8", "--trainer.max_steps=4", "--data.steps_per_epoch=2"]
FIT = fit(Path("object_rearrangement.yaml"), *SHORT, *QUICK)
Told = pytest.CaptureFixture[str]
SLOW = pytest.mark.slow


@pytest.fixture
def pretrained(tiny_of: Callable[[str], Path]) -> Path:
    """Folder of a model of scenes."""
    return tiny_of("object_rearrangement")


@pytest.fixture
def invert(pretrained: Path) -> Callable[..., Path]:
    """Learn one relation from five demonstrations, or what the options say; returns the log folder."""
    task = "circle right of square and square above triangle"
    load_domain("object_rearrangement").source(None).draw(task, 5, 0).save("five.safetensors")

    def run(*options: str) -> Path:
        given = ["--data.demonstrations=five.safetensors", "--data.steps=5", "--model.budget.samples=4", "--model.form=paper"]
        succeed("invert", SCENES, f"--model.pretrained={pretrained}", *given, *QUICK, *options)
        return Path("logs/object_rearrangement/invert")

    return run


VERBS = [*COMMANDS, "fit", "invert", *(pytest.param(verb, marks=SLOW) for verb in ("validate", "test"))]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: Told) -> None:
    assert main([verb, "--help"]) == 0
    assert verb in capsys.readouterr().out


def test_the_overview_names_every_verb(capsys: Told) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in (*TRAINER_VERBS, *COMMANDS))


# Without options `play` opens the page of a model that ships, and serves it until it is told to end.
@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb != "play"])
def test_a_verb_without_options_says_what_it_needs(verb: str, capsys: Told) -> None:
    assert main([verb]) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("error: ")
    assert "expected" in told or "required" in told
    assert "\n" not in told


def test_help_and_a_missing_input_file_come_before_anything_slow_is_imported() -> None:
    mistakes = [
        ["invert", "--config", "nothing.yaml"],
        ["invert", SCENES, "--model.pretrained", "nowhere"],
        ["fit", SCENES, "--ckpt_path=no.ckpt"],
        ["sample", "--pretrained", "nowhere"],
    ]
    slow = ("lightning", "torch", "transformers")
    code = (
        "import sys; from ftl_lightning.cli.main import main\n"
        f"assert [main(arguments) for arguments in {mistakes!r}] == [2] * {len(mistakes)}\n"
        f"assert not {{'jsonargparse', *{slow!r}}} & sys.modules.keys()\n"
        "assert main(['generate', '--help']) == 0\n"
        f"assert not set({slow!r}) & sys.modules.keys()\n"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == len(mistakes)


# Configuration files


@pytest.mark.parametrize(
    ("verb", "names"),
    [pytest.param(verb, names, marks=[] if (verb, names) in QUICKLY else SLOW) for verb, names in CONFIGS],
    ids=str,
)
def test_every_configuration_file_parses(verb: str, names: list[str], capsys: Told) -> None:
    """Rows of those that ship for ``invert`` are known without the trainer: so were they before its options counted."""
    files = [CONF / f"{name}.yaml" for name in names]
    given = [f"--config={path}" for path in files] + (["--data.demonstrations=strokes.npz"] if names[0] == "own" else [])
    found = succeed(verb, *given, "--print_config") if verb == "ablate" else parse(verb, given)
    told = capsys.readouterr()
    assert told.err == ""
    found = found or yaml.safe_load(told.out)
    assert all(set(keys) <= set(found) for path in files for _, keys in parts(path, verb))
    if verb == "invert" and not names[1:]:
        trainer = {key: value for key, value in found["trainer"].items() if key not in ("callbacks", "logger")}
        assert not Trainer(**trainer | {"accelerator": "cpu", "logger": False}).unusual


def test_configurations_are_found_in_a_folder_without_any_and_their_keys_can_be_read_back(capsys: Told) -> None:
    assert not Path("conf").exists()
    succeed("fit", "--config", "conf/bc/agent.yaml", "--seed_everything=7", "--print_config")
    config = yaml.safe_load(capsys.readouterr().out)
    assert "CloningPretraining" in config["model"]["class_path"]
    # One seed decides all of them, wherever it is given.
    assert config["model"]["init_args"]["seed"] == config["data"]["init_args"]["seed"] == config["evaluation"]["seed"] == 7


@pytest.mark.parametrize(
    ("given", "content", "expected"),
    [
        (["--config=whole.yaml"], b"model: {init_args: {depht: 3}}\n", "'depht' is not accepted"),
        ([SCENES, "--config=part.yaml"], b"model: {init_args: {depht: 3}}\n", "'depht' is not accepted"),
        ([SCENES, "--config=part.yaml"], b"model: {a: \xff\xfe}\n", "expected a configuration file (YAML)"),
        ([SCENES, "--config", "part.yaml"], b"a: \x00\n", "expected a configuration file (YAML)"),
        ([SCENES, "--config", "part.yaml"], b"trainer: {max_steps: '${unknown}'}\n", "error: configuration: Interpolation key"),
    ],
)
def test_a_mistake_in_a_file_is_told_in_one_line_with_the_file(
    given: list[str], content: bytes, expected: str, capsys: Told
) -> None:
    Path("part.yaml").write_bytes(content)
    Path("whole.yaml").write_text(f"defaults: ['{CONF / 'object_rearrangement.yaml'}', part.yaml]\ntrainer: {{max_steps: 1}}\n")
    told = refused(capsys, ["fit", *given], expected)
    assert told.startswith("error: configuration: " if b"unknown" in content else "error: part.yaml: ")
    assert told.count("\n") == 1


# Runs


def test_fit_says_how_far_it_is_and_where_the_model_is(capfd: Told) -> None:
    succeed(*FIT, "--model.warmup_steps=0", "--trainer.enable_progress_bar=true")
    told = capfd.readouterr()
    lines = told.err.splitlines()
    assert lines[0] == "fit: 0/4"
    assert [line.split(",")[0] for line in lines[1:-1]] == [f"fit: {step}/4" for step in range(1, 4)]
    assert lines[-1].startswith("fit: 4 steps, 0:")
    assert ", loss " in lines[-1]
    assert "accuracy" in lines[-1]
    assert told.out.startswith("pretrained model: logs/object_rearrangement/fit/pretrained, accuracy 0.")
    assert told.out.endswith("to learn a concept: python -m ftl_lightning invert logs/object_rearrangement/fit/pretrained FILE\n")
    assert "\x1b" not in told.err + told.out
    assert Path("logs/object_rearrangement/fit/pretrained/config.json").is_file()


SUITE = ["--data.demonstrations=null", "--data.suite=validation", "--evaluation.suites=[validation]"]


@SLOW
def test_an_inversion_says_how_far_it_is_and_overwrites_no_other(invert: Callable[..., Path], capfd: Told) -> None:
    first = invert(*SUITE, "--trainer.enable_progress_bar=true")
    told = capfd.readouterr()
    *lines, last = told.err.splitlines()
    steps = [f"invert: {step}/5" for step in range(5)]
    assert [line.split(",")[0] for line in lines] == [*steps, "invert: 5 steps", "evaluation"]
    assert last.startswith("evaluation: 0:")
    assert told.out.endswith("logged in logs/object_rearrangement/invert\n")
    assert "\x1b" not in told.err + told.out
    assert "v_num" not in told.out
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    invert(*SUITE)
    assert capfd.readouterr().out.endswith("logged in logs/object_rearrangement/invert_1\n")
    assert before == {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    assert (first.parent / "invert_1" / "results.csv").is_file()


def checkpoint_of(pretrained: Path) -> str:
    return f"--ckpt_path={pretrained.parent / 'checkpoints' / 'last.ckpt'}"


@pytest.mark.parametrize("verb", ["test", pytest.param("validate", marks=SLOW)])
def test_a_checkpoint_is_evaluated(verb: str, pretrained: Path) -> None:
    succeed(verb, *FIT[1:], checkpoint_of(pretrained))
    assert Path("logs/object_rearrangement/fit/results.csv").is_file() == (verb == "test")


@SLOW
def test_a_checkpoint_of_another_form_and_a_damaged_one_are_refused(pretrained: Path, capsys: Told) -> None:
    Path("damaged.ckpt").write_bytes((pretrained.parent / "checkpoints" / "last.ckpt").read_bytes()[:1000])
    wider = "--model.denoiser_args={hidden_dim: 96, depth: 2, condition_dim: 32}"
    for arguments, expected in (
        (["test", *FIT[1:], wider, checkpoint_of(pretrained)], "key 'denoiser_args': expected {'hidden_dim': 96"),
        (["test", SCENES, "--ckpt_path=damaged.ckpt"], "damaged.ckpt: expected a checkpoint, found a damaged or foreign file"),
    ):
        assert main(arguments) == 2
        told = capsys.readouterr().err
        assert expected in told
        assert "Traceback" not in told


def test_the_model_card_and_config_of_the_shipped_model(shipped: Path) -> None:
    config = json.loads((shipped / "config.json").read_text())
    assert config["domain"] == "object_rearrangement"
    assert (shipped / "model.safetensors").stat().st_size <= 8e6
    assert config["hash"] in (shipped / "README.md").read_text()
    succeed("sample", f"--pretrained={shipped}", "--compose=circle right of square:1.2", "--count=5", "--steps=10")


@pytest.mark.parametrize(("modes", "how"), [("each", "one of them"), pytest.param("auto", "", marks=SLOW)])
def test_modes_are_learned_explained_and_sampled_from(
    pretrained: Path, invert: Callable[..., Path], capsys: Told, modes: str, how: str
) -> None:
    (file,) = (invert(f"--model.modes.sets={modes}") / "concepts").iterdir()
    learned = Concept.load(file)
    assert learned.modes is not None
    assert len(learned.modes) == 5
    capsys.readouterr()
    succeed("explain", f"--concept={file}", f"--pretrained={pretrained}")
    told = capsys.readouterr().out
    how = how or ("a random mixture of them" if learned.modes.mixed else "one of them")
    assert f"alone it generates from {how}: 5 modes; composed, from the components that have no mode\n" in told
    assert told.count("nearest: ") == 2 + 5 * 2 + 1  # the components, those of every mode, the weighted sum
    assert "\nmode 5, component 2, weight 1.20: nearest: " in told
    Concept(learned.embeddings, learned.weights, learned.origin).save("centre.safetensors")
    options = [f"--pretrained={pretrained}", "--count=6", "--steps=3", "--out=states.safetensors"]
    states = []
    for more in ([], ["--compose=circle above square"]):
        for concept in (file, "centre.safetensors"):
            succeed("sample", *options, f"--concept={concept}", *more)
            states.append(Demonstrations.load("states.safetensors").states)
    assert not torch.equal(states[0], states[1])
    assert torch.equal(states[2], states[3])


@SLOW
def test_a_run_that_stops_by_itself_says_after_how_many_steps(invert: Callable[..., Path], capfd: Told) -> None:
    log = invert("--data.steps=150", "--model.budget.tolerance=0.5", "--trainer.enable_progress_bar=true")
    told = capfd.readouterr().err
    (steps,) = [int(line.split()[1]) for line in told.splitlines() if line.startswith("invert: ") and " steps, " in line]
    assert 20 <= steps < 150
    assert (log / "results.csv").is_file()


@pytest.mark.parametrize("arguments", [["generate", "object_rearrangement", "--count=1"], FIT], ids=lambda value: value[0])
def test_ctrl_c_is_one_line_and_130(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Told) -> None:
    from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule

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
