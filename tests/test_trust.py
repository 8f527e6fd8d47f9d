"""Code runs when the person at the keyboard names it, and never because a file does: planted modules tell on themselves."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import nbformat
import pytest
import safetensors.torch
import torch
from nbclient import NotebookClient

from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.traffic import SHIPPED
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tabletop.interface import PUSH
from ftl_lightning.evaluation.results import COLUMNS
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.concept import VERSION
from ftl_lightning.services import trust
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.model_folder import load_model

from .conftest import CONF, ROOT, python

EVIL = """
from pathlib import Path
(Path(__file__).parent / "ran").touch()
from ftl_lightning.domains.driving import DOMAIN
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from ftl_lightning.training.data import PretrainingData
class Called(Callback): ...
class Logger(CSVLogger): ...
class Module(PretrainingModule): ...
class Data(PretrainingData): ...
def make(): return Called()
"""
SHADOW = 'from pathlib import Path\n(Path(__file__).parent / "ran").touch()\nraise ImportError("planted")\n'
OFFERED = "[ftl_lightning.domains]\nevil = evil:DOMAIN\n[lightning.pytorch.callbacks_factory]\nevil = evil:make\n"
DOMAIN = "evil:DOMAIN"
SAMPLE = ["sample", "--pretrained=model", "--compose=merge", "--goal=merge", "--count=1", "--steps=1"]
FITTED, LEARNED = CONF / "object_rearrangement.yaml", CONF / "driving.yaml"
FIT = ["fit", f"--config={FITTED}", "--trainer.max_steps=1"]
INVERT = ["invert", f"--config={LEARNED}", "--model.pretrained=model", "--data.steps=1"]
NOT_IMPORTED = "not imported"


@pytest.fixture(autouse=True)
def _planted() -> None:
    """The current folder: a module, one in a folder, and a pretrained model that asks for the first."""
    Path("evil.py").write_text(EVIL)
    Path("inside").mkdir()
    Path("inside/evil.py").write_text(EVIL)
    load_domain.cache_clear()
    for name in ("evil", "inside", "inside.evil"):
        sys.modules.pop(name, None)
    model(DOMAIN)


def model(domain: str, **changes: object) -> None:
    """A shipped model's folder with another domain in its configuration."""
    source = ROOT / "pretrained" / "driving"
    Path("model").mkdir(exist_ok=True)
    content = json.loads((source / "config.json").read_text()) | {"domain": domain} | changes
    Path("model/config.json").write_text(json.dumps(content))
    weights = Path("model/model.safetensors")
    weights.unlink(missing_ok=True)
    weights.symlink_to(source / weights.name)


def ran() -> bool:
    return any(Path().rglob("ran"))


@pytest.fixture
def _found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules in the current folder are found, as in a notebook."""
    monkeypatch.setattr(sys, "path", ["", *sys.path])


found = pytest.mark.usefixtures("_found")


def refused(capsys: pytest.CaptureFixture[str], arguments: Sequence[str], *expected: str) -> None:
    """Run a verb in this process and expect one line that says something, and no code of others."""
    capsys.readouterr()
    assert main(arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert all(text in line for text in expected), line
    assert not ran()


# A model's folder


@pytest.mark.parametrize("domain", [DOMAIN, "inside.evil:DOMAIN"])
@pytest.mark.parametrize("first", ["", ".", "here", "inside"])
def test_a_model_s_folder_that_names_code_is_refused_with_a_path_of_python(
    domain: str, first: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python begins its path with nothing or the folder, and ``PYTHONPATH`` adds to it."""
    entry = {"here": str(Path.cwd()), "inside": str(Path("inside").absolute())}.get(first, first)
    monkeypatch.setattr(sys, "path", [entry, *sys.path])
    monkeypatch.setenv("PYTHONPATH", entry)
    model(domain)
    refused(capsys, SAMPLE, "model/config.json", domain, "--trust", NOT_IMPORTED)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["-m, here", "-m, inside", "script"])
def test_a_model_s_folder_that_names_code_is_refused_by_the_program(start: str) -> None:
    program = [Path(sys.executable).with_name("ftl-lightning")] if start == "script" else ["-m", "ftl_lightning"]
    first = f"{Path('inside').absolute() if start.endswith('inside') else Path.cwd()}:" if start != "script" else ""
    done = python(*program, *SAMPLE, PYTHONPATH=f"{first}{ROOT}")
    assert done.returncode == 2, done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    for text in ("model/config.json", DOMAIN, "--trust", NOT_IMPORTED):
        assert text in line
    assert "Traceback" not in done.stderr
    assert not ran()


def refused_by_everything() -> None:
    """Whatever reads a model's folder refuses the one that asks for code."""
    concept()
    for call in (SAMPLE, INVERT, ["explain", "--pretrained=model", "--concept=c.safetensors"]):
        assert main(call) == 2
    for load in (FewShot.from_pretrained, load_model):
        with pytest.raises(UserError, match=f"domain='{DOMAIN}'"):
            load("model")
    assert not ran()


@found
def test_a_model_s_folder_that_names_code_is_refused_by_everything(capsys: pytest.CaptureFixture[str]) -> None:
    refused_by_everything()
    assert capsys.readouterr().err.count(NOT_IMPORTED) == 3


@pytest.mark.slow
def test_a_model_s_folder_that_names_code_is_refused_by_everything_in_one_python() -> None:
    done = python("-c", "from tests.test_trust import refused_by_everything; refused_by_everything()")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(NOT_IMPORTED) == 3
    assert not ran()


@pytest.mark.notebook
def test_a_model_s_folder_that_names_code_is_refused_in_a_notebook_beside_it() -> None:
    cells = ["from ftl_lightning import FewShot", "FewShot.from_pretrained('model')"]
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    with pytest.raises(Exception, match=NOT_IMPORTED):
        NotebookClient(book, resources={"metadata": {"path": str(Path.cwd())}}).execute()
    assert not ran()


@pytest.mark.parametrize(
    "name",
    [
        "json:loads",  # Python's own
        "nbformat:v4",  # of an installed package
        "ftl_lightning.domains.driving.expert:DOMAIN",  # ours, but no domain that is offered
        "ftl_lightning.pretrained.evil:DOMAIN",  # where models lie
        "evil",
        "evil.DOMAIN",
        "../evil:DOMAIN",
        "evil:DOMAIN.__class__",
        "",
        ":",
    ],
)
def test_a_model_s_folder_names_no_module_at_all(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    model(name)
    before = set(sys.modules)
    refused(capsys, SAMPLE, "model/config.json")
    assert not {"evil", name.partition(":")[0]} & (set(sys.modules) - before)


@found
@pytest.mark.parametrize(
    "changes",
    [
        {"denoiser": "evil.Module"},
        {"denoiser_args": {"initial_encoder": "evil.Module"}},
        {"denoiser_args": {"initial_encoder": "evil:Module"}},
        {"denoiser_args": {"class_path": "evil.Module"}},
        {"denoiser_args": {"hidden_dim": {"class_path": "evil.Module"}}},
        {"image_encoder": {"class_path": "evil.Module"}},
        {"metrics": {"evil:DOMAIN": 1.0}},
        {"view": "evil:DOMAIN"},
        {"prediction": "evil.make"},
        {"kind": "evil:Module"},
        {"kind": "evil.Module"},
        {"callbacks": [{"class_path": "evil.Called"}]},
        {"class_path": "evil.Module"},
    ],
    ids=str,
)
def test_nothing_in_a_model_s_folder_is_imported(changes: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    model("driving", **changes)
    refused(capsys, SAMPLE)


def test_the_record_of_training_in_a_model_s_folder_is_no_code() -> None:
    model("driving", training={"model": {"class_path": "evil.Module"}, "callbacks": ["evil.Called"], "domain": DOMAIN})
    assert main(SAMPLE) == 0
    assert not ran()


# Folders that are found, results, and lists of what is installed


def concept() -> None:
    """A learned concept of the shipped model."""
    content = json.loads((ROOT / "pretrained/driving/config.json").read_text())
    origin = {"name": "merge", "domain": content["domain"], "encoder": content["encoder"], "pretrained": content["hash"]}
    header = {
        "kind": "concept",
        "format": VERSION,
        **origin,
        "demonstrations": "0" * 16,
        "count": 5,
        "weights": "fixed",
        "loss": 0.1,
    }
    tensors = {"embeddings": torch.ones(1, 1, content["concept_dim"]), "weights": torch.ones(1)}
    safetensors.torch.save_file(tensors, "c.safetensors", {"ftl_lightning": json.dumps(header)})


@found
@pytest.mark.parametrize("place", ["logs", "pretrained"])
def test_folders_that_a_search_finds_are_read_as_data(place: str, capsys: pytest.CaptureFixture[str]) -> None:
    concept()
    model(DOMAIN)
    Path(place).mkdir()
    Path("model").rename(f"{place}/a")
    # The planted folder has the hash of the model, which ships, too, and is found.
    assert main(["explain", "--concept=c.safetensors"]) == 0, capsys.readouterr().err
    assert "nearest" in capsys.readouterr().out
    assert not ran()


@found
@pytest.mark.parametrize("name", [DOMAIN, "inside.evil:DOMAIN", "evil"])
def test_rows_name_no_code(name: str) -> None:
    cells = f"{name},paper,go,evil.Called,evil:make,evil:make,method,1,1.2,5,0,10,evil:make,0.5,,a,1"
    Path("r.csv").write_text("\n".join((",".join(COLUMNS), cells)))
    main(["report", "--results=r.csv", "--out=out"])
    assert not ran()


def card() -> None:
    Path("evil-1.0.dist-info").mkdir()
    Path("evil-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    Path("evil-1.0.dist-info/entry_points.txt").write_text(OFFERED)
    model("evil")


@found
def test_a_card_of_a_package_in_the_current_folder_installs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    card()
    refused(capsys, SAMPLE, "domain: expected one of", "found 'evil'")
    with pytest.raises(UserError, match="found 'evil'"):
        FewShot.from_pretrained("model")
    assert not [point for point in trust.entry_points("ftl_lightning.domains") if point.name == "evil"]


@pytest.mark.slow
def test_a_card_of_a_package_in_the_current_folder_installs_nothing_in_a_new_python() -> None:
    card()
    code = f"from ftl_lightning.cli.main import main; assert main({SAMPLE}) == 2; "
    done = python("-c", code + "from ftl_lightning import FewShot; FewShot.from_pretrained('model')")
    assert "domain: expected one of" in done.stderr
    assert done.stderr.count("found 'evil'") >= 2
    assert not ran()


@pytest.mark.parametrize(
    ("names", "arguments"),
    [
        (("typing", "rich", "omegaconf", "jsonargparse"), ["--version"]),
        pytest.param(
            ("typing", "torch", "pandas", "rich", "matplotlib", "safetensors", "omegaconf", "transformers", "jsonargparse"),
            [*SAMPLE, "--figure=a.png"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("multiprocessing", "pickle", "torch", "pybullet"),
            ["generate", "tabletop", f"--task={PUSH}", "--count=2", "--workers=2", "--out=d.safetensors"],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["at once", "sampling", "worker processes"],
)
def test_a_module_named_as_one_of_a_library_s_does_not_run_in_its_place(names: Sequence[str], arguments: Sequence[str]) -> None:
    for name in names:
        Path(f"{name}.py").write_text(SHADOW)
    model("driving")
    done = python("-m", "ftl_lightning", *arguments)
    assert done.returncode == 0, done.stderr
    assert not ran()


# Configurations


CALLED = "lightning.pytorch.callbacks.LambdaCallback"
CONFIGURED = [
    ("trainer: {callbacks: [{class_path: evil.Called}]}", "trainer.callbacks[0].class_path"),
    ("trainer: {callbacks: {class_path: inside.evil.Called}}", "trainer.callbacks.class_path"),
    ("trainer: {logger: {class_path: evil.Logger, init_args: {save_dir: logs}}}", "trainer.logger.class_path"),
    ("trainer: {strategy: {class_path: evil.Called}}", "trainer.strategy.class_path"),
    ("trainer: {plugins: [{class_path: evil.Called}]}", "trainer.plugins[0].class_path"),
    ("trainer: {profiler: {class_path: evil.Called}}", "trainer.profiler.class_path"),
    ("model: {class_path: evil.Module}", "model.class_path"),
    ("data: {class_path: evil.Data}", "data.class_path"),
    ("optimizer: {class_path: evil.Called}", "optimizer.class_path"),
    ("model: {class_path: ftl_lightning.pretrained.evil.Module}", "model.class_path"),
    ("model: {class_path: ftl_lightning.conf.evil.Module}", "model.class_path"),
    ("data: {init_args: {domain: 'evil:DOMAIN'}}", "data.domain"),
    ("trainer: {callbacks: [evil.Called]}", "evil"),
    ("trainer: {callbacks: evil.Called}", "evil"),
    ("model: evil.Module", "evil"),
    ("data: evil.Data", "evil"),
    ("x: evil.Called\ntrainer: {callbacks: [{class_path: '${x}'}]}", "x"),
    ("model: {init_args: {denoiser_args: {hidden_dim: {class_path: evil.Called}}}}", "class_path"),
    ("model: {init_args: {denoiser_args: {hidden_dim: {class_path: collections.Counter}}}}", "hidden_dim"),
    (f"trainer: {{callbacks: [{{class_path: {CALLED}, init_args: {{on_fit_start: evil.make}}}}]}}", "evil"),
    (f"trainer: {{callbacks: [{{class_path: {CALLED}, init_args: {{on_fit_start: os.system}}}}]}}", "os"),
    ("trainer: {callbacks: [{class_path: os.system}]}", "os"),
    ("trainer: {callbacks: [{class_path: subprocess.Popen, init_args: {args: [touch, ran]}}]}", "subprocess"),
]


@found
@pytest.mark.parametrize(("text", "expected"), CONFIGURED, ids=lambda value: value[:60])
def test_a_configuration_that_names_code_is_refused(text: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("c.yaml").write_text(text)
    refused(capsys, [*FIT, "--config=c.yaml"], expected)


REST = [pytest.param(*case, marks=pytest.mark.fuzz) for case in CONFIGURED[3:-4]]


@pytest.mark.parametrize(("text", "expected"), [*CONFIGURED[:3], *CONFIGURED[-4:], *REST], ids=lambda value: value[:60])
def test_a_configuration_that_names_code_which_is_not_found_is_refused(
    text: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("c.yaml").write_text(text)
    refused(capsys, [*FIT, "--config=c.yaml"], expected)


@found
@pytest.mark.parametrize(
    "stage",
    [
        "{verb: fit, config: c.yaml}",
        f"{{verb: fit, config: {FITTED}, options: {{data.domain: 'evil:DOMAIN'}}}}",
        f"{{verb: fit, config: {FITTED}, options: {{trainer.callbacks.class_path: evil.Called}}}}",
        f"{{verb: fit, config: {FITTED}, options: {{trainer.callbacks: evil.Called}}}}",
        f"{{verb: invert, config: {LEARNED}, options: {{data.domain: 'evil:DOMAIN', model.pretrained: model}}}}",
        f"{{verb: invert, config: {LEARNED}, options: {{model.pretrained: model}}}}",
    ],
)
def test_the_plan_of_an_ablation_names_no_code(stage: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("c.yaml").write_text(
        f"defaults: [{CONF / 'object_rearrangement.yaml'}]\ntrainer: {{callbacks: [{{class_path: evil.Called}}]}}"
    )
    Path("a.yaml").write_text(f"stages: [{stage}]\nresults: r.csv")
    refused(capsys, ["ablate", "--config=a.yaml"])


def test_an_installed_class_that_is_no_domain_s_is_taken_from_a_configuration() -> None:
    Path("c.yaml").write_text("trainer: {callbacks: [{class_path: lightning.pytorch.callbacks.RichModelSummary}]}")
    assert main([*FIT, "--config=c.yaml", "--print_config"]) == 0


def test_a_module_on_the_path_that_is_not_the_current_folder_is_taken_from_a_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("c.yaml").write_text("trainer: {callbacks: [{class_path: evil.Called}]}")
    monkeypatch.setattr(sys, "path", [str(Path("inside").absolute()), *sys.path])
    assert main([*FIT, "--config=c.yaml", "--print_config"]) == 0
    assert Path("inside/ran").exists()
    assert not Path("ran").exists()


# What a person names


NAMED: list[tuple[Sequence[str], str]] = [
    ([*SAMPLE, "--trust=evil"], "evil"),
    ([*SAMPLE, "--trust", "evil"], "evil"),
    ([*FIT, "--print_config", "--trainer.callbacks=evil.Called"], "evil"),
    ([*FIT, "--print_config", "--trainer.callbacks.class_path", "inside.evil.Called"], "inside/evil"),
    ([*FIT, "--print_config", "--config=c.yaml", "--trust=inside"], "inside/evil"),
    ([*FIT, "--print_config", "--config=c.yaml", "--trust=inside.evil"], "inside/evil"),
    ([*FIT, "--print_config", "--config={trainer: {callbacks: [{class_path: evil.Called}]}}"], "evil"),
    (["generate", DOMAIN, "--task=nothing"], "evil"),
]


@pytest.mark.parametrize(("arguments", "module"), NAMED, ids=lambda value: str(value)[-40:])
def test_a_person_lets_code_run_by_naming_it(arguments: Sequence[str], module: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("c.yaml").write_text("trainer: {callbacks: [{class_path: inside.evil.Called}]}")
    main(arguments)
    assert NOT_IMPORTED not in capsys.readouterr().err
    assert Path(module).with_name("ran").exists()
    assert sum(1 for _ in Path().rglob("ran")) == 1
    assert "" not in sys.path
    assert str(Path.cwd()) not in sys.path


def test_one_module_that_is_named_lets_no_other_run(capsys: pytest.CaptureFixture[str]) -> None:
    model("inside.evil:DOMAIN")
    Path("c.yaml").write_text("trainer: {callbacks: [{class_path: inside.evil.Called}]}")
    for arguments in ([*SAMPLE, "--trust=evil"], [*FIT, "--config=c.yaml", "--trust=evil"]):
        assert main(arguments) == 2
        assert NOT_IMPORTED in capsys.readouterr().err
    assert not ran()


@pytest.mark.parametrize("folder", ["evil", DOMAIN, "evil.Called"])
def test_a_folder_s_name_on_the_command_line_names_no_code(folder: str) -> None:
    Path("model").rename(folder)
    assert main(["sample", f"--pretrained={folder}", "--compose=merge"]) == 2
    assert main([*FIT[:-1], f"--trainer.default_root_dir={folder}", "--trainer.callbacks.class_path=nothing.Here"]) == 2
    assert not ran()


@pytest.mark.parametrize("value", ["", "a/b", "../evil", "evil:DOMAIN", "-x", "evil py"])
def test_what_is_trusted_is_a_module(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SAMPLE, f"--trust={value}"]) == 2
    assert "--trust: expected the name of a module" in capsys.readouterr().err


def test_in_python_the_domain_is_an_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path.cwd())
    with pytest.raises(UserError, match=NOT_IMPORTED):
        FewShot.from_pretrained("model")
    assert not ran()
    found = FewShot.from_pretrained("model", domain=DOMAIN)
    assert ran()
    again = FewShot.from_pretrained("model", domain=found.domain)
    assert again.domain is found.domain
    # Settings that a person gives may name the domain, where its module is found without the current folder.
    Path("own.yaml").write_text(f"defaults: [{CONF / 'driving.yaml'}]\ndata: {{init_args: {{domain: 'evil:DOMAIN'}}}}")
    assert FewShot.from_pretrained("model", settings="own.yaml").domain is found.domain


@pytest.mark.slow
def test_a_model_is_adapted_where_the_configuration_names_its_domain() -> None:
    two = Demonstrations.load(SHIPPED / "merge.safetensors").rows([0, 1])
    replace(two, concepts=("roundabout",) * 2).save("two.safetensors")
    options = ["--data.domain", DOMAIN, "--data.demonstrations=two.safetensors", "--model.form=paper", "--model.budget.samples=2"]
    options += ["--evaluation.samples=1", "--evaluation.references=false", "--trainer.enable_progress_bar=false"]
    assert main([*INVERT, *options, "--evaluation.figures=0", "--evaluation.closed_loop=false"]) == 0
    assert ran()


@pytest.mark.parametrize("name", ["agent", "driving", "mocap", "object_rearrangement", "tabletop"])
def test_what_ships_is_known(name: str) -> None:
    assert FewShot.from_pretrained(name).domain.name == name


def test_the_path_is_restored_after_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    before = list(sys.path)
    assert main(["--version"]) == 0
    assert sys.path == before
    assert "" not in trust.search_path()


def test_stages_of_an_ablation_are_read_in_a_process_of_their_own() -> None:
    """What a process has been told of trusted classes before would hide that they are not."""
    done = python("-m", "ftl_lightning", "ablate", "--config=conf/ablation/smoke.yaml", "--print_config")
    assert done.returncode == 0, done.stderr
    assert "verb: invert" in done.stdout


@pytest.mark.slow
def test_a_class_that_a_person_named_once_stays_taken_from_its_package(capsys: pytest.CaptureFixture[str]) -> None:
    stopping = "--trainer.callbacks+=lightning.pytorch.callbacks.EarlyStopping"
    for more, expected in (([stopping, "--trainer.callbacks.monitor=val/loss"], "data.batch_size"), ([], "data.batch_size")):
        assert main([*FIT, *more, "--data.batch_size=0"]) == 2
        assert expected in capsys.readouterr().err
