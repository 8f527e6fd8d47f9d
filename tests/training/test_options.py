"""Options in groups, and the flat names under which results, checkpoints, models' records and the Python API know them."""

from collections.abc import Mapping, Sequence
from dataclasses import FrozenInstanceError, dataclass, field, fields
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.apps import lightning_cli
from ftl_lightning.apps.lightning_cli import parse
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.settings import (
    GROUPS,
    INVERSION,
    BudgetOptions,
    InversionSettings,
    Loss,
    ModeOptions,
)
from ftl_lightning.methods.ftl_igm import pretraining
from ftl_lightning.methods.ftl_igm.pretraining import PRETRAINING, Codes, PretrainingModule
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.validation import flat, groups_of, replaced
from tests.conftest import CONF, inversion_module

OBJECTS = CONF / "object_rearrangement.yaml"
PRETRAINING_GROUPS: Mapping[str, type] = {"loss": pretraining.LossOptions, "codes": Codes}
OTHER: dict[str, Any] = {"initial_omega": 0.7, "off_span": 0.5, "initial_spread": 0.2, "start": "concepts", "knots": 4}
OTHER |= {"restarts": 2, "screening": 3, "learning_rate": 0.02, "samples": 5, "tolerance": 0.3, "precision": "bf16-mixed"}
OTHER |= {"weight_learning_rate": 0.004, "guidance_scale": 1.5, "training_omega": 0.9, "modes": "each", "mode_samples": 6}
OTHER |= {"adapter": 0, "adapter_learning_rate": 0.01, "adapter_scope": "all", "loss": "v", "timestep_power": 2.0, "discount": 0.5}
"""An allowed value of every option of an inversion that is in a group."""


@dataclass(frozen=True)
class _Size:
    width: int = 1
    depth: int = 2


@dataclass(frozen=True)
class _Settings:
    seed: int = 0
    size: _Size = field(default_factory=_Size)


def of_groups(settings: InversionSettings) -> dict[str, object]:
    return {group: getattr(settings, group) for group in GROUPS}


@pytest.mark.parametrize(("places", "groups"), [(INVERSION, GROUPS), (PRETRAINING, PRETRAINING_GROUPS)], ids=["invert", "fit"])
def test_every_flat_name_is_an_option_of_a_group_and_every_option_has_one(
    places: Mapping[str, str], groups: Mapping[str, type]
) -> None:
    options = {f"{group}.{option.name}" for group, kind in groups.items() for option in fields(kind)}
    assert set(places.values()) == options
    assert len(set(places.values())) == len(places)
    assert set(groups_of(places)) == set(groups)


def test_the_command_line_knows_the_groups_of_both_verbs() -> None:
    assert set(lightning_cli.GROUPS) == GROUPS.keys() | PRETRAINING_GROUPS.keys()


def test_the_groups_are_those_of_the_settings() -> None:
    settings = InversionSettings()
    assert {name: type(value) for name, value in of_groups(settings).items()} == dict(GROUPS)
    assert {one.name for one in fields(settings)} == {*GROUPS, "components", "omega", "seed", "form"}


def test_options_go_from_flat_names_into_groups_and_back() -> None:
    assert OTHER.keys() == INVERSION.keys()
    settings = InversionSettings().changed(**OTHER)
    assert flat(of_groups(settings), INVERSION) == OTHER
    assert settings.budget == BudgetOptions(
        samples=5, restarts=2, screening=3, learning_rate=0.02, tolerance=0.3, precision="bf16-mixed"
    )
    assert settings.modes == ModeOptions(sets="each", samples=6)
    assert settings.loss == Loss(kind="v", timestep_power=2.0, discount=0.5)
    usual = InversionSettings()
    assert usual.changed(**flat(of_groups(usual), INVERSION)) == usual
    assert all(value != flat(of_groups(usual), INVERSION)[name] for name, value in OTHER.items() if name != "adapter")


def test_some_options_are_replaced_and_the_others_of_their_group_stay() -> None:
    places = {"width": "size.width", "layers": "size.depth"}
    settings = _Settings(seed=3, size=_Size(5, 7))
    assert replaced(settings, {}, places) == settings
    assert replaced(settings, {"layers": 9}, places) == _Settings(3, _Size(5, 9))
    assert replaced(settings, {"layers": 9, "width": 8, "seed": 4}, places) == _Settings(4, _Size(8, 9))
    assert replaced(settings, {"size": _Size(1, 1)}, places) == _Settings(3, _Size(1, 1))
    assert settings == _Settings(3, _Size(5, 7))
    with pytest.raises(TypeError, match="depth"):
        replaced(settings, {"depth": 9}, places)  # no flat name
    with pytest.raises(FrozenInstanceError):
        settings.seed = 1  # type: ignore[misc]


def test_hyper_parameters_are_flat_under_the_names_that_results_know(tiny: Path) -> None:
    options = {**OTHER, "off_span": 0.5, "knots": 1}
    module = inversion_module(tiny, **options, components=3, seed=2)
    assert {name: module.hparams[name] for name in INVERSION} == options
    assert set(module.hparams) == {*INVERSION, "pretrained", "components", "omega", "output", "seed", "form"}
    fit = PretrainingModule(loss=pretraining.LossOptions(kind="v", discount=0.9), codes=Codes(share=0.5, knots=2))
    found = {"loss": "v", "timestep_power": 1.0, "loss_discount": 0.9, "condition_dropout": 0.1}
    found |= {"code_share": 0.5, "code_knots": 2, "code_size": 16, "code_noise": 0.3, "code_relative": True}
    assert {name: fit.hparams[name] for name in PRETRAINING} == found
    assert not {"codes", "budget"} & fit.hparams.keys()


@pytest.mark.parametrize(
    "null",
    [
        ["--model.budget.tolerance", "null", "--model.weights.training=null"],
        ["--model.init_args.budget.tolerance=null", "--model.init_args.weights.training", "null"],
    ],
    ids=str,
)
def test_null_in_a_group_is_null_and_the_rest_of_the_group_stays(null: Sequence[str]) -> None:
    options = ["--model.budget.tolerance=0.1", "--model.budget.samples=7", "--model.weights={training: 0.9, initial: 0.7}"]
    found = parse("invert", [f"--config={OBJECTS}", *options, *null])["model"]["init_args"]
    assert (found["budget"]["samples"], found["budget"]["tolerance"]) == (7, None)
    assert (found["weights"]["initial"], found["weights"]["training"]) == (0.7, None)


def test_null_of_an_option_that_is_in_no_group_leaves_the_others_beside_it() -> None:
    found = parse("fit", [f"--config={OBJECTS}", "--model.denoiser_args.dropout=null"])["model"]["init_args"]["denoiser_args"]
    assert "hidden_dim" in found


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("{budget: {samples: 0}}", r"own\.yaml: model\.budget\.samples: expected 1 or more, found 0"),
        ("{budget: {sample: 3}}", r"own\.yaml: key 'model\.budget\.sample': expected one of samples, .*, found another key"),
        ("{budget: 3}", r"own\.yaml: key 'model\.budget': expected a mapping, found 3"),
        ("{loss: {kind: 3}}", r"own\.yaml: key 'model\.loss\.kind': expected a text, found 3"),
    ],
)
def test_a_mistake_in_the_settings_of_a_learner_is_one_line(options: str, told: str) -> None:
    Path("own.yaml").write_text(f"model: {{init_args: {options}}}\n")
    with pytest.raises(UserError, match=told):
        ModelSettings.read("own.yaml")


def test_what_is_no_group_is_told_in_one_line() -> None:
    with pytest.raises(UserError, match=r"^model\.loss: expected a group of options with 'condition_dropout', found 'v'$"):
        PretrainingModule(loss="v")
