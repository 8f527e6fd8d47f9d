"""Combinations of training concepts, pinned states, references as forms, and the form chosen by skill, on an untrained model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.data.deformation import Pinned
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.distances import among, apart
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.data.places import Places, frames_of
from ftl_lightning.data.references import NAMES, SHIFTED, VARIED, Reference, Setting
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import KNOWN, Concept
from ftl_lightning.igm.diffusion import cosine_alpha_bar
from ftl_lightning.igm.explanation import formula
from ftl_lightning.igm.forms.combination import Combination
from ftl_lightning.igm.forms.skill import Drawn, LeftOut
from ftl_lightning.igm.samplers import SAMPLERS, Sampling
from ftl_lightning.igm.settings import ADAPTED, COMBINED, NOT_LEARNED, ONE, VARIATION, InversionSettings, Loss
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.model_config import Prepared
from tests.conftest import succeed

HORIZON, TEXTS = 12, ("left", "right", "up")
ENDS = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "up": (0.0, 1.0), "between": (0.5, 0.5)}


def walks(text: str, count: int, seed: int = 0) -> Demonstrations:
    """Straight paths from a random start, which is observed, and a column that is 0 or 1."""
    rng = np.random.default_rng(seed)
    start, share = rng.uniform(-0.3, 0.3, (count, 1, 2)), np.linspace(0, 1, HORIZON)[None, :, None]
    path = start + share * (np.array(ENDS[text]) + 0.05 * rng.normal(size=(count, 1, 2)))
    grip = np.broadcast_to((share > 0.5).astype(np.float64), (count, HORIZON, 1))
    features = {"start": torch.tensor(start[:, 0], dtype=torch.float32)}
    return Demonstrations.of(list(np.concatenate((path, grip), axis=2)), text, observed=features, state_names=("x", "y", "grip"))


@pytest.fixture(scope="module")
def model() -> FewShot:
    """A model whose network observes the start."""
    return untrained({})


@pytest.fixture(scope="module")
def relative() -> FewShot:
    """A model of plans relative to the start."""
    return untrained({"start": (0, 1)})


def untrained(places: Places) -> FewShot:
    examples = concatenate([walks(text, 4, seed) for seed, text in enumerate(TEXTS)])
    domain = own_domain(examples, TEXTS, HORIZON, {})
    torch.manual_seed(0)
    config = DiffusionConfig(
        domain="own",
        horizon=HORIZON,
        state_dim=3,
        concept_dim=6,
        training_concepts=TEXTS,
        encoder="none",
        denoiser_args={"hidden_dim": 16, "depth": 2, "condition_dim": 8},
        diffusion_steps=10,
        observed={} if places else examples.features,
        places=places,
    )
    seen = None if places else Normalization.fit(examples.observed["start"])
    frames = frames_of(examples, HORIZON, places) if places else None
    prepared = Prepared(config, domain, Normalization.fit(examples.states), torch.randn(4, 6), seen, frames)
    net = GenerativeModel(prepared)
    net.examples = examples
    settings = ModelSettings(InversionSettings().changed(samples=4), 3, Sampling("dpm_solver", 5, 1.0), 1)
    return FewShot(net.requires_grad_(False).eval(), settings)


@pytest.mark.parametrize("discount", [1, 1.0, 0.5, 0.0])
def test_the_loss_of_a_combination_is_the_quadratic_function_of_its_weights(model: FewShot, discount: float) -> None:
    loss = Loss(kind="clean", discount=discount)
    net, few = model.model, walks("between", 3)
    draw = torch.Generator().manual_seed(1)
    draws = net.draws(6, 1.0, draw)
    states, observed = net.windows(few, torch.zeros(6, dtype=torch.int64), torch.zeros(6), draw)
    products = net.products(states, observed, None, draws, loss)
    weights = torch.tensor([0.7, -0.4, 1.3])
    composition = Composition(net.training_embeddings[None, :, None], weights[None])
    direct = net.losses(states, observed, composition, draws, loss)[0]
    linear, square = products[:, 0, 1:] @ weights, torch.einsum("i,sij,j->s", weights, products[:, 1:, 1:], weights)
    torch.testing.assert_close(products[:, 0, 0] - 2 * linear + square, direct, rtol=1e-4, atol=1e-5)


def test_a_combination_is_the_minimum_and_folds_leave_one_out(model: FewShot) -> None:
    few = walks("between", 4)
    combination = Combination.of(model.model, few, model.tuned.inversion)
    assert combination.own < 1
    assert combination.folds.shape == (4, 3)
    assert combination.left_out.shape == (4,)
    single = Combination.of(model.model, few.rows([0]), model.tuned.inversion)
    assert single.folds is None
    assert single.weights.shape == (3,)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_every_sampler_keeps_pinned_states(sampler: str) -> None:
    mask, values = torch.zeros(5, 20, 2, dtype=torch.bool), torch.zeros(5, 20, 2)
    mask[:, 0], mask[:, -1, 0] = True, True
    values[:, 0], values[:, -1] = torch.linspace(-0.5, 0.5, 5)[:, None], 0.7
    draw = torch.Generator().manual_seed(0)

    def noise() -> Tensor:
        return torch.randn(5, 20, 2, generator=draw)

    plans = Sampling(sampler, 10, 1.0).run(lambda x, t: 0.9 * x, noise, cosine_alpha_bar(10), Pinned(mask, values))
    assert torch.equal(plans[mask], values[mask])


def test_the_correction_of_a_pinned_state_fades_and_has_no_step() -> None:
    mask, values = torch.zeros(1, 50, 1, dtype=torch.bool), torch.ones(1, 50, 1)
    mask[:, 0] = True
    moved = Pinned(mask, values)(torch.zeros(1, 50, 1))[0, :, 0]
    assert moved[0] == 1
    assert float(moved.diff().abs().max()) < 0.2
    assert float(moved[20:].abs().max()) < 0.01


def test_the_observed_start_and_pins_are_kept_exactly_and_free_columns_are_free(model: FewShot) -> None:
    observed = walks("up", 6, 5).initial_states
    plans = model.sample(model["up"], observed=observed)
    assert torch.equal(plans.states[:, 0, :2], observed.observed["start"])
    assert set(plans.states[..., 2].unique().tolist()) <= {0.0, 1.0}
    pinned = model.sample(model["up"], observed=observed, pin={-1: [0.25, np.nan, 1.0], 3: np.full((6, 3), 0.5)})
    assert torch.equal(pinned.states[:, -1, 0], torch.full((6,), 0.25))
    assert torch.equal(pinned.states[:, 3], torch.full((6, 3), 0.5))
    assert len(pinned.states[:, -1, 1].unique()) > 1
    for pin, error in (
        ({12: [0, 0, 0]}, "times from -12 to 11"),
        ({0: [0, 0]}, "a state of 3 columns"),
        ({0: [0, np.inf, 0]}, "finite"),
    ):
        with pytest.raises(UserError, match=f"pin.*{error}"):
            model.sample(model["up"], observed=observed, pin=pin)


@pytest.mark.parametrize("form", [COMBINED, *NOT_LEARNED])
def test_forms_that_learn_no_embedding_are_kept_sampled_and_composed(model: FewShot, form: str) -> None:
    learned = model.learn(walks("between", 4), name="between", form=form)
    learned.save("c.safetensors")
    again, fresh = model.load("c.safetensors"), walks("between", 3, 7).initial_states
    first, second = model.sample(learned, observed=fresh).states, model.sample(again, observed=fresh).states
    assert torch.equal(first, second)
    assert torch.equal(first[:, 0, :2], fresh.observed["start"])
    assert (learned.concept.reference is not None) == (form in NOT_LEARNED)
    assert model.sample(again + 0.5 * model["up"], observed=fresh).states.isfinite().all()
    before = Path("c.safetensors").read_bytes()
    Concept.load("c.safetensors").save("c.safetensors")
    assert Path("c.safetensors").read_bytes() == before
    if form == SHIFTED:
        right = fresh.observed["start"] + torch.tensor(ENDS["between"])
        assert float((first[:, -1, :2] - right).norm(dim=1).max()) < 0.3


def test_the_form_of_ones_own_data_is_chosen_by_skill_beside_references(model: FewShot) -> None:
    learned = model.learn(walks("between", 4), name="between")
    choice = learned.concept.choice
    assert set(choice.skills) == {COMBINED, ONE, ADAPTED, KNOWN, VARIED, *NAMES}
    assert choice.form in NOT_LEARNED  # an untrained model is no rival
    assert learned.concept.share == 1
    assert "no learned form adds to varied demonstrations" in choice.because
    assert all(0 < skill < 2 for skill in choice.skills.values())
    assert set(choice.nearer) == set(choice.skills)
    assert all(0 <= share <= 1 for share in choice.nearer.values())
    assert f"{choice.nearer[choice.form]:.2f} of samples nearer to demonstrations than to the {KNOWN}" in choice.words
    assert f"skill {choice.skills[choice.form]:.2f} (without learning: " in str(learned.quality)
    assert f"skill {choice.skills[choice.form]:.2f} ± " in choice.because
    assert model.learn(walks("between", 1), name="between").concept.choice.form == ONE


def test_a_combination_is_explained_by_its_formula(model: FewShot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    training = model.model.training_embeddings
    assert formula(training[[0, 2], None], torch.tensor([0.5, -0.25]), TEXTS, training) == "0.50 left - 0.25 up"
    assert formula(training[[0], None] + 0.1, torch.tensor([0.5]), TEXTS, training) == ""
    learned = model.learn(walks("between", 4), name="between", form=COMBINED)
    model.save_pretrained(tmp_path / "pretrained")
    learned.save(tmp_path / "between.safetensors")
    succeed("explain", "--concept", str(tmp_path / "between.safetensors"), "--pretrained", str(tmp_path / "pretrained"))
    assert "combination of training concepts: " in capsys.readouterr().out


def test_check_tries_sums_of_training_concepts(model: FewShot) -> None:
    report = str(model.check(walks("between", 4), name="between"))
    assert "  sum: " in report
    assert "its weights were not learned from (loss " in report


def test_samples_vary_as_training_concepts_do_by_the_share_of_their_variance(relative: FewShot) -> None:
    variations = relative.model.variations
    assert len(variations) == len(relative.model.examples)
    fresh = walks("between", 200, seed=5).initial_states
    plain, varied = (
        relative.sample(replace(relative["left"], variation=share), observed=fresh.observed, seed=1).states for share in (0.0, 0.2)
    )
    assert torch.equal(varied[:, 0, :2], fresh.observed["start"])
    frames = relative.model.frames[:1].cpu()
    before, after = (relative.model.encode(plans, fresh.observed, frames) for plans in (plain, varied))
    moved, again = after - before, torch.arange(200) % len(variations)
    added, wanted = moved[:, -1, :2].square().mean(), 0.2 * variations.of(before, again)[:, -1, :2].square().mean()
    assert 0.3 < float(added / wanted) < 3  # the correction at the start reaches a little further
    half, more = replace(relative["left"], variation=0.1), replace(relative["up"], variation=0.2)
    assert (more + half).variation == (half + more).variation == 0.2
    assert (2 * half).variation == 0.1


def test_variation_that_does_not_help_is_left_out(relative: FewShot, monkeypatch: pytest.MonkeyPatch) -> None:
    few = walks("between", 5)
    assert relative.learn(few, name="between").concept.variation == VARIATION
    vast = replace(relative.model.variations, shift=relative.model.variations.shift + 100)
    monkeypatch.setattr(relative.model, "variations", vast)
    assert relative.learn(few, name="between").concept.variation == 0


def test_varied_demonstrations_are_scaled_about_their_mean(model: FewShot) -> None:
    few = walks("between", 4)
    setting = Setting.of(model.model.examples, HORIZON)
    for known in (setting, replace(setting, places={}, starts={}, frames=setting.frames[:, :0])):
        wide, narrow = (
            Reference.of(VARIED, few, known, HORIZON, spread).sample(
                {"start": torch.zeros(400, 2)}, 400, torch.Generator().manual_seed(0)
            )
            for spread in (1.0, 0.5)
        )
        torch.testing.assert_close(narrow[:, -1].std(dim=0), wide[:, -1].std(dim=0) / 2)


def test_the_share_of_a_mixture_is_that_with_the_best_score(model: FewShot) -> None:
    few = walks("between", 4)
    left = LeftOut(model.model, few, model.model.examples)
    truth = left.features(left.truth)
    noise = torch.Generator().manual_seed(0)

    def around(offset: float) -> Drawn:
        values = [each[:, None] + offset + torch.randn(4, 16, each.shape[1], generator=noise) for each in truth]
        far = [apart(samples, real) for samples, real in zip(values, truth, strict=True)]
        return Drawn(values, left._mean(far), left._mean([among(samples) for samples in values]))

    low, high = around(-1.0), around(1.0)
    scores = left.mixed(low, high).mean(dim=1)
    assert scores.argmin() == 5
    torch.testing.assert_close(left.mixed(low, high)[[0, -1]].float(), torch.stack((low.score, high.score)))
    both = [torch.cat(pair, dim=1) for pair in zip(low.values, high.values, strict=True)]
    direct = left._mean([apart(samples, real) for samples, real in zip(both, truth, strict=True)])
    assert float(scores[5]) < float(direct.mean())


def test_samples_are_nearer_to_demonstrations_or_to_a_training_concept(model: FewShot) -> None:
    left = LeftOut(model.model, walks("between", 4), model.model.examples)
    values = left.features(left.truth)
    ones = torch.ones(4)

    def at(offsets: Tensor) -> Drawn:
        return Drawn([each[:, None] + offsets[:, None] for each in values], ones, ones)

    training = at(torch.full((16,), 10.0))
    assert left.nearer(at(torch.zeros(16)), training) == 1
    assert left.nearer(training, training) == 0
    assert left.nearer(at(torch.cat((torch.zeros(4), torch.full((12,), 9.0)))), training) == 0.25


def test_a_mixture_has_its_share_of_samples_without_the_model(model: FewShot) -> None:
    concept = model.learn(walks("between", 4), name="between", form=SHIFTED).concept
    half = model._learned(replace(concept, share=0.25))
    half.save("half.safetensors")
    fresh = walks("between", 40, 7).initial_states
    made, mixed = (model.sample(each, observed=fresh).states for each in (model._learned(concept), model.load("half.safetensors")))
    assert int((made == mixed).all(dim=2).all(dim=1).sum()) == 10
    assert torch.equal(mixed[:, 0, :2], fresh.observed["start"])


@pytest.mark.slow
def test_plans_are_learned_relative_to_places_and_come_back(tmp_path: Path) -> None:
    demonstrations = concatenate([walks(name, 12) for name in ENDS if name != "between"])
    demonstrations.save(tmp_path / "walks.npz")
    succeed(
        *("fit", "--config", "conf/own.yaml", "--data.demonstrations", str(tmp_path / "walks.npz"), "--trainer.max_steps", "20"),
        *("--data.metrics", "{}", "--trainer.logger.save_dir", str(tmp_path)),
    )
    model = FewShot.from_pretrained(tmp_path / "own" / "fit" / "pretrained")
    net, few = model.model, walks("between", 4)
    assert dict(net.config.places) == {"start": (0, 1)}
    assert net.frames.shape == (3, 1, 12)
    torch.testing.assert_close(net.frames[:, 0, 0], torch.ones(3), atol=0.05, rtol=0)
    frames = net.frames_of(few)
    observed = few.initial_states.observed
    encoded = net.encode(few.states, observed, frames)
    torch.testing.assert_close(net.decode(encoded, observed, frames), few.states, atol=1e-5, rtol=0)
    learned = model.learn(few, name="between", form=ONE)
    learned.save("c.safetensors")
    fresh = walks("between", 3, 7).initial_states
    plans = model.sample(learned, observed=fresh).states
    assert torch.equal(plans, model.sample(model.load("c.safetensors"), observed=fresh).states)
    far = {"start": fresh.observed["start"] + 100.0}
    moved = model.sample(learned, observed=far).states - plans
    assert float(moved[:, -1, :2].mean()) > 50  # the end follows the start, as in the demonstrations
    both = model["up"] + learned
    share = 1 / float(1 + learned.weights.clamp(min=0).sum())
    torch.testing.assert_close(both.frame, share * model["up"].frame + (1 - share) * learned.concept.frames)
    with pytest.raises(UserError, match="key 'frames': expected shape"):
        net.check_sizes(replace(learned.concept, frames=None))
