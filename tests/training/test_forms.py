"""The form of a concept that its demonstrations ask for, and what samples of it are said to be like."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from matplotlib.colors import to_hex

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.object_rearrangement.scenes import columns, random_scenes
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms import choice
from ftl_lightning.igm.forms.choice import ALL, OWN, RANK, TOLERANCE, _Shares, first_settings, learn
from ftl_lightning.igm.forms.modes import Modes, even_stretch
from ftl_lightning.igm.forms.quality import Quality
from ftl_lightning.igm.settings import ADAPTED, AUTO, FORMS, MIXED, MODES, ONE, PAPER, InversionSettings
from ftl_lightning.services.errors import UserError
from tests.conftest import CONF, ROOT, succeed

TASK = "circle right of square"


def scenes(model: FewShot, task: str = TASK, count: int = 5) -> Demonstrations:
    return model.domain.source(None).draw(task, count, seed=3)


@pytest.fixture(scope="module")
def model() -> FewShot:
    return FewShot.from_pretrained(ROOT / "pretrained" / "object_rearrangement")


@pytest.mark.slow
def test_where_demonstrations_share_a_relation_one_set_suffices_and_the_numbers_are_told(model: FewShot) -> None:
    learned = model.learn(scenes(model))
    choice = learned.concept.choice
    assert choice.form in (ADAPTED, MIXED)
    own, *left_out = (choice.numbers[f"loss, {name}"] for name in ("own", "left out", "left out, in span"))
    assert own + sum(left_out) <= ALL or own <= OWN
    assert "left-out demonstrations" in choice.because
    assert learned.concept.adapter is not None
    samples = model.sample(learned, 50)
    assert model.evaluate(samples, TASK)["accuracy"] > 0.95


@pytest.mark.slow
def test_where_they_do_not_samples_come_from_one_mode_each(model: FewShot) -> None:
    proposed = random_scenes(100_000, 0)
    x, y, _ = columns(proposed)
    points = torch.stack((x, y), dim=-1)
    apart = torch.cdist(points, points)[:, [0, 0, 1], [1, 2, 2]].amin(dim=1) > 3.2  # in ways that are right, but not alike
    states = proposed[apart][:5, None].numpy()
    learned = model.learn(states, name="far apart")
    assert learned.concept.choice.form == MODES
    assert not learned.concept.modes.mixed
    assert learned.concept.adapter is None


@pytest.mark.slow
def test_each_form_can_be_asked_for_and_options_that_name_one_are_followed_without_a_choice(model: FewShot) -> None:
    five = scenes(model)
    found = {form: model.learn(five, form=form, steps=4).concept for form in FORMS[1:] if form != AUTO}
    assert all(concept.choice is None for concept in found.values())
    for form in (PAPER, ONE):
        assert found[form].modes is None
        assert found[form].adapter is None
    assert torch.equal(found[PAPER].embeddings, found[ONE].embeddings)
    assert found[MODES].modes is not None
    assert found[MODES].adapter is None
    assert found[ADAPTED].adapter is not None
    assert found[ADAPTED].modes is None
    modes = found[MIXED].modes
    assert modes.mixed
    assert modes.stretch == even_stretch(5)
    with pytest.raises(UserError, match=r"model\.form: expected one of paper, auto, one set, .*, found 'best'"):
        model.learn(five, form="best")
    for options in ({"modes": "each"}, {"adapter": 1, "tolerance": None}, {"form": "paper"}):
        assert model.learn(five, steps=2, **options).concept.choice is None
    assert InversionSettings().for_own(choose=True).form == AUTO
    assert InversionSettings().for_own(choose=False).form == ""


@pytest.mark.slow
def test_a_chosen_form_comes_back_from_its_file_and_composes_as_before(model: FewShot, tmp_path: Path) -> None:
    concept = model.learn(scenes(model), steps=20).concept
    other = replace(concept, composing=(concept.embeddings + 1, concept.weights * 0.5))
    for one in (concept, other):
        one.save("c.safetensors")
        back = Concept.load("c.safetensors")
        assert back.choice == one.choice
        assert (back.composing is None) == (one.composing is None)
        again = model.load("c.safetensors")
        for composition in (again, again + 0.8 * model["circle above square"]):
            known = model._learned(one) if composition is again else model._learned(one) + 0.8 * model["circle above square"]
            assert torch.equal(model.sample(composition, 3, steps=4).states, model.sample(known, 3, steps=4).states)


def test_a_concept_is_composed_from_its_own_set_and_generated_from_the_other() -> None:
    alone = Composition(torch.ones(1, 1, 3), torch.ones(1))
    concept = Composition(torch.zeros(2, 1, 3), torch.ones(2), alone=alone)
    assert concept.uncomposed is alone
    summed = concept + Composition(torch.full((1, 1, 3), 5.0), torch.ones(1))
    assert summed.alone is None
    assert summed.embeddings[:, 0, 0].tolist() == [0, 0, 5]
    doubled = 2.0 * concept
    assert doubled.weights.tolist() == [2, 2]
    assert doubled.uncomposed.weights.tolist() == [2]
    assert concept.drawn(torch.Generator()) is alone


def test_evenly_stretched_mixtures_vary_as_much_as_what_the_modes_are_a_sample_of() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = []
    for _ in range(300):
        modes = torch.randn(5, 1, 1, 1, generator=generator)
        mixed = Modes(modes, torch.ones(5, 1), mixed=True, stretch=even_stretch(5))
        drawn.append(mixed.draw(200, generator)[0].var())
    assert torch.stack(drawn).mean() == pytest.approx(1, abs=0.1)


def test_a_single_demonstration_has_one_set_and_two_have_no_left_out_ones(model: FewShot) -> None:
    one = model.learn(scenes(model, count=1), steps=10).concept
    assert one.choice.form == ONE
    two = model.learn(scenes(model, count=2), steps=10).concept
    assert "loss, left out" not in two.choice.numbers


def test_an_adapter_starts_from_a_set_that_explains_nearly_everything(model: FewShot, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"NEARLY": 1e9, "OWN": 1e9, "WARM_STEPS": 0, "NARROW": 0.0}.items():
        monkeypatch.setattr(choice, name, value)
    learned = {form: model.learn(scenes(model), steps=20, form=form).concept for form in (AUTO, ONE)}
    assert learned[AUTO].choice.form == ADAPTED
    assert "loss, left out" not in learned[AUTO].choice.numbers
    assert torch.equal(learned[AUTO].embeddings, learned[ONE].embeddings)


@pytest.mark.slow
def test_several_concepts_are_chosen_for_each_by_itself(model: FewShot) -> None:
    both = [scenes(model, task) for task in (TASK, "triangle above square")]
    together = learn(model.model, concatenate(both), model.tuned.inversion.changed(form=AUTO), 20)
    assert set(together) == {TASK, "triangle above square"}
    assert all(concept.choice is not None for concept in together.values())


def test_one_set_suffices_by_its_own_loss_or_by_all_together() -> None:
    assert _Shares(0.9, 1.1).suffices
    assert _Shares(0.9, 1.1, 1.2).suffices
    assert _Shares(0.7, 1.5, 1.9).suffices
    assert not _Shares(0.9, 1.1, 1.4).suffices
    assert not _Shares(0.9, 1.3).suffices
    assert not _Shares(0.9).suffices
    assert _Shares(0.9, 1.1, 1.0).composes
    assert not _Shares(0.9, 1.1, 1.2).composes
    assert not _Shares(0.9, 1.1).composes


def test_quality_tells_copies_collapse_and_jagged_samples() -> None:
    rng = torch.Generator().manual_seed(0)
    five, fresh = (torch.from_numpy(strokes("arc", count, seed)) for count, seed in ((5, 1), (60, 2)))
    good = Quality.of(fresh, five)
    assert good.words.count("(") == 0
    copies = Quality.of(five.repeat(8, 1, 1), five)
    assert copies.novelty == pytest.approx(0, abs=1e-5)
    assert "copies" in copies.words
    same = Quality.of(fresh[:1].repeat(40, 1, 1), five)
    assert same.spread == pytest.approx(0, abs=1e-5)
    assert "collapsed" in same.words
    jagged = Quality.of(fresh + 0.3 * torch.randn(fresh.shape, generator=rng), five)
    assert jagged.roughness > 2
    assert "rougher than your demonstrations" in jagged.words
    frozen = Quality.of(fresh[:, :1].expand(-1, 40, -1), five)
    assert frozen.roughness < 0.25 * good.roughness
    with pytest.raises(ValueError, match="two demonstrations"):
        Quality.of(fresh, five[:1])


@pytest.mark.slow
def test_invert_on_a_file_of_ones_own_chooses_and_tells_the_quality(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    five, configuration = "five.safetensors", str(CONF / "object_rearrangement.yaml")
    model = FewShot.from_pretrained(tiny, configuration)
    scenes(model).save(five)
    invert = ["invert", "--config", configuration, f"--model.pretrained={tiny}", "--data.steps=10", f"--data.demonstrations={five}"]
    invert += ["--evaluation.samples=3", "--evaluation.steps=3", "--evaluation.figures=0", "--model.output=concepts"]
    succeed(*invert, "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu")
    told = capsys.readouterr().out
    assert "form: " in told
    assert "quality: accuracy " in told
    learned = Concept.load("concepts/circle_right_of_square.safetensors")
    assert learned.choice is not None
    assert torch.equal(model.learn(scenes(model), steps=10).concept.embeddings, learned.embeddings)  # as FewShot.learn


@pytest.mark.slow
def test_the_quality_of_what_was_learned_is_told_and_drawn(model: FewShot) -> None:
    learned = model.learn(scenes(model), steps=10)
    assert "spread" in str(learned.quality)
    assert str(learned.quality).startswith("accuracy ")
    assert learned.quality.figure().axes
    with pytest.raises(UserError, match="quality: expected a concept that was learned here"):
        _ = model._learned(learned.concept).quality


def test_own_data_is_drawn_with_its_demonstrations_above_on_one_scale() -> None:
    from ftl_lightning.domains.pictures import PLAIN, RIGHT, WRONG, line_drawings

    beside = line_drawings(("x", "y")).beside
    assert beside is not None
    figure = beside(torch.zeros(2, 9, 2), torch.full((9, 9, 2), 3.0), "a title", [True] * 8 + [False])
    drawn = [axes for axes in figure.axes if axes.lines]
    assert len(drawn) == 11
    assert len({axes.get_xlim() for axes in drawn}) == 1
    assert [axes.get_ylabel() for axes in drawn if axes.get_ylabel()] == ["demonstrations", "samples"]
    frames = [to_hex(axes.spines["left"].get_edgecolor()) for axes in drawn]
    assert frames == [PLAIN] * 2 + [RIGHT] * 8 + [WRONG]


def test_an_adapter_that_is_named_beside_the_choice_is_of_the_named_rank(model: FewShot) -> None:
    assert model.tuned.inversion.budget.tolerance is not None  # with which an adapter alone is refused
    for options, rank in (({}, RANK), ({"adapter": 3}, 3)):
        adapter = model.learn(scenes(model), steps=3, form=ADAPTED, **options).concept.adapter
        assert {up.shape[-1] for up, _ in adapter.factors.values()} == {rank}


def test_what_is_learned_first_stops_by_itself_where_the_form_is_to_be_chosen() -> None:
    settings = InversionSettings(form=AUTO).changed(tolerance=None, adapter=2, modes=3)
    first = first_settings(settings)
    assert (first.budget.tolerance, first.adapter.rank, first.modes.sets) == (TOLERANCE, 0, 1)
    assert first_settings(settings.changed(form=MODES)).budget.tolerance is None


def test_the_form_with_an_adapter_is_learned_at_once(model: FewShot) -> None:
    steps: list[int] = []
    learned = model.learn(scenes(model), steps=4, form=ADAPTED, adapter=2, watch=lambda now: steps.append(now.step))
    assert steps == [1, 2, 3, 4]
    assert learned.concept.adapter is not None
    assert first_settings(InversionSettings(form=ADAPTED).changed(adapter=3)).adapter.rank == 3
