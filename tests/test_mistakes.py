"""Mistakes with options, numbers and names: one line that names the key, exit code 2, and nothing is left behind.

The tables ask whatever refuses: the parser of a verb, a constructor, or what a trainer calls before the first step. A few cases of
each verb go through the program, which shows that the verb asks.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import safetensors.torch
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.demos.boring_classes import BoringModel

from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.igm import settings
from ftl_lightning.igm.concept import VERSION
from ftl_lightning.methods.ftl_igm.pretraining import Codes, LossOptions, PretrainingModule
from ftl_lightning.methods.pretraining import CloningPretraining, VAEPretraining
from ftl_lightning.services.errors import LONGEST, Note, UserError
from ftl_lightning.training.checkpoint import WholeCheckpoints
from ftl_lightning.training.data import InversionData, PretrainingData
from ftl_lightning.training.inversion_module import InversionModule
from ftl_lightning.training.trainer import Trainer

from .conftest import CONF, ROOT, TINY, refused
from .test_parse_error import line_of

Told = pytest.CaptureFixture[str]
FILE = f"--config={CONF / 'object_rearrangement.yaml'}"
FIT = ["fit", FILE, *TINY, "--trainer.max_steps=2"]
INVERT = ["invert", FILE, "--model.pretrained=object_rearrangement", "--data.steps=1", "--trainer.enable_progress_bar=false"]
CHECKPOINT = "trainer.callbacks=[{class_path: lightning.pytorch.callbacks.ModelCheckpoint, init_args: {%s}}]"
SCENES = ["sample", "--pretrained=object_rearrangement"]
RIGHT = "--compose=circle right of square"
PUSH = "go to red object"
SAMPLE = ["sample", "--pretrained=agent"]
SMOKE = ["ablate", "--config=conf/ablation/smoke.yaml"]
SHIPPED = ROOT / "pretrained" / "object_rearrangement"
NO_CONCEPT = "no.safetensors: expected a concept file, found nothing"
TABLE = "out: expected a name that ends in .safetensors"


@contextmanager
def refusal(*expected: str) -> Iterator[pytest.ExceptionInfo[UserError]]:
    """Expect one short line that says something."""
    with pytest.raises(UserError) as error:
        yield error
    told = str(error.value)
    assert "\n" not in told
    assert len(told) <= LONGEST
    for text in expected:
        assert text in told


# What the parser of a verb refuses

CLASSES = {
    "fit": [
        "--model=ftl_lightning.methods.ftl_igm.pretraining.PretrainingModule",
        "--data=ftl_lightning.training.data.PretrainingData",
        "--data.domain=object_rearrangement",
    ],
    "invert": [
        "--model=ftl_lightning.training.inversion_module.InversionModule",
        "--model.pretrained=object_rearrangement",
        "--data=ftl_lightning.training.data.InversionData",
        "--data.domain=object_rearrangement",
    ],
}
"""Options that a verb needs, without a configuration file, which takes longer to read than to refuse an option."""
MODEL = ("learning_rate", "weight_decay", "ema_decay", "loss.condition_dropout", "seed", "loss", "codes")
MODEL += ("loss.timestep_power", "guidance", "loss.discount", "diffusion_steps")
DATA = ("batch_size", "samples_per_concept", "steps_per_epoch", "encoder", "seed")
BUDGET = "key 'model.budget': expected some of samples, restarts, screening, learning_rate, tolerance, precision, found null"


@pytest.mark.parametrize(
    ("verb", "option", "expected"),
    [
        *(("fit", f"model.{key}=null", f"model.{key}") for key in MODEL),
        *(("fit", f"data.{key}=null", f"data.{key}") for key in DATA),
        *(("fit", f"trainer.{key}=foo", f"trainer.{key}") for key in ("precision", "callbacks")),
        ("fit", "trainer.max_steps=many", "key 'trainer.max_steps': expected int, found many"),
        ("fit", CHECKPOINT % "train_time_interval: foo", "train_time_interval"),
        ("fit", "seed_everything=foo", "seed_everything"),
        *(("fit", f"seed_everything={seed}", "seed_everything: expected a number from 0") for seed in (-1, 99999999999)),
        ("fit", "model.feature_dropout={traffic: null}", "feature_dropout"),
        ("fit", "model.learning_rate=nan", "learning_rate"),
        *(("fit", f"model.{key}=1", f"argument '{key}' is not accepted") for key in ("foo", "depht")),
        ("fit", "data.balance=nan", "balance"),
        *(("invert", f"{key}=null", key.rpartition(".")[2]) for key in ("data.steps", "model.pretrained")),
        ("invert", "model.omega=foo", "omega"),
        *(("invert", f"model.modes.sets={text}", "modes") for text in ("foo", "some")),
        *(("invert", f"model.budget.tolerance={text}", "tolerance") for text in ("nan", "much")),
        ("invert", "model.adapter.rank=true", "adapter"),
        ("invert", "model.components=1.5", "components"),
        ("invert", "model.budget=null", BUDGET),
        ("invert", "model.budget.samples=null", "key 'model.budget.samples': expected int"),
        ("invert", "model.samples=3", "argument 'samples' is not accepted"),
        ("fit", "model.condition_dropout=0.25", "argument 'condition_dropout' is not accepted"),
        ("invert", "model.modes.sets=null", "key 'model.modes.sets': expected a value, found null"),
        *(("invert", f"model.{at}budget.sample=3", "argument 'model.budget.sample' is not accepted") for at in ("", "init_args.")),
        ("invert", "model.budget={sample: 3}", "key 'sample' is not accepted"),
    ],
)
def test_options_that_a_parser_refuses(verb: str, option: str, expected: str) -> None:
    assert expected in line_of(verb, *CLASSES[verb], f"--{option}")


# What a trainer, a model and data refuse


def a_trainer(**options: Any) -> Trainer:
    return Trainer(**{"accelerator": "cpu", "logger": False, "enable_progress_bar": False} | options)


def scenes(**options: Any) -> PretrainingData:
    return PretrainingData(**{"domain": "object_rearrangement"} | options)


def drawn(**options: Any) -> InversionData:
    return InversionData(**{"domain": "object_rearrangement"} | options)


SHARE = "trainer.{}: expected a share from 0 to 1 or a whole number of "
INITIAL = "denoiser_args.initial_encoder: expected one of flat, joint, entities, set"
OUT_OF_RANGE: Sequence[tuple[Callable[..., object], str, Mapping[str, Sequence[object]]]] = [
    (a_trainer, "trainer: You selected an invalid {} name: `{}='foo'`", {"accelerator": ["foo"]}),
    (a_trainer, "trainer: ", {"max_time": ["foo"]} | ({} if torch.cuda.is_available() else {"accelerator": ["cuda"]})),
    (a_trainer, "foo", {"strategy": ["foo"], "gradient_clip_algorithm": ["foo"]}),
    (a_trainer, "{}", {"devices": ["0", 0, -3], "profiler": ["foo"]}),
    (a_trainer, "trainer.{}: expected a number from 1 to ", {"devices": [1000], "num_nodes": [0]}),
    (a_trainer, "trainer.{}: expected -1 or more", {"max_steps": [-5], "max_epochs": [-5], "num_sanity_val_steps": [-2]}),
    (a_trainer, "trainer.{}: expected 0 or more", {"min_steps": [-1], "log_every_n_steps": [-1], "gradient_clip_val": [-1]}),
    (a_trainer, "trainer.{}: expected 1 or more", {"check_val_every_n_epoch": [0, -1], "accumulate_grad_batches": [0]}),
    (a_trainer, SHARE, {"limit_train_batches": [-1], "limit_val_batches": [-1, 7.5], "val_check_interval": [-1]}),
    (a_trainer, "trainer.{}: expected more than 0", {"val_check_interval": [0]}),
    (PretrainingModule, "model.{}: expected 0 or more, found -1", {"seed": [-1], "warmup_steps": [-1]}),
    (PretrainingModule, "model.{}: expected a number from 0 to 1e+30", {"learning_rate": [-1, nan, 1e38]}),
    (PretrainingModule, "model.{}: expected a number from 0 to 1", {"weight_decay": [-1], "ema_decay": [5]}),
    (PretrainingModule, "model.{}: expected a finite number", {"guidance": [inf]}),
    (PretrainingModule, "model.{}: expected a number from -1e+06 to 1e+06", {"guidance": [1e38]}),
    (PretrainingModule, "model.{}: expected 1 or more", {"diffusion_steps": [0]}),
    (LossOptions, "model.loss.{}: expected a number from 0 to 1", {"condition_dropout": [2]}),
    (LossOptions, "model.loss.{}: expected a number from 1 to 100", {"timestep_power": [1e9]}),
    (LossOptions, "model.loss.{}: expected one of epsilon, v, clean, found 'foo'", {"kind": ["foo"]}),
    (Codes, "model.codes.{}: expected 1 or more", {"knots": [0]}),
    (CloningPretraining, "model.{}: expected 1 or more, found 0", {"hidden_dim": [0], "plan_horizon": [0]}),
    (VAEPretraining, "model.{}: expected 1 or more, found 0", {"hidden_dim": [0], "latent_dim": [0]}),
    (settings.InversionSettings, "model.{}: expected a number from -1e+06 to 1e+06", {"omega": [1e38]}),
    (settings.InversionSettings, "model.{}: expected ", {"omega": [nan], "seed": [-1]}),
    (settings.WeightOptions, "model.weights.{}: expected ", {"initial": [1e38, nan], "training": [1e38, nan], "scale": [1e38]}),
    (settings.WeightOptions, "model.weights.{}: expected ", {"learning_rate": [-1, inf]}),
    (settings.BudgetOptions, "model.budget.{}: expected ", {"learning_rate": [1e38, -1]}),
    (settings.BudgetOptions, "model.budget.{}: expected 1 or more", {"restarts": [0]}),
    (settings.BudgetOptions, "model.budget.{}: expected null or a share from 0 up to 1, found 1.0", {"tolerance": [1.0]}),
    (settings.AdapterOptions, "model.adapter.{}: expected ", {"learning_rate": [-1]}),
    (settings.EmbeddingOptions, "model.embeddings.{}: expected ", {"initial_spread": [-1], "off_span": [2]}),
    (settings.ModeOptions, "model.modes.{}: expected 1 or more, 'each' or 'auto', found 0", {"sets": [0]}),
    (settings.Loss, "model.loss.{}: expected 1 or more", {"timestep_power": [0.5]}),
    (settings.Loss, "model.loss.{}: expected a number from 1 to 100", {"timestep_power": [1e9]}),
    (settings.Loss, "model.loss.{}: expected one of epsilon, v, clean, found 'foo'", {"kind": ["foo"]}),
    (scenes, "domain", {"domain": ["chess", "../../x"]}),
    (scenes, "data.{}: expected a number from 1", {"start_exponent": [1e38]}),
    (scenes, "data.{}: expected 0 or more", {"seed": [-1]}),
    (drawn, "data.{}: expected one of training, paper", {"suite": ["foo"]}),
    (drawn, "data.{}: expected a suite that learns concepts", {"suite": ["training"]}),
    (drawn, "{}: expected one of", {"domain": ["chess"]}),
    (drawn, "data.{}: expected 1 or more", {"steps": [0, -1], "demonstrations_per_concept": [0]}),
    (drawn, "data.{}: expected 0 or more", {"seed": [-1]}),
    (Evaluator, "evaluation.{}: expected one of ddpm, ddim, dpm_solver, found 'foo'", {"sampler": ["foo"]}),
    (Evaluator, "evaluation.{}: expected a number from 0 to 1e+06", {"temperature": [1e38]}),
    (Evaluator, "evaluation.{}: expected 0 or more", {"figures": [-1], "seed": [-1]}),
]
"""What makes something of options, what it says with the option's name in it, and the values that it refuses."""


@pytest.mark.parametrize(
    ("make", "option", "value", "expected"),
    [
        (make, name, value, expected.replace("{}", name))
        for make, expected, options in OUT_OF_RANGE
        for name, values in options.items()
        for value in values
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_options_out_of_their_ranges(make: Callable[..., object], option: str, value: object, expected: str) -> None:
    with refusal(expected):
        make(**{option: value})


def test_options_with_which_a_trainer_learns_nothing() -> None:
    for option, value, expected in (
        ("max_steps", 0, "trainer.max_steps: expected 1 or more"),
        ("max_epochs", 0, "trainer.max_epochs: expected 1 or more"),
        ("limit_train_batches", 0, "trainer.limit_train_batches: expected more than 0"),
        ("val_check_interval", 1_000_000, "trainer: `val_check_interval` (1000000) must be less than or equal to the number of"),
    ):
        with refusal(expected):
            a_trainer(**{"max_epochs": 1} | {option: value}).fit(BoringModel())


class _Logging(BoringModel):
    def training_step(self, batch: torch.Tensor, batch_idx: int) -> Any:
        found = super().training_step(batch, batch_idx)
        self.log("train/loss", found["loss"])
        return found


@pytest.mark.parametrize("watches", [ModelCheckpoint, EarlyStopping])
def test_a_callback_that_watches_nothing(watches: type[pl.Callback]) -> None:
    """The first is refused once the model is there: what it waits for might have been logged until then."""
    with refusal("nothing", "train/loss"):
        a_trainer(max_steps=2, callbacks=[watches(monitor="nothing")]).fit(_Logging())


def test_options_that_a_callback_refuses() -> None:
    """With the kinds of exceptions that the program turns into a line."""
    for callback, options, expected in (
        *((ModelCheckpoint, {name: -2}, name) for name in ("every_n_train_steps", "every_n_epochs", "save_top_k")),
        (ModelCheckpoint, {"save_top_k": 5}, "No quantity for top_k to track"),
        (ModelCheckpoint, {"mode": "foo"}, "mode"),
        (EarlyStopping, {"monitor": "val/loss", "mode": "foo"}, "mode"),
    ):
        with pytest.raises((ValueError, MisconfigurationException), match=expected):
            callback(**options)


def begun(module: pl.LightningModule, data: pl.LightningDataModule) -> None:
    """What a trainer does before the first step: the module is built for the data."""
    module.trainer = SimpleNamespace(datamodule=data, max_steps=1, log_dir=".", default_root_dir=".", loggers=[])
    module.configure_model()


@pytest.fixture(scope="module")
def few_scenes() -> PretrainingData:
    data = scenes(samples_per_concept=2, validation_per_concept=1)
    data.setup("fit")
    return data


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"feature_dropout": {"x": 0.5}}, "model.feature_dropout: expected nothing"),
        ({"prediction": "foo"}, "prediction: expected one of epsilon"),
        ({"view": "foo"}, "model.view: expected one of"),
        ({"denoiser": "foo"}, "denoiser: expected one of MLPDenoiser, TemporalUNet"),
        ({"codes": Codes(share=1)}, "model.codes.knots: expected 1 for MLPDenoiser"),
        ({"denoiser_args": {"initial_encoder": "foo"}}, INITIAL),
        ({"denoiser_args": {"initial_encoder": "os.system"}}, INITIAL),
        ({"denoiser_args": {"foo": 1}}, "key 'denoiser_args.foo': expected one of hidden_dim, depth"),
        *(
            ({"denoiser_args": {name: value}}, f"denoiser_args.{name}")
            for name, value in (("depth", None), ("depth", 0), ("hidden_dim", 0), ("condition_dim", -1), ("dropout", 2))
        ),
    ],
    ids=str,
)
def test_networks_that_are_not_built(options: dict[str, Any], expected: str, few_scenes: PretrainingData) -> None:
    small = {"hidden_dim": 8, "depth": 1, "condition_dim": 8} | options.get("denoiser_args", {})
    with refusal(expected):
        begun(PretrainingModule(**options | {"denoiser_args": small}), few_scenes)


def test_what_the_pretrained_model_or_its_domain_does_not_have() -> None:
    model = InversionModule("object_rearrangement")
    for options, expected in (
        ({"suites": ["foo"]}, "evaluation.suites: expected some of training"),
        ({"steps": 1000}, "evaluation.steps: expected 1 to 100"),
        ({"environments": ["foo"]}, "evaluation.environments: expected none"),
    ):
        with refusal(expected):
            Evaluator(**options).on_fit_start(SimpleNamespace(datamodule=None), model)
    with refusal("data.domain: expected 'object_rearrangement' (the pretrained model's), found 'agent'"):
        begun(model, InversionData("agent"))


def test_demonstrations_that_do_not_fit(capsys: Told) -> None:
    for file, columns, domain in (("other", 21, "driving"), ("size", 20, "object_rearrangement")):
        names, states, lengths = tuple(map(str, range(columns))), torch.zeros(2, 1, columns), torch.full((2,), 1)
        Demonstrations(states, lengths, domain, names, names, ("task",) * 2).save(f"{file}.safetensors")
    Path("cut.safetensors").write_bytes(Path("size.safetensors").read_bytes()[:100])
    np.savez("nan.npz", states=np.full((1, 1, 21), np.nan))
    np.savez("none.npz", states=np.zeros((0, 1, 21)))
    np.savez("keys.npz", state=np.zeros((1, 1, 21)))
    Path("empty.npz").touch()
    np.save("array.npy", np.zeros((1, 1, 21)))
    Path("array.npy").rename("array.npz")
    for file, expected in {
        "missing.safetensors": "found nothing",
        "other.safetensors": "expected behaviour of object_rearrangement, the model's domain, found that of driving",
        "size.safetensors": "key 'states': expected states of 21 columns (object_rearrangement), found 20",
        "cut.safetensors": "damaged or foreign",
        "nan.npz": "expected finite numbers, found nan",
        "none.npz": "expected at least one demonstration, time and column, found none",
        "keys.npz": "key 'states': expected (demo, time, state)",
        "empty.npz": "damaged",
        "array.npz": "damaged",
    }.items():
        with refusal(file, expected):
            InversionData("object_rearrangement", demonstrations=file)
    refused(capsys, [*INVERT, "--data.demonstrations=cut.safetensors"], "cut.safetensors", "damaged or foreign")


def test_the_version_of_a_checkpoint(capsys: Told) -> None:
    expected = "c.ckpt: key 'pytorch-lightning_version': expected"
    versions = [{"pytorch-lightning_version": it} for it in ("foo", 3, "0.1", ["x"], "1.0.0\x1b[31m", "x" * 1000, "")]
    for version in (*versions, dict[str, object]()):
        torch.save({"state_dict": {}, "epoch": 0, "global_step": 0, "loops": {}} | version, "c.ckpt")
        with refusal(expected):
            WholeCheckpoints().load_checkpoint("c.ckpt")
    refused(capsys, [*FIT, "--ckpt_path=c.ckpt"], expected)


# Through the program


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([*FIT, "--trainer.max_steps=many"], "key 'trainer.max_steps': expected int, found many"),
        (["fit", "--trainer.max_steps=1"], "config: expected --config FILE"),
        ([*FIT, "--trainer.max_step=1"], "max_step=1; see --help; did you mean --trainer.max_steps?"),
        ([*SCENES, "--cuont=1"], "unrecognized arguments: --cuont=1; see --help; did you mean --count?"),
        (["chekc", "five.npz"], "found 'chekc'; did you mean check?"),
        (["concepts", "object_rearrangement", "--fold=x"], "unrecognized arguments: --fold=x"),
        (["generate", "tabletop", "--out=z.mat"], "z.mat: expected the name of an .npz or .safetensors file"),
        ([*SCENES, RIGHT, "--out=z.mat"], "z.mat: expected the name of an .npz or .safetensors file"),
        (
            [*SCENES, RIGHT, f"--initial={ROOT / 'README.md'}"],
            "initial: expected no file, as models of object_rearrangement observe no",
        ),
        (["invert", "five.npz"], "expected a model, then a file of demonstrations"),
        ([*FIT, "--trainer.max_steps=-5"], "trainer.max_steps: expected -1 or more"),
        ([*FIT, f"--{CHECKPOINT % 'every_n_train_steps: -1'}"], "configuration: Invalid value for every_n_train_steps=-1"),
        ([*FIT, "--model.seed=1"], "model.seed: expected 0 (data.seed), found 1"),
        ([*FIT, "--model.denoiser_args={width: 3}"], "key 'denoiser_args.width': expected one of hidden_dim"),
        ([*FIT, "--trainer.limit_train_batches=0.0001"], "trainer: You requested to check 0.0001 of the `train_dataloader`"),
        pytest.param([*FIT, "--data.encoder=no/such/model"], "encoder: expected a folder", marks=pytest.mark.slow),
        (["fit", FILE, "--ckpt_path=no.ckpt"], "ckpt_path: no.ckpt: expected a checkpoint file, found nothing"),
        ([*INVERT, "--model.omega=foo"], "omega"),
        ([*INVERT, "--model.budget.restarts=0"], "model.budget.restarts: expected 1 or more"),
        ([*INVERT, "--evaluation.suites=[trainig]"], "evaluation.suites: expected some of training"),
        ([*INVERT, "--trainer.logger.init_args.save_dir=/proc/logs"], "choose a writable place"),
        ([*INVERT, "--model.pretrained=objectrearrangement"], "did you mean object_rearrangement"),
        ([*INVERT, "--model.pretrained=nowhere"], "nowhere/config.json: expected a pretrained model"),
        ([*INVERT, "--data.demonstrations", "no.npz"], "no.npz: expected a demonstrations file, found nothing"),
        (["test", f"--config={CONF / 'agent.yaml'}"], "ckpt_path: test expected a checkpoint"),
        (["validate", FILE, *TINY], "ckpt_path: validate expected a checkpoint"),
        (["fit", "--config="], "expected a configuration file"),
        (["fit", "--config=conf"], "conf: expected a configuration file, found a folder"),
        (["fit", "--config", "nothing.yaml"], "nothing.yaml: expected a configuration file, found nothing"),
        (["fit", "--config", "conf/nothing.yaml"], "conf/nothing.yaml: expected a configuration file, found nothing; conf holds"),
        (["foo"], "verb: expected one of fit, invert"),
        ([*SCENES, "--compose=circle left of square:1"], "concept 'circle left of square': expected a training concept"),
        *(([*SCENES, f"{RIGHT}:{weight}"], "expected 'concept:weight") for weight in ("heavy", "")),
        ([*SCENES, f"{RIGHT}:1e38"], "weights up to 1e+06"),
        ([*SCENES, f"{RIGHT}:nan"], "compose: expected"),
        (SCENES, "expected a learned concept, training concepts or both"),
        ([*SCENES, RIGHT, "--steps=1000"], "steps: expected 1 to 100"),
        ([*SCENES, RIGHT, "--count=0"], "count: expected 1 or more"),
        ([*SCENES, RIGHT, "--temperature=-1"], "temperature: expected 0 or more"),
        *(([*SCENES, RIGHT, f"--temperature={number}"], "temperature") for number in ("1e38", "nan")),
        *(([*SCENES, RIGHT, f"--{option}=1.5"], option) for option in ("count", "execute", "foo")),
        ([*SCENES, RIGHT, "--goal=chaos"], "goal: expected a task"),
        ([*SCENES, RIGHT, "--figure=a.foo"], "figure: expected a name that ends in"),
        ([*SCENES, RIGHT, "--animation=x.mp4"], "animation: expected a name that ends in"),
        *(([*SCENES, one], NO_CONCEPT) for one in ("--concept=no.safetensors", f"{RIGHT} + no.safetensors:1")),
        ([*SCENES, f"--concept={SHIPPED / 'model.safetensors'}"], "expected a concept file, found a generative model file"),
        (["sample", "--pretrained=mocap", "--compose=jumping jakcs:1.2"], "jumping_jacks; jumping_jacks_adapter; "),
        ([*SAMPLE, "--compose=go to bowls:1.2"], "are the nearest of 4"),
        (["sample", "--pretrained=mocap", "--compose=jumping jakcs:1.2"], "python -m ftl_lightning concepts"),
        ([*SAMPLE, "--compose="], "goal, initial: expected"),
        ([*SAMPLE, f"--compose={PUSH}@legs"], "legs"),
        ([*SAMPLE, f"--compose={PUSH}", "--goal=foo"], "goal: expected a task of agent"),
        (["sample", "--pretrained=objectrearrangement", "--compose=x"], "did you mean object_rearrangement"),
        (["sample", "--pretrained=nowhere"], "nowhere/config.json: expected a pretrained model"),
        (["explain", "--concept", "no.safetensors"], NO_CONCEPT),
        *((["generate", domain], "domain: expected one of") for domain in ("chess", "../../x")),
        (["study", "chess"], "domain: expected one of"),
        (["generate", "object_rearrangement", "--task=circle on square"], "expected 'A <relation> B'"),
        (["generate", "object_rearrangement", "--task=circle above squaretriangle above square"], "found 'triangle above square'"),
        (["generate", "object_rearrangement", "--seed=-1"], "0 or more"),
        (["generate", "object_rearrangement", "--count=0"], "count: expected 1 or more"),
        (["generate", "object_rearrangement", "--count=5", "--out=/proc/d.safetensors"], "cannot be written"),
        (["generate", "agent", "--task=foo"], "agent task: expected 'go to [red|yellow|purple|green]"),
        (["generate", "agent", "--seed=foo"], "seed"),
        (["concepts", "agnet"], "did you mean agent"),
        (["encode", "agent", "--encoder=/nowhere"], "encoder: expected"),
        (["encode", "agent", "--encoder=hashing", "--out=x.npz"], f"{TABLE}, which is what is written, found x.npz"),
        (["prepare", "agent"], "domain: expected one whose recordings"),
        (["report", "--results=nothing"], "expected"),
        (["study-report"], "answers: expected files"),
        (["ablate"], "stages"),
        (["ablate", "--stages=[]"], "results"),
        ([*SMOKE, "--shard=0/3"], "shard: expected"),
        ([*SMOKE, "--executor=foo"], "executor"),
        ([*SMOKE, "--seeds=[]"], "seeds: expected one or more"),
    ],
    ids=lambda value: " ".join(value)[-80:] if isinstance(value, list) else "",
)
def test_command_lines(arguments: list[str], expected: str, capsys: Told) -> None:
    refused(capsys, arguments, expected, longest=400)  # some name whatever is there


def test_a_stage_that_cannot_run_with_a_seed(capsys: Told) -> None:
    stage = f"{{verb: fit, config: '{CONF / 'agent.yaml'}', options: {{seed_everything: '{{seed}}'}}}}"
    Path("ablation.yaml").write_text(f"stages: [{stage}]\nresults: r.csv\n")
    refused(capsys, ["ablate", "--config", "ablation.yaml", "--seeds=[-1]"], "seed")


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["generate", "object_rearrangement", "--count=1000000000", "--out=pipe.safetensors"], "out"),
        *(([*SCENES, f"--{key}=pipe.safetensors"], key) for key in ("out", "figure")),
        ([*SCENES, "--animation", "link"], "animation"),
        (["sample", "--pretrained=mocap", "--export=pipe.safetensors"], "export"),
        (["encode", "object_rearrangement", "--out=folder"], "out"),
        (["report", "--out=pipe.safetensors"], "out"),
        (["fit", FILE, "--model.output=pipe.safetensors"], "model.output"),
        (["test", FILE, "--evaluation.results=link"], "evaluation.results"),
        (["invert", FILE, "--evaluation.results=folder"], "evaluation.results"),
    ],
)
def test_outputs_that_are_no_files_are_refused_before_any_work(arguments: list[str], key: str, capsys: Told) -> None:
    os.mkfifo("pipe.safetensors")
    Path("folder").mkdir()
    Path("link").symlink_to("pipe.safetensors")
    told = refused(capsys, arguments, f"error: {key}: ", "or nothing there, found a ")
    assert told.count("\n") == 1
    assert Path("pipe.safetensors").is_fifo()


# Concepts


def concept(embedding: float = 0.1, weight: float = 1.0, **header: Any) -> None:
    """A file of a concept of the shipped model of scenes."""
    shipped = json.loads((SHIPPED / "config.json").read_text())
    told = {"kind": "concept", "format": VERSION, "name": "circle", "domain": "object_rearrangement", "encoder": shipped["encoder"]}
    told |= {"pretrained": shipped["hash"], "demonstrations": "0" * 16, "count": 5, "weights": "fixed", "loss": 0.1, **header}
    tensors = {"embeddings": torch.full((2, 1, 384), embedding), "weights": torch.full((2,), weight)}
    safetensors.torch.save_file(tensors, "c.safetensors", {"ftl_lightning": json.dumps(told)})


@pytest.mark.parametrize(
    ("verb", "changes", "expected"),
    [
        ("explain", {"embedding": 1e38}, "expected numbers up to 1e+06, found larger ones in 'embeddings'"),
        ("sample", {"embedding": 1e38}, "expected numbers up to 1e+06, found larger ones in 'embeddings'"),
        ("explain", {"embedding": -1e38}, "'embeddings'"),
        ("explain", {"weight": 1e38}, "'weights'"),
        ("explain", {"loss": None}, "key 'loss'"),
        ("explain", {"domain": "chess"}, "key 'domain': expected 'object_rearrangement' (the pretrained model's), found 'chess'"),
        ("explain", {"domain": "../../x"}, "key 'domain': expected"),
        ("sample", {"domain": "other"}, "key 'domain': expected 'object_rearrangement' (the pretrained model's), found 'other'"),
        ("explain", {"encoder": "other"}, "(the pretrained model's), found 'other'"),
        ("sample", {"encoder": "other"}, "key 'encoder': expected"),
        ("explain", {"pretrained": "\x1b[31mred\x07\u202e"}, "key 'pretrained': expected"),
        ("sample", {"pretrained": "other"}, "key 'pretrained': expected"),
    ],
    ids=ascii,
)
def test_concepts(verb: str, changes: dict[str, Any], expected: str, capsys: Told) -> None:
    concept(**changes)
    refused(capsys, [verb, "--pretrained=object_rearrangement", "--concept=c.safetensors"], "c.safetensors: ", expected)


@pytest.mark.parametrize("composed", [["--concept=c.safetensors"], ["--compose=merge + c.safetensors"]])
def test_a_concept_of_another_model(composed: list[str], capsys: Told) -> None:
    concept()
    refused(capsys, ["sample", "--pretrained=driving", *composed], "c.safetensors: ", "driving")


def test_the_training_concepts_of_a_model_are_listed(capsys: Told) -> None:
    assert main(["concepts", "agent"]) == 0
    known = json.loads((ROOT / "pretrained/agent/config.json").read_text())["training_concepts"]
    assert capsys.readouterr().out.splitlines() == known


def test_demonstrations_that_are_longer_than_plans_are_told(tiny_of: Callable[[str], Path]) -> None:
    drawn = load_domain("object_rearrangement").source(None).draw("circle right of square", 5, 0)
    long = replace(drawn, states=torch.cat((drawn.states, drawn.states), dim=1), lengths=2 * drawn.lengths)
    long.save("d.safetensors")
    model = InversionModule(str(tiny_of("object_rearrangement")), form="paper")
    with pytest.warns(Note, match="demonstrations of 2 steps"):
        begun(model, InversionData("object_rearrangement", demonstrations="d.safetensors"))
