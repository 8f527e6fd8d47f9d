"""The few-shot learner in Python."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import ftl_lightning
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.agent.scenes import OBSERVED
from ftl_lightning.domains.domain import Metric
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.few_shot.learner import FewShot, LearnedConcept, ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import file_hash
from ftl_lightning.training.model_config import Prepared
from ftl_lightning.training.quality import judged
from tests.conftest import CONF, ROOT

NEW = "square diagonal to triangle"
KNOWN = "circle right of square"
QUICK: dict[str, Any] = {"sampler": "ddim", "steps": 5}


@pytest.fixture(scope="module")
def scenes() -> FewShot:
    """Object rearrangement."""
    return FewShot.from_pretrained(ROOT / "pretrained" / "object_rearrangement")


@pytest.fixture(scope="module")
def drives() -> FewShot:
    """Navigation."""
    return FewShot.from_pretrained("agent")


@pytest.fixture
def shown(scenes: FewShot) -> Demonstrations:
    """Five demonstrations of a new concept."""
    return scenes.domain.source(None).draw(NEW, 5, 1)


# Loading


def test_a_model_is_found_by_its_name_or_folder_and_brings_its_settings(scenes: FewShot) -> None:
    named = FewShot.from_pretrained("object_rearrangement")
    assert named.model.hash == scenes.model.hash
    assert named.tuned == scenes.tuned
    assert named.domain.name == "object_rearrangement"
    assert KNOWN in named.training_concepts
    assert not any(parameter.requires_grad for parameter in named.model.parameters())
    told = load(CONF / "agent.yaml", "invert")
    learning, evaluation = told["model"]["init_args"], told["evaluation"]
    tuned = FewShot.from_pretrained("agent").tuned
    assert tuned.inversion.omega == learning["omega"]
    assert tuned.inversion.budget.tolerance == learning["budget"]["tolerance"]
    assert tuned.sampling.temperature == evaluation["temperature"]
    assert tuned.learning_steps == told["data"]["init_args"]["steps"]
    assert ftl_lightning.FewShot is FewShot


def test_settings_can_come_from_a_file_of_ones_own(scenes: FewShot) -> None:
    path = ROOT / "pretrained" / "object_rearrangement"
    Path("mine.yaml").write_text("model: {init_args: {components: 3, output: x}}\nevaluation: {steps: 7, samples: 2, replan: 4}\n")
    found = FewShot.from_pretrained(path, settings="mine.yaml")
    assert found.tuned == ModelSettings(InversionSettings(components=3), 400, Sampling(steps=7), 4)
    Path("mine.yaml").write_text("evaluation: {sampler: euler}\n")
    with pytest.raises(UserError, match=r"mine\.yaml: sampler: expected one of ddpm, ddim, dpm_solver, found 'euler'"):
        FewShot.from_pretrained(path, settings="mine.yaml")
    with pytest.raises(UserError, match=r"none\.yaml: expected a configuration file, found nothing"):
        FewShot.from_pretrained(path, settings="none.yaml")


def test_a_model_on_the_hub_is_downloaded_and_a_folder_needs_no_hub(monkeypatch: pytest.MonkeyPatch, scenes: FewShot) -> None:
    asked = []

    def download(repository: str, allow_patterns: list[str]) -> str:
        asked.append((repository, allow_patterns))
        return str(ROOT / "pretrained" / "object_rearrangement")

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert FewShot.from_pretrained("somebody/scenes").model.hash == scenes.model.hash
    assert asked == [("somebody/scenes", ["*.json", "*.safetensors", "*.md"])]

    def offline(repository: str, allow_patterns: list[str]) -> str:
        raise ConnectionError("no network\nat all")

    monkeypatch.setattr("huggingface_hub.snapshot_download", offline)
    with pytest.raises(UserError, match=r"somebody/scenes: expected a folder, .* or one on the Hub, found none \(no network\)$"):
        FewShot.from_pretrained("somebody/scenes")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: pytest.fail("asked the Hub"))
    scenes.save_pretrained("somebody/scenes")
    assert FewShot.from_pretrained("somebody/scenes").model.hash == scenes.model.hash


# Learning


def test_a_concept_is_learned_from_arrays_as_it_is_from_a_file(scenes: FewShot, shown: Demonstrations) -> None:
    settings = replace(scenes.tuned.inversion, seed=3)
    expected = invert(scenes.model, shown, settings, 4)[NEW]
    for states in (shown, shown.states, shown.states.numpy(), list(shown.states), shown.states.tolist()):
        found = scenes.learn(states, name=NEW, steps=4, seed=3, form="paper")
        assert isinstance(found, LearnedConcept)
        assert torch.equal(found.embeddings, expected.embeddings)
        assert torch.equal(found.weights, expected.weights)
        assert found.concept.origin == expected.origin
    other = scenes.learn(shown, steps=4, seed=4, form="paper")
    assert not torch.equal(other.embeddings, expected.embeddings)


@pytest.mark.slow
def test_a_setting_can_be_another(scenes: FewShot, shown: Demonstrations) -> None:
    found = scenes.learn(shown, steps=2, progress=True, components=3, omega="learned")
    assert found.embeddings.shape == (3, 1, 384)
    assert found.concept.origin.weights == "learned"
    assert scenes.learn(shown.states, name="mine", steps=1, form="paper").concept.origin.name == "mine"


def test_demonstrations_of_different_lengths_are_padded_with_their_last_state(drives: FewShot) -> None:
    made = drives.domain.source(None).draw("go to red bowl", 2, 0)
    states = [made.states[0, :30], made.states[1, :50]]
    worlds = [made.observed[OBSERVED][0, :30], made.observed[OBSERVED][1, :50]]
    for observed in (worlds, {OBSERVED: worlds}):
        found = drives.demonstrations(states, observed, "go to red bowl")
        assert found.lengths.tolist() == [30, 50]
        assert found.states.shape == (2, 50, 13)
        assert torch.equal(found.states[0, 30:], made.states[0, 29:30].expand(20, -1))
        assert found.per_step == (OBSERVED,)
        assert torch.equal(found.observed[OBSERVED][1], worlds[1])
        assert found.concepts == ("go to red bowl",) * 2
    first = drives.demonstrations(states, torch.stack([world[0] for world in worlds]))
    assert first.per_step == ()
    assert torch.equal(first.observed[OBSERVED], made.observed[OBSERVED][:, 0])


# Concepts


def test_training_and_learned_concepts_compose_in_python_and_in_words(scenes: FewShot, shown: Demonstrations) -> None:
    learned = scenes.learn(shown, steps=1)
    learned.save("mine.safetensors")
    assert torch.equal(Concept.load("mine.safetensors").embeddings, learned.embeddings)
    again = scenes.load("mine.safetensors")
    assert again.concept.origin == learned.concept.origin
    known = scenes[KNOWN]
    assert known.weights.tolist() == [1]
    both = 1.2 * known + 0.5 * learned
    told = scenes.compose(f"{KNOWN}:1.2 + mine.safetensors:0.5")
    assert torch.equal(told.embeddings, both.embeddings)
    assert torch.equal(told.weights, both.weights)
    assert torch.equal(scenes.compose(KNOWN).embeddings, known.embeddings)
    assert "square" in str(learned.explain()) or "circle" in str(learned.explain())


def test_concepts_that_are_none_or_anothers_are_told(scenes: FewShot, drives: FewShot, shown: Demonstrations) -> None:
    scenes.learn(shown, steps=1, form="paper").save("mine.safetensors")
    with pytest.raises(UserError, match=r"mine\.safetensors: key 'domain': expected 'agent' \(the pretrained model's\)"):
        drives.load("mine.safetensors")
    near = "concept 'circle': expected a training concept of the model: .*circle above square; .* nearest of 12; list all: python"
    with pytest.raises(UserError, match=near):
        scenes["circle"]


# Sampling, judging, drawing


def test_samples_are_the_models_and_a_seed_repeats_them(scenes: FewShot) -> None:
    composition = 1.2 * scenes[KNOWN]
    found = scenes.sample(composition, 4, seed=7, **QUICK, temperature=0.5)
    expected = scenes.model.sample([composition], 4, Sampling("ddim", 5, 0.5), [generator("cpu", 7)])[0]
    assert torch.equal(found.states, expected)
    assert torch.equal(scenes.sample(composition, 4, seed=7, **QUICK, temperature=0.5).states, expected)
    assert not torch.equal(scenes.sample(composition, 4, seed=8, **QUICK, temperature=0.5).states, expected)
    found.save("plans.safetensors")
    again = Demonstrations.load("plans.safetensors")
    assert again.provenance == {"pretrained": scenes.model.hash, "seed": 7, "temperature": 0.5}
    assert again.observed == {}


def test_plans_are_judged_and_drawn_by_a_goal(scenes: FewShot) -> None:
    source = scenes.domain.source(None)
    right, wrong = source.draw(KNOWN, 3, 0), source.draw("square right of circle", 1, 0)
    both = replace(right, states=torch.cat((right.states, wrong.states)), lengths=torch.ones(4).long(), concepts=("",) * 4)
    assert scenes.evaluate(both, KNOWN) == {"accuracy": pytest.approx(0.75)}
    assert scenes.evaluate(both, f"{KNOWN} and {KNOWN}") == {"accuracy": pytest.approx(0.75)}  # any goal that can be read
    scenes.render(both, KNOWN).savefig("f.png", dpi=100)
    pixels = np.asarray(Image.open("f.png").convert("RGB")).reshape(-1, 3).astype(int)
    green, red = ((np.abs(pixels - colour).sum(axis=1) < 12).sum() for colour in ((46, 158, 70), (208, 58, 58)))
    assert green > 2 * red > 0
    assert scenes.render(both).get_suptitle() == "samples"


def test_plans_to_which_a_metric_does_not_apply_are_left_out_of_its_mean(scenes: FewShot) -> None:
    plans = scenes.domain.source(None).draw(KNOWN, 4, 0)
    measures = {"some": [1.0, math.nan, 0.0, math.nan], "none": [math.nan] * 4, "right": [True, True, True, False]}
    metrics = {name: Metric(lambda goal, states, starts, values=values: torch.tensor(values)) for name, values in measures.items()}
    assert judged(replace(scenes.domain, metrics=metrics), plans, KNOWN) == {"some": 0.5, "right": 0.75}


@pytest.mark.slow
def test_plans_start_where_they_are_told_to(drives: FewShot) -> None:
    starts = drives.starts("go to bowl", 3, seed=5)
    assert torch.equal(starts.require_scenes(), drives.starts("go to bowl", 3, seed=5).require_scenes())
    world, concept = starts.observed[OBSERVED], drives["go to bowl"]
    plans = drives.sample(concept, observed=starts, **QUICK)
    assert plans.states.shape == (3, 128, 13)  # one from each start
    assert torch.equal(drives.sample(concept, 3, starts, **QUICK).states, plans.states)
    with pytest.raises(UserError, match=r"count: expected 3 \(a plan for each of the starts\), or none, found 99"):
        drives.sample(concept, 99, starts, **QUICK)
    for goal in ("go to nowhere", "Go to bowl", ""):
        with pytest.raises(UserError, match=r"goal: expected a task of agent, such as "):
            drives.starts(goal)
    assert torch.equal(plans.initial_states.observed[OBSERVED], world)
    for observed in (world, world.numpy(), world.tolist(), {OBSERVED: world.numpy()}, InitialStates({OBSERVED: world})):
        assert torch.equal(drives.sample(concept, observed=observed, **QUICK).states, plans.states)
    assert set(drives.evaluate(plans, "go to bowl")) == {"accuracy"}
    assert len(drives.render(plans, "go to bowl").axes) == 3
    plans.save("plans.safetensors")
    assert torch.equal(Demonstrations.load("plans.safetensors").initial_states.require_scenes(), starts.require_scenes())


# Executing


@pytest.mark.slow
def test_a_concept_is_executed_in_the_domains_environment(drives: FewShot) -> None:
    goal = "go to bowl"
    starts, concept = drives.starts(goal, 2, seed=1), 1.2 * drives[goal]
    done = drives.execute(concept, starts, goal, replan=64, **QUICK)
    assert done.rollout.observed[OBSERVED].shape == (2, 129, 52)
    assert not done.rollout.failed.any()
    assert set(done.outcomes) == {"success", "distractor", "progress"}
    assert all(value in (0, 0.5, 1) for value in done.outcomes.values())
    again = drives.execute(concept, starts.require_scenes().numpy(), replan=64, **QUICK)  # scenes alone, and no goal
    assert torch.equal(again.rollout.observed[OBSERVED], done.rollout.observed[OBSERVED])
    assert again.outcomes == {}
    done.save("episode.gif", episode=1)
    with Image.open("episode.gif") as animation:
        assert animation.n_frames > 2
        told = animation.size
    again.save("silent.gif", episode=1)
    with Image.open("silent.gif") as animation:
        assert animation.size[1] < told[1]  # without a caption
    assert len(done.frames()) > 2
    with pytest.raises(UserError, match=r"episode\.mp4: expected a name that ends in \.gif, found \.mp4"):
        done.save("episode.mp4")
    with pytest.raises(UserError, match="episode: expected one of 2 that began, found 2"):
        done.frames(2)


@pytest.mark.slow
def test_a_concept_is_executed_in_another_environment_of_the_domain() -> None:
    few = FewShot.from_pretrained("driving")
    starts, concept, goal = few.starts("roundabout", 4), 2.0 * few["merge"], "roundabout"
    own, other = (few.execute(concept, starts, goal, environment=name).rollout.observed["traffic"] for name in ("", "step veto"))
    assert not torch.equal(own, other)
    with pytest.raises(UserError, match="environment: expected simulation veto or step veto, found 'luck'"):
        few.execute(concept, starts, goal, environment="luck")


# Keeping and sharing


def test_a_model_is_written_with_a_card_that_is_not_replaced(scenes: FewShot) -> None:
    scenes.save_pretrained("copy")
    card = Path("copy/README.md").read_text()
    assert card.startswith("---\nlibrary_name: ftl-lightning\n")
    assert scenes.model.hash in card
    assert all(f"- {text}\n" in card for text in scenes.training_concepts)
    Path("copy/README.md").write_text("mine")
    scenes.save_pretrained("copy")
    assert Path("copy/README.md").read_text() == "mine"
    again = FewShot.from_pretrained("copy")
    assert again.model.hash == scenes.model.hash
    one, other = (model.sample(scenes[KNOWN], 2, **QUICK).states for model in (again, scenes))
    assert torch.equal(one, other)


def test_a_model_is_uploaded_with_its_card(scenes: FewShot, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []

    class Hub:
        def create_repo(self, repository: str, private: bool, exist_ok: bool) -> None:
            calls.append((repository, private, exist_ok))

        def upload_folder(self, repo_id: str, folder_path: str) -> str:
            calls.append((repo_id, {path.name: file_hash(path) for path in Path(folder_path).iterdir()}))
            return f"https://hub/{repo_id}"

    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    assert scenes.push_to_hub("somebody/scenes", private=True) == "https://hub/somebody/scenes"
    created, (repository, files) = calls  # type: ignore[misc]
    assert (created, repository) == (("somebody/scenes", True, True), "somebody/scenes")
    assert set(files) == {"config.json", "model.safetensors", "README.md"}
    assert files["model.safetensors"] == scenes.model.hash


# Data of one's own


def walks(text: str, up: float, count: int = 3) -> Demonstrations:
    states = torch.linspace(0, 1, 8)[None, :, None] * torch.tensor([1.0, up]) + 0.01 * torch.arange(count)[:, None, None]
    return Demonstrations(states, torch.full((count,), 8), "", ("x", "y"), ("m", "m"), (text,) * count)


def test_plans_of_ones_own_data_are_judged_by_what_was_shown() -> None:
    from ftl_lightning.data.demonstrations import concatenate

    examples = concatenate([walks("flat", 0.0), walks("steep", 2.0)])
    texts, judged = ("flat", "steep"), {"nearest_demonstration": 1.0, "dtw_to_demonstrations": 1.0}
    config = DiffusionConfig(
        domain="own",
        horizon=8,
        state_dim=2,
        concept_dim=6,
        training_concepts=texts,
        encoder="none",
        denoiser_args={"hidden_dim": 16, "depth": 1, "condition_dim": 8},
        diffusion_steps=10,
        metrics=judged,
    )
    torch.manual_seed(0)
    limits = Normalization(torch.zeros(2), torch.tensor([1.0, 2.0]))
    net = GenerativeModel(Prepared(config, own_domain(examples, texts, 8, judged), limits, torch.randn(3, 6)))
    net.examples = examples
    model = FewShot(
        net.requires_grad_(False).eval(), ModelSettings(InversionSettings().changed(samples=4), 2, Sampling(steps=5), 1)
    )
    between = walks("between", 1.0)
    with pytest.raises(UserError, match=r"goal: expected a task of own, such as .*, found 'between'; a new concept of your own"):
        model.evaluate(between, "between")
    assert model.evaluate(examples.select("steep"), "steep")["nearest_demonstration"] == 1
    learned = model.learn(between.states, name="between")
    assert learned.concept.origin.count == 3
    found = model.evaluate(between, "between")
    assert found == {"nearest_demonstration": 1, "dtw_to_demonstrations": pytest.approx(0, abs=1e-5)}
    assert model.evaluate(between, "steep")["nearest_demonstration"] == 0
    assert model.sample(learned, 3).states.shape == (3, 8, 2)
    assert len(model.render(model.sample(learned, 3), "between").axes) == 3
    model.save_pretrained("mine")
    Path("invert.yaml").write_text("evaluation: {steps: 5}\n")
    again = FewShot.from_pretrained("mine", settings="invert.yaml")
    assert again.evaluate(examples.select("flat"), "flat")["nearest_demonstration"] == 1


# Modes


def test_a_concept_with_modes_is_learned_kept_and_told_of(scenes: FewShot, shown: Demonstrations) -> None:
    learned = scenes.learn(shown, steps=3, modes="each")
    assert learned.modes is not None
    assert learned.modes.embeddings.shape == (5, 2, 1, 384)
    assert repr(learned).startswith(f"LearnedConcept('{NEW}', K = 2, 5 modes, loss 0.")
    mixed = replace(learned.concept, modes=replace(learned.modes, mixed=True))
    mixed.save("mixed.safetensors")
    assert repr(scenes.load("mixed.safetensors")).startswith(f"LearnedConcept('{NEW}', K = 2, 5 modes, mixed, loss 0.")
    learned.save("mine.safetensors")
    again = scenes.load("mine.safetensors")
    assert torch.equal(scenes.sample(again, 3, **QUICK).states, scenes.sample(learned, 3, **QUICK).states)
    assert scenes.learn(shown, steps=1, modes=1).modes is None
    assert "modes" not in repr(scenes.learn(shown, steps=1, form="paper"))


def test_modes_generate_alone_and_the_centre_in_company(scenes: FewShot, shown: Demonstrations) -> None:
    learned = scenes.learn(shown, steps=3, modes="each", learning_rate=1.0)
    learned.save("mine.safetensors")
    replace(learned.concept, modes=None).save("centre.safetensors")
    centre = scenes.load("centre.safetensors")
    assert centre.modes is None

    def states(concept: Composition) -> torch.Tensor:
        return scenes.sample(concept, 6, **QUICK).states

    assert not torch.equal(states(learned), states(centre))
    assert torch.equal(states(learned + scenes[KNOWN]), states(centre + scenes[KNOWN]))
    assert torch.equal(states(scenes.compose("mine.safetensors:1.5")), states(1.5 * learned))
    assert torch.equal(states(scenes.compose(f"mine.safetensors + {KNOWN}")), states(centre + scenes[KNOWN]))


@pytest.mark.slow
def test_a_learner_with_a_tolerance_stops_by_itself(
    scenes: FewShot, shown: Demonstrations, capsys: pytest.CaptureFixture[str]
) -> None:
    found = scenes.learn(shown, steps=150, progress=True, tolerance=0.5, samples=8, form="paper")
    told = capsys.readouterr().err
    assert f"learning '{NEW}'" in told
    settings = scenes.tuned.inversion.changed(tolerance=0.5, samples=8)
    losses: list[float] = []
    expected = invert(scenes.model, shown, settings, 150, losses.append)[NEW]
    assert 20 <= len(losses) < 150
    assert torch.equal(found.embeddings, expected.embeddings)
