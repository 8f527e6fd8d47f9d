from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.evaluation.references import FRESH, REPLAYED
from ftl_lightning.evaluation.results import configuration, read_rows
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms.leave_one_out import quickly
from ftl_lightning.igm.forms.modes import explained
from ftl_lightning.igm.inversion import Inversion, invert
from ftl_lightning.igm.settings import EXPLAINED, InversionSettings
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import file_hash
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.inversion_module import InversionModule
from ftl_lightning.training.model_folder import load_model, read_model
from ftl_lightning.training.trainer import Trainer
from tests.conftest import CONF, ROOT, inversion_module, succeed

SCREENED = {"start": "concepts", "restarts": 3, "screening": 2}
"""Three starts, each at another training concept, of which one goes on after two steps."""


def validation(steps: int = 6) -> InversionData:
    return InversionData("object_rearrangement", suite="validation", steps=steps)


def learn(tiny: Path, data: InversionData | None = None, **options: Any) -> InversionModule:
    """What a trainer makes of some demonstrations, else of those of fourteen concepts in six steps."""
    module, off = inversion_module(tiny, samples=8, **options), ("logger", "enable_checkpointing", "enable_progress_bar")
    quiet: dict[str, Any] = dict.fromkeys((*off, "enable_model_summary"), False)
    trainer = Trainer(max_epochs=1, accelerator="cpu", check_val_every_n_epoch=2, log_every_n_steps=1, **quiet)
    trainer.fit(module, datamodule=data or validation())
    return module


def test_the_only_parameters_are_embeddings_and_weights_and_each_gets_a_gradient(tiny: Path) -> None:
    before = file_hash(tiny / "model.safetensors")
    for omega, names in (("learned", {"embeddings", "weights"}), (1.2, {"embeddings"})):
        module = learn(tiny, omega=omega, components=3)
        trainable = {name: parameter for name, parameter in module.named_parameters() if parameter.requires_grad}
        assert set(trainable) == {f"inversion.{name}" for name in names}
        for parameter in trainable.values():
            assert (parameter.grad.abs().flatten(2 if parameter.dim() == 3 else 1).amax(dim=-1) > 0).all()
        assert module.model.hash == before  # not one bit of the pretrained model has changed
        assert (module.inversion.weights == 1.2).all() or omega == "learned"


def test_learning_lowers_the_loss(tiny: Path) -> None:
    short, long = (learn(tiny, validation(steps), learning_rate=0.03).learned() for steps in (1, 40))
    assert all(long[name].origin.loss < short[name].origin.loss for name in long)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"components": 0}, r"model\.components: expected 1 or more, found 0"),
        ({"restarts": 0}, r"model\.budget\.restarts: expected 1 or more, found 0"),
        ({"screening": -1}, r"model\.budget\.screening: expected 0 or more, found -1"),
        ({"start": "zero"}, r"model\.embeddings\.start: expected mean or concepts, found 'zero'"),
        ({"samples": 0}, r"model\.budget\.samples: expected 1 or more, found 0"),
        ({"off_span": 1.1}, r"model\.embeddings\.off_span: expected 0 \(span\) to 1 \(free\), found 1.1"),
        ({"timestep_power": 0.5}, r"model\.loss\.timestep_power: expected 1 or more, found 0.5"),
        ({"mode_samples": 0}, r"model\.modes\.samples: expected 1 or more, found 0"),
        ({"modes": 0}, r"model\.modes\.sets: expected 1 or more, 'each' or 'auto', found 0"),
        ({"modes": "some"}, r"model\.modes\.sets: expected a number, 'each' or 'auto', found 'some'"),
        ({"guidance_scale": -1.0}, r"model\.weights\.scale: expected .* found -1"),
        ({"tolerance": 1}, r"model\.budget\.tolerance: expected null or a share from 0 up to 1, found 1"),
        ({"tolerance": -0.1}, r"model\.budget\.tolerance: expected null or a share from 0 up to 1, found -0.1"),
        ({"knots": 0}, r"model\.embeddings\.knots: expected 1 or more, found 0"),
        ({"adapter": -1}, r"model\.adapter\.rank: expected 0 \(none\) or a rank, found -1"),
        ({"adapter": 2, "tolerance": 0.1}, r"model\.adapter\.rank: expected model\.budget\.tolerance null beside it"),
        ({"loss": "displacement"}, r"model\.loss\.kind: expected one of epsilon, v, clean, found 'displacement'"),
    ],
)
def test_settings_that_are_none_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        InversionSettings().changed(**options)


def test_a_loss_that_is_not_finite_is_told(tiny: Path) -> None:
    with pytest.raises(UserError, match=r"inversion: the loss became nan at step \d; lower model\.budget\.learning_rate"):
        invert(load_model(tiny), validation(1).demonstrations, InversionSettings().changed(samples=2, learning_rate=1e30), 9)


@pytest.mark.parametrize(("power", "expected"), [(1.0, 12.5), (3.0, 50.0)])
def test_timesteps_are_even_or_mostly_noisy(tiny: Path, power: float, expected: float) -> None:
    module = learn(tiny, timestep_power=power)
    seen: list[torch.Tensor] = []
    module.model.denoiser.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[1]))
    module.inversion.losses(2000, torch.Generator().manual_seed(0))
    t = torch.cat(seen)
    steps = len(module.model.alpha_bar)
    assert t.min() >= 0
    assert t.max() == steps - 1
    assert 100 * (t >= steps * 7 / 8).float().mean() == pytest.approx(expected, abs=1.5)


def test_what_is_learned_does_not_depend_on_what_is_learned_beside_it(tiny: Path) -> None:
    every, settings = validation().demonstrations, InversionSettings().changed(samples=8)
    name = every.concepts[0]
    one, other = (invert(load_model(tiny), own, settings, 6)[name] for own in (every, every.select(name)))
    assert one.origin.demonstrations == other.origin.demonstrations
    assert torch.allclose(one.embeddings, other.embeddings, atol=2e-4)


def test_restarts_start_at_training_concepts_and_the_best_of_them_goes_on_alone(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, steps = load_model(tiny), 5
    demonstrations = validation(steps).demonstrations
    settings = InversionSettings().changed(samples=8, initial_spread=0.0, components=1, **SCREENED)
    inversion = Inversion(model, demonstrations, settings)
    starts = inversion.embeddings.detach().clone()[:, 0, 0]
    assert torch.equal(starts, model.training_embeddings[:3].repeat(len(inversion.concepts), 1))
    runs, losses_of = [], inversion.step_losses

    def counted(step: int) -> torch.Tensor:
        losses = losses_of(step)
        runs.append(len(losses))
        return losses

    monkeypatch.setattr(inversion, "step_losses", counted)
    learned = invert(model, demonstrations, settings, steps, start=inversion)
    assert runs == [3 * len(inversion.concepts)] * 2 + [len(inversion.concepts)] * 3
    kept = inversion.embeddings[inversion.kept]
    assert torch.equal(torch.stack([concept.embeddings for concept in learned.values()]), kept)


def test_after_screening_an_inversion_ends_when_those_that_go_on_have_stopped(tiny: Path) -> None:
    demonstrations = validation(60).demonstrations
    settings = InversionSettings().changed(samples=8, components=1, tolerance=0.9, **SCREENED)
    inversion = Inversion(load_model(tiny), demonstrations, settings)
    for step in range(60):
        assert inversion.step_losses(step).isfinite().all()
        if not inversion.after_step(step):
            break
    assert step < 59  # nothing moves without an optimizer, so rounds of ten steps gain nothing
    assert not inversion.stopping.going.any()


def test_from_one_start_settings_start_at_the_mean() -> None:
    settings = InversionSettings().changed(tolerance=0.1, **SCREENED)
    assert settings.from_one_start(samples=3) == InversionSettings().changed(tolerance=0.1, samples=3)
    assert quickly(settings).budget.screening == 0
    assert quickly(settings).embeddings.start == "mean"


def test_the_best_of_several_restarts_is_kept(tiny: Path) -> None:
    shown().save("own.safetensors")
    data = InversionData("object_rearrangement", demonstrations="own.safetensors", steps=6)
    one, four = (learn(tiny, data, initial_spread=1.0, form="paper", restarts=restarts) for restarts in (1, 4))
    # The first restart is what there is without restarts.
    assert torch.allclose(four.inversion.embeddings[:1], one.inversion.embeddings, atol=2e-4)
    kept = four.learned()[RING]
    with torch.no_grad():  # on other noise than the choice was made on
        losses = four.inversion.losses(5_000, torch.Generator().manual_seed(0)).mean(dim=1)
    best = four.inversion.embeddings.detach()[losses.argmin()]
    assert losses.max() - losses.min() > 0.01  # else there is nothing to choose
    assert torch.equal(kept.embeddings, best)
    assert kept.origin.loss <= one.learned()[RING].origin.loss + 1e-4


@pytest.mark.parametrize(("off_span", "inside"), [(0.0, True), (0.3, False), (1.0, False)])
def test_the_span_form_stays_in_the_span(tiny: Path, off_span: float, inside: bool) -> None:
    module = learn(tiny, off_span=off_span)
    training = module.model.training_embeddings
    found = module.inversion.scale_off_span(module.inversion.embeddings).detach().flatten(0, 2)
    solution = torch.linalg.lstsq(training.T.double(), found.T.double()).solution
    outside = (training.T.double() @ solution - found.T).norm() / found.norm()
    assert (outside < 1e-3) == inside


@pytest.mark.slow
def test_a_concept_file_names_where_it_comes_from(invert: Callable[..., Path], tiny: Path) -> None:
    folder = invert("--data.suite=validation", "--evaluation.suites=[validation]") / "concepts"
    files = sorted(folder.iterdir())
    assert len(files) == 14
    concept = Concept.load(files[0])
    model = read_model(GenerativeModel, tiny)
    assert concept.origin.pretrained == model.hash
    assert concept.origin.encoder == model.config.encoder
    assert concept.origin.weights == "fixed"
    assert concept.origin.count == 5
    assert concept.embeddings.shape == (2, 1, 384)
    assert concept.weights.tolist() == pytest.approx([1.2, 1.2])


@pytest.mark.slow
def test_own_demonstrations_and_composition(invert: Callable[..., Path], tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = "circle right of square and square above triangle"  # in no suite
    load_domain("object_rearrangement").source(None).draw(task, 3, 0).save("mine.safetensors")
    log = invert("--data.demonstrations=mine.safetensors", "--model.omega=learned", "--evaluation.figures=0")
    (file,) = (log / "concepts").iterdir()
    assert Concept.load(file).origin.weights == "learned"
    rows = read_rows(log / "results.csv")
    assert set(rows[["setting", "task", "role"]].itertuples(index=False, name=None)) == {("own demonstrations", task, "method")}
    assert rows["metric"].tolist() == ["accuracy", "novelty", "coverage"]  # judged alone
    sample, hashes = ["sample", f"--pretrained={tiny}", "--count=4", "--steps=3", "--out=states.safetensors"], []
    learned = [f"--concept={file}", "--compose=circle above square:1.2", f"--goal={task}"]
    negated = "circle above square and not circle right of square"
    negative = [f"--compose=circle above square:1.2 + circle right of square:-0.5 + {file}:0.5", f"--goal={negated}"]
    for options, goal in (([*learned, "--figure=states.png"], task), (learned, task), (negative, negated)):
        succeed(*sample, *options)
        assert f"accuracy on '{goal}'" in capsys.readouterr().out
        hashes.append(file_hash("states.safetensors"))
    assert Path("states.png").stat().st_size > 1000
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_task_is_composed_of_all_that_it_names_with_the_weight_of_each(tiny: Path) -> None:
    module = learn(tiny, omega=1.2, training_omega=0.8, components=2)
    module.learned()
    first, second, *_ = module.concepts
    text, other = module.model.config.training_concepts[:2]
    found = module.composition(EvaluationTask("s", "g", learned=(first, second), texts=(text,), without=(other,)))
    assert found.weights.tolist() == pytest.approx([0.8, WITHOUT_WEIGHT, 1.2, 1.2, 1.2, 1.2])
    expected = [module.model.concept(text)[None, None], module.model.concept(other)[None, None]]
    expected += [module.learned()[name].embeddings for name in (first, second)]
    assert torch.equal(found.embeddings, torch.cat(expected))
    assert module.composition(EvaluationTask("s", "g", learned=(first, "never learned"))) is None
    negated = module.composition(EvaluationTask("s", "g", texts=(text,), without=(other,)))
    assert negated.weights.tolist() == pytest.approx([1.2, WITHOUT_WEIGHT])  # nothing learned: the paper's omega


@pytest.mark.slow
def test_the_compositions_suite_is_learned_and_judged_with_all_its_settings(invert: Callable[..., Path]) -> None:
    judged = ["--evaluation.suites=[compositions]", "--evaluation.samples=1", "--evaluation.figures=0"]
    invert("--data.suite=compositions", *judged, "--evaluation.results=r.csv")
    rows = read_rows("r.csv")
    rows = rows[(rows["role"] == "method") & (rows["metric"] == "accuracy")]
    assert rows["setting"].value_counts().to_dict() == {"two learned concepts": 6, "ring + training": 4, "three texts": 6, "not": 6}
    shown = rows.groupby("setting")["demonstrations"].unique().map(list).to_dict()
    assert shown == {"two learned concepts": [10], "ring + training": [5], "three texts": [0], "not": [0]}


@pytest.mark.slow
def test_inverting_twice_gives_the_same_rows(invert: Callable[..., Path]) -> None:
    options = ["--evaluation.suites=[paper, components]", "--evaluation.samples=1", "--evaluation.figures=0"]
    options += ["--data.steps=2", "--evaluation.results=r.csv"]
    invert(*options)
    first = read_rows("r.csv")
    invert(*options)
    assert read_rows("r.csv").equals(first)  # replaced, not added
    ours = first[first["K"] == 2]
    assert set(ours["setting"]) == {"training composition", "new concept", "new + training", "component 1", "component 2"}
    assert set(first["method"]) == {"FTL-IGM", "random scenes", "generator (oracle)", REPLAYED, FRESH}
    assert set(ours["variant"]) == {"free, training weight 0.8"}
    oracle = first[(first["method"] == "generator (oracle)")]
    assert (oracle["value"] == 1).all()


# Modes


RING = "circle, triangle and square in a circle of radius 1.25"


def shown(count: int = 5, task: str = RING) -> Demonstrations:
    return load_domain("object_rearrangement").source(None).draw(task, count, 1)


def from_few(tiny: Path, own: Demonstrations, steps: int = 6, **changes: Any) -> Concept:
    """The only concept of some demonstrations."""
    (found,) = invert(load_model(tiny), own, InversionSettings().changed(samples=8, **changes), steps).values()
    return found


def alike(one: torch.Tensor, other: torch.Tensor) -> bool:
    """To the rounding of batches of different sizes."""
    return torch.allclose(one, other, atol=2e-4)


@pytest.mark.parametrize("modes", ["each", "auto", 3])
def test_of_a_single_demonstration_there_is_one_set_of_embeddings_whatever_the_modes(tiny: Path, modes: int | str) -> None:
    one, several = (from_few(tiny, shown(1), modes=own) for own in (1, modes))
    assert several.modes is None
    for name, concept in (("one", one), ("several", several)):
        concept.save(f"{name}.safetensors")
    assert file_hash("one.safetensors") == file_hash("several.safetensors")


@pytest.mark.parametrize("modes", ["each", "auto", 2])
def test_beside_modes_the_concept_is_what_it_is_without_them(tiny: Path, modes: int | str) -> None:
    one, several = (from_few(tiny, shown(), modes=own) for own in (1, modes))
    assert one.modes is None
    assert several.modes is not None
    assert alike(several.embeddings, one.embeddings)
    assert torch.equal(several.weights, one.weights)
    assert several.origin.loss == pytest.approx(one.origin.loss, abs=1e-5)


@pytest.mark.parametrize(
    ("modes", "parts"), [("each", [[0], [1], [2], [3], [4]]), (2, [[0, 2, 4], [1, 3]]), (9, [[0], [1]])], ids=str
)
def test_a_mode_is_what_its_demonstrations_alone_teach(tiny: Path, modes: int | str, parts: list[list[int]]) -> None:
    own = shown(2 if modes == 9 else 5)
    found = from_few(tiny, own, modes=modes, omega="learned").modes
    assert len(found) == len(parts)
    for number, rows in enumerate(parts):
        alone = from_few(tiny, own.rows(rows), omega="learned")
        assert alike(found.embeddings[number], alone.embeddings)
        assert alike(found.weights[number], alone.weights)
    assert not alike(found.embeddings[0], found.embeddings[1])


def test_of_every_mode_the_best_restart_is_kept(tiny: Path) -> None:
    own = shown()
    several = from_few(tiny, own, modes="each", restarts=3, initial_spread=1.0)
    for row in range(5):
        alone = from_few(tiny, own.rows([row]), restarts=3, initial_spread=1.0)
        assert alike(several.modes.embeddings[row], alone.embeddings)


@pytest.mark.slow
def test_modes_are_more_likely_than_one_set_of_embeddings(tiny: Path) -> None:
    own = shown()
    several = from_few(tiny, own, steps=80, modes="each")
    assert several.modes is not None
    each = [from_few(tiny, own.rows([row]), steps=80).origin.loss for row in range(5)]
    assert sum(each) / 5 < several.origin.loss


def test_what_one_set_explains_is_its_share_of_the_modes_gain() -> None:
    empty, one, modes = torch.tensor([0.2, 0.2, 0.2]), torch.tensor([0.1, 0.2, 0.18]), torch.tensor([0.1, 0.1, 0.15])
    assert explained(empty, one, modes).tolist() == pytest.approx([1.0, 0.0, 0.4])
    assert EXPLAINED == 0.4


@pytest.mark.parametrize(("least", "mixed"), [(-10.0, True), (10.0, False)])
def test_auto_mixes_the_modes_where_one_set_explains_enough(
    tiny: Path, least: float, mixed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftl_lightning.igm.inversion.EXPLAINED", least)
    auto, each = (from_few(tiny, shown(), modes=modes).modes for modes in ("auto", "each"))
    assert auto.mixed is mixed
    assert not each.mixed  # it is told to draw them
    assert torch.equal(auto.embeddings, each.embeddings)


@pytest.mark.slow
def test_auto_asks_how_much_of_what_the_modes_gain_one_set_gains(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[float]] = []

    def spy(*losses: torch.Tensor) -> torch.Tensor:
        asked.append([loss.item() for loss in losses])
        return explained(*losses)

    monkeypatch.setattr("ftl_lightning.igm.inversion.explained", spy)
    own = shown()
    several = from_few(tiny, own, steps=80, modes="auto")
    ((empty, one, modes),) = asked
    assert one == pytest.approx(several.origin.loss, abs=1e-6)
    assert modes == pytest.approx(sum(from_few(tiny, own.rows([row]), steps=80).origin.loss for row in range(5)) / 5, abs=1e-4)
    assert modes < one < empty
    assert several.modes.mixed is ((empty - one) / (empty - modes) >= EXPLAINED)


def test_alone_a_task_is_generated_from_modes_and_composed_or_in_part_from_the_centre(tiny: Path) -> None:
    module = learn(tiny, modes="each")
    module.learned()
    name, other, *_ = module.concepts
    concept, text = module.learned()[name], module.model.config.training_concepts[0]
    alone = module.composition(EvaluationTask("s", "g", learned=(name,)))
    assert torch.equal(alone.modes.embeddings, concept.modes.embeddings)
    for task in (
        EvaluationTask("s", "g", learned=(name,), texts=(text,)),
        EvaluationTask("s", "g", learned=(name,), without=(text,)),
        EvaluationTask("s", "g", learned=(name, other)),
        EvaluationTask("s", "g", learned=(name,), component=2),
    ):
        found = module.composition(task)
        assert found.modes is None
        assert any(torch.equal(concept.embeddings[1], row) for row in found.embeddings)


@pytest.mark.parametrize(("omega", "factor", "told"), [("learned", 1.25, "guidance 1.25"), (1.2, 1.0, "free")])
def test_the_guidance_scale_multiplies_learned_weights_and_no_others(tiny: Path, omega: Any, factor: float, told: str) -> None:
    plain, scaled = (learn(tiny, omega=omega, guidance_scale=scale) for scale in (1.0, 1.25))
    assert scaled.variant.endswith(told)
    for name, one in plain.learned().items():
        other = scaled.learned()[name]
        assert torch.equal(other.weights, factor * one.weights)
        assert torch.equal(other.embeddings, one.embeddings)
        assert other.origin.loss == one.origin.loss  # of what was learned


def test_the_projector_names_the_components_of_every_mode(tiny: Path) -> None:
    for modes, count in ((1, 0), (2, 2)):
        module = learn(tiny, modes=modes)
        module.learned()
        name = module.concepts[0]
        points = module.concept_points()
        own = [point.part for point in points if point.text == name]
        assert [(part.mode, part.component) for part in own if part] == [
            (mode, number) for mode in (None, *range(1, count + 1)) for number in (1, 2)
        ]
        sets = Counter(point.set for point in points)
        assert sets == {"empty concept": 1, "training concept": 12, "new component": len(module.concepts) * 2 * (1 + count)}


def test_every_setting_is_part_of_the_identity(tiny: Path) -> None:
    data = validation()

    def of(**options: Any) -> dict[str, Any]:
        return configuration(inversion_module(tiny, **options), data, {})

    plain = of()
    assert (plain["model/components"], plain["model/modes"], plain["model/guidance_scale"]) == (2, 1, 1.0)
    assert of(modes=1, tolerance=None, guidance_scale=1.0) == plain
    for changes in ({"modes": 2}, {"modes": "auto"}, {"tolerance": 0.0}, {"tolerance": 0.01}, {"guidance_scale": 1.25}):
        (key, value), *_ = changes.items()
        assert of(**changes) == plain | {f"model/{key}": value}


@pytest.mark.parametrize(
    ("options", "known"),
    [
        ({"max_epochs": 1, "deterministic": True, "gradient_clip_val": None, "max_steps": -1}, {}),
        ({"max_epochs": 1, "log_every_n_steps": 3, "enable_progress_bar": False, "logger": False}, {}),
        ({"max_epochs": 1, "gradient_clip_val": 0.5}, {"trainer/gradient_clip_val": 0.5}),
        ({"max_epochs": 1, "max_steps": 3}, {"trainer/max_steps": 3}),
        ({"max_epochs": 2, "limit_train_batches": 0.5}, {"trainer/max_epochs": 2, "trainer/limit_train_batches": 0.5}),
        ({"max_epochs": 1, "precision": "bf16-mixed"}, {"trainer/precision": "bf16-mixed"}),
        ({"max_epochs": 1, "deterministic": False}, {"trainer/deterministic": False}),
    ],
)
def test_options_of_the_trainer_that_change_what_is_learned_are_part_of_the_identity(
    options: dict[str, Any], known: dict[str, Any], tiny: Path
) -> None:
    data, module = validation(), InversionModule(str(tiny))
    plain = configuration(module, data, {})
    assert configuration(module, data, {}, Trainer(accelerator="cpu", **options)) == plain | known


@pytest.mark.parametrize(
    ("settings", "method", "form", "variant"),
    [
        ({}, "FTL-IGM", "", ""),
        ({"modes": 3}, "FTL-IGM", "with modes", ", modes: 3"),
        ({"modes": "each"}, "FTL-IGM", "with modes", ", modes: each"),
        ({"modes": "auto"}, "FTL-IGM", "with modes", ""),
        ({"knots": 2}, "FTL-IGM", "with knots", None),
        ({"modes": 2, "knots": 2}, "FTL-IGM", "with modes, with knots", None),
        ({"adapter": 2}, "FTL-IGM", "with adapter", None),
        ({"adapter": 2, "knots": 2}, "FTL-IGM", "with knots, with adapter", None),
        ({"adapter": 2, "adapter_scope": "all"}, "LoRA fine-tuning", "", None),
    ],
    ids=str,
)
def test_a_table_tells_methods_and_their_forms_apart(settings: dict[str, Any], method: str, form: str, variant: str | None) -> None:
    plain, module = (inversion_module(ROOT / "pretrained" / "agent", **options) for options in ({}, settings))
    assert (module.method, module.form) == (method, form)
    assert variant is None or module.variant == plain.variant + variant


@pytest.mark.parametrize("samples", [2, 8])
def test_modes_learn_from_noised_demonstrations_of_a_number_of_their_own(tiny: Path, samples: int) -> None:
    found, same = (from_few(tiny, shown(), modes=2, mode_samples=number) for number in (samples, 8))
    assert alike(found.embeddings, same.embeddings)
    assert alike(found.modes.embeddings, same.modes.embeddings) == (samples == 8)


@pytest.mark.slow
def test_a_concept_that_is_not_finite_is_not_learned(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    invert = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", f"--model.pretrained={tiny}", "--data.suite=validation"]
    invert += ["--data.steps=1", "--model.budget.learning_rate=1e30", "--trainer.enable_progress_bar=false"]
    for tolerance in ("null", "0.01"):
        assert main([*invert, "--trainer.accelerator=cpu", f"--model.budget.tolerance={tolerance}"]) == 2
        assert "inversion: concept" in (told := capsys.readouterr().err)
        assert "expected finite numbers, found others in 'loss'; lower model.budget.learning_rate" in told
    assert not list(Path().rglob("concepts"))
