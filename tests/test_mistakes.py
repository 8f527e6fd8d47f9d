"""Mistakes with options, numbers and names: one line that names the key, exit code 2, and nothing is left behind."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from ftl_lightning.cli import main
from ftl_lightning.evaluation.results import COLUMNS

from .conftest import CONF, ROOT, TINY, refused

Told = pytest.CaptureFixture[str]
FIT = ["fit", f"--config={CONF / 'object_rearrangement.yaml'}", *TINY, "--trainer.max_steps=2"]
INVERT = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", "--model.pretrained=object_rearrangement"]
PUSH = "go to red object"
SAMPLE = ["sample", "--pretrained=agent"]
CHECKPOINT = "trainer.callbacks=[{class_path: lightning.pytorch.callbacks.ModelCheckpoint, init_args: {%s}}]"
STOPPING = "trainer.callbacks=[{class_path: lightning.pytorch.callbacks.EarlyStopping, init_args: {%s}}]"


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("trainer.accelerator=foo", "foo"),
        ("trainer.accelerator=cuda", "trainer: "),
        ("trainer.devices=0", "devices"),
        ("trainer.devices=-3", "devices"),
        ("trainer.devices=1000", "trainer.devices: expected"),
        ("trainer.num_nodes=0", "trainer.num_nodes: expected"),
        ("trainer.strategy=foo", "foo"),
        ("trainer.precision=foo", "trainer.precision"),
        ("trainer.max_steps=-5", "trainer.max_steps: expected -1 or more"),
        ("trainer.max_epochs=-5", "trainer.max_epochs"),
        ("trainer.max_steps=0", "trainer.max_steps: expected 1 or more"),
        ("trainer.max_time=foo", "trainer"),
        ("trainer.min_steps=-1", "trainer.min_steps: expected 0 or more"),
        (
            "trainer.limit_train_batches=-1",
            "trainer.limit_train_batches: expected a share from 0 to 1 or a whole number of batches",
        ),
        ("trainer.limit_train_batches=0", "trainer.limit_train_batches: expected more than 0"),
        ("trainer.limit_train_batches=0.0001", "limit_train_batches"),
        ("trainer.limit_val_batches=-1", "trainer.limit_val_batches"),
        ("trainer.limit_val_batches=7.5", "trainer.limit_val_batches"),
        ("trainer.val_check_interval=0", "trainer.val_check_interval: expected more than 0"),
        ("trainer.val_check_interval=-1", "trainer.val_check_interval"),
        ("trainer.val_check_interval=1000000", "val_check_interval"),
        ("trainer.check_val_every_n_epoch=0", "trainer.check_val_every_n_epoch: expected 1 or more"),
        ("trainer.check_val_every_n_epoch=-1", "trainer.check_val_every_n_epoch: expected 1 or more"),
        ("trainer.log_every_n_steps=-1", "trainer.log_every_n_steps: expected 0 or more"),
        ("trainer.accumulate_grad_batches=0", "trainer.accumulate_grad_batches: expected 1 or more"),
        ("trainer.gradient_clip_val=-1", "trainer.gradient_clip_val: expected 0 or more"),
        ("trainer.gradient_clip_algorithm=foo", "foo"),
        ("trainer.num_sanity_val_steps=-2", "trainer.num_sanity_val_steps"),
        ("trainer.profiler=foo", "profiler"),
        ("trainer.callbacks=foo", "callbacks"),
        (CHECKPOINT % "every_n_train_steps: -1", "every_n_train_steps"),
        (CHECKPOINT % "every_n_epochs: -1", "every_n_epochs"),
        (CHECKPOINT % "save_top_k: -2", "save_top_k"),
        (CHECKPOINT % "save_top_k: 5", "No quantity for top_k to track"),
        (CHECKPOINT % "mode: foo", "mode"),
        (CHECKPOINT % "train_time_interval: foo", "train_time_interval"),
        (STOPPING % "monitor: val/loss, mode: foo", "mode"),
        ("seed_everything=foo", "seed_everything"),
        ("seed_everything=-1", "seed_everything"),
        *(
            (f"model.{key}=null", f"model.{key}")
            for key in ("learning_rate", "weight_decay", "ema_decay", "loss.condition_dropout", "seed", "loss", "codes")
        ),
        *((f"model.{key}=null", f"model.{key}") for key in ("loss.timestep_power", "guidance", "loss.discount", "diffusion_steps")),
        *(
            (f"data.{key}=null", f"data.{key}")
            for key in ("batch_size", "samples_per_concept", "steps_per_epoch", "encoder", "seed")
        ),
        ("model.feature_dropout={traffic: null}", "feature_dropout"),
        ("model.feature_dropout={x: 0.5}", "model.feature_dropout: expected nothing"),
        ("model.learning_rate=nan", "learning_rate"),
        ("model.learning_rate=1e38", "model.learning_rate: expected a number from 0 to 1e+30"),
        ("model.loss.timestep_power=1e9", "model.loss.timestep_power: expected a number from 1 to 100"),
        ("model.guidance=1e38", "model.guidance: expected a number from -1e+06 to 1e+06"),
        ("model.loss.kind=foo", "model.loss.kind: expected one of epsilon, v, clean, found 'foo'"),
        ("model.prediction=foo", "prediction: expected one of epsilon"),
        ("model.view=foo", "model.view: expected one of"),
        ("model.denoiser=foo", "denoiser: expected one of MLPDenoiser, TemporalUNet"),
        ("model.denoiser_args={initial_encoder: foo}", "denoiser_args.initial_encoder: expected one of flat, joint, entities, set"),
        ("model.denoiser_args={initial_encoder: os.system}", "denoiser_args.initial_encoder: expected one of flat"),
        ("model.denoiser_args={foo: 1}", "denoiser_args.foo"),
        ("model.denoiser_args={depth: null}", "denoiser_args.depth"),
        ("model.denoiser_args={hidden_dim: 0}", "denoiser_args.hidden_dim"),
        ("model.codes.share=1", "model.codes.knots: expected 1 for MLPDenoiser"),
        ("model.foo=1", "foo"),
        ("data.encoder=foo", "encoder: expected a folder or a Hugging Face name"),
        ("data.domain=chess", "data.domain: expected 'object_rearrangement'"),
        ("data.domain=../../x", "data.domain: expected 'object_rearrangement'"),
        ("data.start_exponent=1e38", "data.start_exponent"),
        ("data.balance=nan", "balance"),
        ("evaluation.suites=[foo]", "evaluation.suites: expected some of training"),
        ("evaluation.sampler=foo", "sampler"),
        ("evaluation.temperature=1e38", "temperature: expected a number from 0 to 1e+06"),
        ("evaluation.figures=-1", "evaluation.figures: expected 0 or more"),
        ("evaluation.environments=[foo]", "evaluation.environments: expected none"),
    ],
)
def test_options_of_fit(option: str, expected: str, capsys: Told) -> None:
    refused(capsys, [*FIT, f"--{option}"], expected)


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("data.suite=foo", "data.suite: expected one of training, paper"),
        ("data.suite=training", "data.suite: expected a suite that learns concepts"),
        ("data.domain=chess", "domain: expected one of"),
        ("data.domain=agent", "data.domain: expected 'object_rearrangement'"),
        ("data.steps=null", "data.steps"),
        ("data.steps=-1", "data.steps"),
        ("model.pretrained=objectrearrangement", "did you mean object_rearrangement"),
        ("model.pretrained=null", "pretrained"),
        ("model.omega=1e38", "model.omega: expected a number from -1e+06 to 1e+06"),
        ("model.omega=foo", "omega"),
        ("model.weights.initial=1e38", "model.weights.initial"),
        ("model.weights.training=1e38", "model.weights.training"),
        ("model.weights.scale=1e38", "model.weights.scale"),
        ("model.budget.learning_rate=1e38", "model.budget.learning_rate"),
        ("model.weights.learning_rate=-1", "model.weights.learning_rate"),
        ("model.loss.timestep_power=1e9", "model.loss.timestep_power: expected a number from 1 to 100"),
        ("model.loss.kind=foo", "model.loss.kind"),
        ("model.modes.sets=foo", "modes"),
        ("model.budget.tolerance=nan", "tolerance"),
        ("model.adapter.rank=true", "adapter"),
        ("model.components=1.5", "components"),
        (
            "model.budget=null",
            "key 'model.budget': expected some of samples, restarts, screening, learning_rate, tolerance, precision, found null",
        ),
        ("model.budget.samples=null", "key 'model.budget.samples': expected int, found null"),
        ("model.samples=null", "key 'model.budget.samples': expected int, found null"),
        ("model.modes.sets=null", "key 'model.modes.sets': expected a value, found null"),
        ("model.budget.sample=3", "argument 'model.budget.sample' is not accepted"),
        ("model.init_args.budget.sample=3", "argument 'model.budget.sample' is not accepted"),
        ("model.budget={sample: 3}", "key 'sample' is not accepted"),
        ("model.embeddings.off_span=2", "model.embeddings.off_span"),
        ("evaluation.suites=[foo]", "evaluation.suites: expected some of training"),
        ("trainer.max_epochs=0", "trainer.max_epochs"),
    ],
)
def test_options_of_invert(option: str, expected: str, capsys: Told) -> None:
    refused(capsys, [*INVERT, "--data.steps=1", "--trainer.enable_progress_bar=false", f"--{option}"], expected)


@pytest.mark.parametrize("watches", ["ModelCheckpoint", "EarlyStopping"])
def test_a_callback_that_watches_nothing(watches: str, capsys: Told) -> None:
    """The first is told once the model is there: what it waits for might have been logged until then."""
    callback = f"trainer.callbacks=[{{class_path: lightning.pytorch.callbacks.{watches}, init_args: {{monitor: nothing}}}}]"
    assert main([*FIT, "--evaluation.samples=1", f"--{callback}"]) == 2
    (told,) = [row for row in capsys.readouterr().err.splitlines() if row.startswith("error: ")]
    assert "nothing" in told
    assert "train/loss" in told


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["sample", "--pretrained=mocap", "--compose=jumping jakcs:1.2"], "jumping_jacks; jumping_jacks_adapter; "),
        (["sample", "--pretrained=agent", "--compose=go to bowls:1.2"], "are the nearest of 4"),
        (["sample", "--pretrained=mocap", "--compose=jumping jakcs:1.2"], "python -m ftl_lightning concepts"),
        (["sample", "--pretrained=objectrearrangement", "--compose=x"], "did you mean object_rearrangement"),
        ([*SAMPLE, "--compose="], "goal, initial: expected"),
        ([*SAMPLE, f"--compose={PUSH}:1e38"], "weights up to 1e+06"),
        ([*SAMPLE, f"--compose={PUSH}:nan"], "compose: expected"),
        ([*SAMPLE, f"--compose={PUSH}@legs"], "legs"),
        ([*SAMPLE, f"--compose={PUSH}", "--temperature=1e38"], "temperature"),
        ([*SAMPLE, f"--compose={PUSH}", "--temperature=nan"], "temperature"),
        ([*SAMPLE, f"--compose={PUSH}", "--goal=foo"], "goal: expected a task of agent"),
        ([*SAMPLE, f"--compose={PUSH}", "--count=1.5"], "count"),
        ([*SAMPLE, f"--compose={PUSH}", "--execute=foo"], "execute"),
        ([*SAMPLE, f"--compose={PUSH}", "--figure=x.txt"], "figure: expected a name that ends in"),
        ([*SAMPLE, f"--compose={PUSH}", "--animation=x.mp4"], "animation: expected a name that ends in"),
        ([*SAMPLE, f"--compose={PUSH}", "--foo=1"], "foo"),
        (["sample"], "pretrained"),
        (["foo"], "verb: expected one of"),
        (["generate"], "domain"),
        (["generate", "chess"], "domain: expected one of"),
        (["generate", "../../x"], "domain: expected one of"),
        (["generate", "agent", "--task=foo"], "agent task: expected 'go to [red|yellow|purple|green]"),
        (["generate", "agent", "--seed=foo"], "seed"),
        (["concepts", "agnet"], "did you mean agent"),
        (["encode", "agent", "--encoder=/nowhere"], "encoder: expected"),
        (["prepare", "agent"], "domain: expected one whose recordings"),
        (["study", "chess"], "domain: expected one of"),
        (["study-report"], "answers: expected files"),
        (["ablate"], "stages"),
        (["ablate", "--config=conf/ablation/smoke.yaml", "--shard=0/3"], "shard: expected"),
        (["ablate", "--config=conf/ablation/smoke.yaml", "--executor=foo"], "executor"),
        (["ablate", "--config=conf/ablation/smoke.yaml", "--seeds=[]"], "seeds: expected one or more"),
        (["ablate", "--config=conf/ablation/smoke.yaml", "--seeds=[-1]"], "seed"),
        (["test", f"--config={CONF / 'agent.yaml'}"], "ckpt_path"),
        (["fit", "--config="], "expected a configuration file"),
        (["fit", "--config=conf"], "expected a configuration file, found a folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_command_lines(arguments: list[str], expected: str, capsys: Told) -> None:
    refused(capsys, arguments, expected)


def concept(embedding: float = 0.1, weight: float = 1.0, **header: Any) -> None:
    """A file of a concept of the shipped model of navigation."""
    shipped = json.loads((ROOT / "pretrained/agent/config.json").read_text())
    told = {"kind": "concept", "format": 1, "name": PUSH, "domain": "agent", "encoder": shipped["encoder"]}
    told |= {"pretrained": shipped["hash"], "demonstrations": "0" * 16, "count": 5, "weights": "fixed", "loss": 0.1, **header}
    tensors = {"embeddings": torch.full((2, 384), embedding), "weights": torch.full((2,), weight)}
    safetensors.torch.save_file(tensors, "c.safetensors", {"ftl_lightning": json.dumps(told)})


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: concept(embedding=1e38), "expected numbers up to 1e+06, found larger ones in 'embeddings'"),
        (lambda: concept(embedding=-1e38), "'embeddings'"),
        (lambda: concept(weight=1e38), "'weights'"),
        (lambda: concept(loss=None), "key 'loss'"),
        (lambda: concept(domain="chess"), "key 'domain': expected 'agent' (the pretrained model's), found 'chess'"),
        (lambda: concept(domain="../../x"), "key 'domain'"),
        (lambda: concept(encoder="x"), "key 'encoder'"),
        (lambda: concept(pretrained="\x1b[31mred\x07\u202e"), "key 'pretrained'"),
    ],
)
@pytest.mark.parametrize("verb", [["explain"], ["sample", f"--goal={PUSH}"]], ids=lambda value: value[0])
def test_concepts(verb: list[str], make: Callable[[], None], expected: str, capsys: Told) -> None:
    make()
    refused(capsys, [*verb, "--pretrained=agent", "--concept=c.safetensors"], "c.safetensors: ", expected)


@pytest.mark.parametrize("composed", [["--concept=c.safetensors"], ["--compose=merge + c.safetensors"]])
def test_a_concept_of_another_model(composed: list[str], capsys: Told) -> None:
    concept()
    refused(capsys, ["sample", "--pretrained=driving", *composed], "c.safetensors: ", "driving")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoint")
    assert main([*FIT, f"--trainer.logger.init_args.save_dir={folder}", "--evaluation.samples=1"]) == 0
    return folder / "object_rearrangement" / "fit" / "checkpoints" / "last.ckpt"


@pytest.mark.parametrize(
    "version", [None, "foo", 3, "0.1", ["x"], "1.0.0\x1b[31m", "x" * 1000, ""], ids=lambda value: ascii(value)[:20]
)
def test_the_version_of_a_checkpoint(version: object, checkpoint: Path, capsys: Told) -> None:
    content = torch.load(checkpoint, weights_only=True)
    del content["pytorch-lightning_version"]
    torch.save(content | ({} if version is None else {"pytorch-lightning_version": version}), "c.ckpt")
    refused(capsys, [*FIT, "--ckpt_path=c.ckpt"], "c.ckpt: key 'pytorch-lightning_version': expected")


CELLS = ["agent", "paper", "go", "BC", "", "", "method", "1", "1.2", "5", "0", "10", "accuracy", "0.5", "0" * 16, "0" * 16, "1"]


@pytest.mark.parametrize(
    "domain", ["../../x", "/etc/x", "..", ".hidden", "", "a/b", "a\\b", "evil:DOMAIN", "x" * 300, "\x1b[31m", "~"]
)
def test_rows_of_a_domain_that_is_no_folder_s_name(domain: str, capsys: Told) -> None:
    row = dict(zip(COLUMNS, CELLS, strict=True)) | {"domain": domain}
    Path("r.csv").write_text("\n".join((",".join(COLUMNS), ",".join(f'"{cell}"' for cell in row.values()))))
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "r.csv: row 2, column 'domain': expected")


@pytest.mark.parametrize("value", ["null", "None", "", "nan"])
def test_rows_without_a_rate(value: str, capsys: Told) -> None:
    row = dict(zip(COLUMNS, CELLS, strict=True)) | {"value": value}
    Path("r.csv").write_text("\n".join((",".join(COLUMNS), ",".join(row.values()))))
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "r.csv: row 2, column 'value': expected a finite number")


def test_rows_of_a_domain_that_is_not_installed_are_told(capsys: Told) -> None:
    row = dict(zip(COLUMNS, CELLS, strict=True)) | {"domain": "chess"}
    Path("r.csv").write_text("\n".join((",".join(COLUMNS), ",".join(row.values()))))
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    assert "domain 'chess' is not installed" in capsys.readouterr().err


def test_the_training_concepts_of_a_model_are_listed(capsys: Told) -> None:
    assert main(["concepts", "agent"]) == 0
    assert (
        capsys.readouterr().out.splitlines() == json.loads((ROOT / "pretrained/agent/config.json").read_text())["training_concepts"]
    )


def test_demonstrations_that_are_longer_than_plans_are_told(capsys: Told, tiny: Path) -> None:
    from dataclasses import replace

    from ftl_lightning.domains.registry import load_domain

    drawn = load_domain("object_rearrangement").source(None).draw("circle right of square", 5, 0)
    long = replace(drawn, states=torch.cat((drawn.states, drawn.states), dim=1), lengths=2 * drawn.lengths)
    long.save("d.safetensors")
    arguments = [*INVERT[:2], f"--model.pretrained={tiny}", "--data.demonstrations=d.safetensors", "--data.steps=1"]
    assert main([*arguments, "--evaluation.samples=1", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]) == 0
    (told,) = [row for row in capsys.readouterr().err.splitlines() if row.startswith("note: ")]
    assert "2" in told
