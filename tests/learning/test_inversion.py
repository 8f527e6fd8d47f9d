import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.cli import main
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.domains.data import InversionData
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.diversity import FRESH, REPLAYED
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.learning import InversionModule
from ftl_lightning.learning.generative_model import GenerativeModel
from ftl_lightning.learning.inversion import InversionSettings, invert
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.tensor_file import file_hash
from ftl_lightning.trainer import Trainer


def learn(tiny: Path, data: InversionData | None = None, **options: object) -> InversionModule:
    module = InversionModule(str(tiny), samples=8, **options)  # type: ignore[arg-type]
    data = data or InversionData("object_rearrangement", suite="validation", steps=6)
    settings = {
        "logger": False,
        "check_val_every_n_epoch": 2,
        "log_every_n_steps": 1,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    trainer = Trainer(max_epochs=1, accelerator="cpu", **settings)
    trainer.fit(module, datamodule=data)
    return module


def test_the_only_parameters_are_embeddings_and_weights_and_each_gets_a_gradient(tiny: Path) -> None:
    before = file_hash(tiny / "model.safetensors")
    for omega, names in (("learned", {"embeddings", "weights"}), (1.2, {"embeddings"})):
        module = learn(tiny, omega=omega, components=3)
        trainable = {name: parameter for name, parameter in module.named_parameters() if parameter.requires_grad}
        assert set(trainable) == {f"inversion.{name}" for name in names}
        for parameter in trainable.values():
            assert parameter.grad is not None
            assert (parameter.grad.abs().flatten(2 if parameter.dim() == 3 else 1).amax(dim=-1) > 0).all()
        assert module.model.hash == before  # not one bit of the pretrained model has changed
        assert (module.inversion.weights == 1.2).all() or omega == "learned"


def test_learning_lowers_the_loss(tiny: Path) -> None:
    data = [InversionData("object_rearrangement", suite="validation", steps=steps) for steps in (1, 60)]
    short, long = (learn(tiny, one, learning_rate=0.03).learned() for one in data)
    assert all(long[name].origin.loss < short[name].origin.loss for name in long)


@pytest.mark.parametrize(
    "options",
    [{}, {"omega": "learned", "components": 3}, {"off_span": 0.1, "restarts": 2, "loss": "v", "timestep_power": 3.0}],
    ids=str,
)
def test_without_a_trainer_the_same_concepts_are_learned_to_the_bit(tiny: Path, options: dict[str, Any]) -> None:
    data = InversionData("object_rearrangement", suite="validation", steps=7)
    module = learn(tiny, data, seed=3, **options)
    told: list[float] = []
    settings = InversionSettings(samples=8, seed=3, **options)
    found = invert(load_model(tiny), data.demonstrations, settings, 7, told.append)
    expected = module.learned()
    assert list(found) == list(expected) == list(data.concepts)
    for name, concept in expected.items():
        assert torch.equal(found[name].embeddings, concept.embeddings)
        assert torch.equal(found[name].weights, concept.weights)
        assert found[name].origin == concept.origin
    assert len(told) == 7
    assert all(math.isfinite(loss) for loss in told)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"components": 0}, r"model\.components: expected 1 or more, found 0"),
        ({"restarts": 0}, r"model\.restarts: expected 1 or more, found 0"),
        ({"samples": 0}, r"model\.samples: expected 1 or more, found 0"),
        ({"off_span": 1.1}, r"model\.off_span: expected 0 \(span\) to 1 \(free\), found 1.1"),
        ({"timestep_power": 0.5}, r"model\.timestep_power: expected 1 or more, found 0.5"),
        ({"loss": "displacement"}, r"model\.loss: expected one of epsilon, v, clean, found 'displacement'"),
    ],
)
def test_settings_that_are_none_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        InversionSettings(**options)


def test_a_loss_that_is_not_finite_is_told(tiny: Path) -> None:
    data = InversionData("object_rearrangement", suite="validation", steps=1)
    with pytest.raises(UserError, match=r"inversion: the loss became nan at step \d; lower model\.learning_rate"):
        invert(load_model(tiny), data.demonstrations, InversionSettings(samples=2, learning_rate=1e30), 9)


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
    together = InversionData("object_rearrangement", suite="validation", steps=6)
    name = together.concepts[0]
    file = Path("one.safetensors")
    together.demonstrations.select(name).save(file)
    alone = InversionData("object_rearrangement", demonstrations=str(file), steps=6)
    one, other = (learn(tiny, data).learned()[name] for data in (together, alone))
    assert one.origin.demonstrations == other.origin.demonstrations
    assert torch.allclose(one.embeddings, other.embeddings, atol=2e-4)


def test_the_best_of_several_restarts_is_kept(tiny: Path) -> None:
    everything = InversionData("object_rearrangement", suite="validation", steps=6)
    name = everything.concepts[0]
    file = Path("one.safetensors")
    everything.demonstrations.select(name).save(file)
    data = [InversionData("object_rearrangement", demonstrations=str(file), steps=6) for _ in range(2)]
    one, four = learn(tiny, data[0], initial_spread=1.0), learn(tiny, data[1], initial_spread=1.0, restarts=4)
    assert torch.allclose(
        four.inversion.embeddings[:1], one.inversion.embeddings, atol=2e-4
    )  # the first restart is what there is without restarts
    kept = four.learned()[name]
    with torch.no_grad():
        losses = four.inversion.losses(5_000, torch.Generator().manual_seed(0)).mean(
            dim=1
        )  # on other noise than the choice was made on
    best = four.inversion.embeddings.detach()[losses.argmin()]
    assert losses.max() - losses.min() > 0.01  # else there is nothing to choose
    assert torch.equal(kept.embeddings, best)
    assert kept.origin.loss <= one.learned()[name].origin.loss + 1e-4


@pytest.mark.parametrize(("off_span", "inside"), [(0.0, True), (0.3, False), (1.0, False)])
def test_the_span_form_stays_in_the_span(tiny: Path, off_span: float, inside: bool) -> None:
    module = learn(tiny, off_span=off_span)
    training = module.model.training_embeddings
    found = module.inversion.parametrised(module.inversion.embeddings).detach().flatten(0, 1)
    solution = torch.linalg.lstsq(training.T.double(), found.T.double()).solution
    outside = (training.T.double() @ solution - found.T).norm() / found.norm()
    assert (outside < 1e-3) == inside


def test_a_concept_file_names_where_it_comes_from(invert: Callable[..., Path], tiny: Path) -> None:
    folder = invert("--data.suite=validation", "--evaluation.suites=[validation]") / "concepts"
    files = sorted(folder.iterdir())
    assert len(files) == 14
    concept = Concept.load(files[0])
    model = GenerativeModel.load(tiny)
    assert concept.origin.pretrained == model.hash
    assert concept.origin.encoder == model.config.encoder
    assert concept.origin.weights == "fixed"
    assert concept.origin.count == 5
    assert concept.embeddings.shape == (2, 384)
    assert concept.weights.tolist() == pytest.approx([1.2, 1.2])


def test_own_demonstrations_and_composition(invert: Callable[..., Path], tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = "circle right of square and square above triangle"  # in no suite
    assert main(["generate", "object_rearrangement", f"--task={task}", "--count=3", "--out=mine.safetensors"]) == 0
    log = invert("--data.demonstrations=mine.safetensors", "--model.omega=learned")
    (file,) = (log / "concepts").iterdir()
    assert Concept.load(file).origin.weights == "learned"
    rows = read_rows(log / "results.csv")
    assert set(rows[["setting", "task", "role"]].itertuples(index=False, name=None)) == {("own demonstrations", task, "method")}
    assert rows["metric"].tolist() == ["accuracy", "novelty", "coverage"]  # judged alone
    options = [f"--pretrained={tiny}", f"--concept={file}", "--compose=circle above square:1.2", "--count=4", "--steps=3"]
    assert main(["sample", *options, f"--goal={task}", "--out=states.safetensors", "--figure=states.png"]) == 0
    assert "accuracy on" in capsys.readouterr().out
    assert Path("states.png").stat().st_size > 1000
    first = file_hash("states.safetensors")
    assert main(["sample", *options, f"--goal={task}", "--out=states.safetensors"]) == 0
    assert file_hash("states.safetensors") == first
    negative = f"--compose=circle above square:1.2 + circle right of square:-0.5 + {file}:0.5"
    rest = [f"--pretrained={tiny}", negative, "--count=4", "--steps=3", "--goal=circle above square and not circle right of square"]
    assert main(["sample", *rest, "--out=others.safetensors"]) == 0
    assert "accuracy on 'circle above square and not circle right of square'" in capsys.readouterr().out
    assert file_hash("others.safetensors") != first


def test_a_task_is_composed_of_all_that_it_names_with_the_weight_of_each(tiny: Path) -> None:
    module = learn(tiny, omega=1.2, training_omega=0.8, components=2)
    module.on_validation_start()
    first, second, *_ = module.concepts
    text, other = module.model.config.training_concepts[:2]
    found = module.composition(EvaluationTask("s", "g", learned=(first, second), texts=(text,), without=(other,)))
    assert found is not None
    assert found.weights.tolist() == pytest.approx([0.8, WITHOUT_WEIGHT, 1.2, 1.2, 1.2, 1.2])
    expected = [module.model.concept(text)[None], module.model.concept(other)[None]]
    expected += [module.learned()[name].embeddings for name in (first, second)]
    assert torch.equal(found.embeddings, torch.cat(expected))
    assert module.composition(EvaluationTask("s", "g", learned=(first, "never learned"))) is None
    negated = module.composition(EvaluationTask("s", "g", texts=(text,), without=(other,)))
    assert negated is not None
    assert negated.weights.tolist() == pytest.approx([1.2, WITHOUT_WEIGHT])  # nothing learned: the paper's omega


def test_the_compositions_suite_is_learned_and_judged_with_all_its_settings(invert: Callable[..., Path]) -> None:
    invert(
        "--data.suite=compositions", "--evaluation.suites=[compositions]", "--evaluation.figures=0", "--evaluation.results=r.csv"
    )
    rows = read_rows("r.csv")
    rows = rows[(rows["role"] == "method") & (rows["metric"] == "accuracy")]
    assert rows["setting"].value_counts().to_dict() == {
        "two learned concepts": 6,
        "ring + training": 4,
        "three texts": 6,
        "not": 6,
    }
    shown = rows.groupby("setting")["demonstrations"].unique().map(list).to_dict()
    assert shown == {"two learned concepts": [10], "ring + training": [5], "three texts": [0], "not": [0]}


def test_inverting_twice_gives_the_same_rows(invert: Callable[..., Path]) -> None:
    options = ["--evaluation.suites=[paper, components]", "--evaluation.figures=0", "--evaluation.results=r.csv"]
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
