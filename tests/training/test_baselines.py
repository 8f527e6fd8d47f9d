"""The baselines: their parts against what they should compute, and each configuration from fit to results."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.agent.scenes import FEATURE, OBSERVED
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.adaptation import LanguageAdaptation
from ftl_lightning.methods.bases import StepConfig, added, unroll
from ftl_lightning.methods.bc import CloningConfig, CloningModel, ParallelMLP
from ftl_lightning.methods.cvae import VAEConfig, VAEModel
from ftl_lightning.methods.in_context import InContextConfig, InContextModel
from ftl_lightning.methods.pretraining import InContextPretraining
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.adaptation import LearnerAdaptation
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_config import Prepared
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.training.trainer import Trainer
from tests import tiny as sizes
from tests.conftest import CONF, ROOT, refused, succeed
from tests.domains.mocap_samples import folder

AGENT = {"domain": "agent", "state_dim": 13, "observed": {OBSERVED: FEATURE}, "encoder": "e"}
DOMAIN = load_domain("agent")
DRIVER = ROOT / "pretrained" / "baseline" / "in_context" / "driving"
TEXTS = ("go to red object", "go to bowl")


def limits(columns: int) -> Normalization:
    return Normalization(-torch.ones(columns), torch.ones(columns))


def cloning(**changes: object) -> CloningModel:
    config = {**AGENT, "horizon": 6, "concept_dim": 5, "training_concepts": TEXTS, "view": "steps", "hidden_dim": 8} | changes
    torch.manual_seed(0)
    prepared = Prepared(CloningConfig(**config), DOMAIN, limits(13), torch.randn(3, 5), limits(52))  # type: ignore[arg-type]
    return CloningModel(prepared).eval()


def transformer() -> InContextModel:
    sizes = {"tokens": 3, "width": 16, "layers": 1, "heads": 2, "concept_dim": 3 * 65, "horizon": 6}
    torch.manual_seed(0)
    config = InContextConfig(**AGENT, **sizes, training_concepts=TEXTS, view="steps")  # type: ignore[arg-type]
    return InContextModel(Prepared(config, DOMAIN, limits(13), torch.randn(3, 3 * 65), limits(52))).eval()


def sampled(
    model: ConceptModel, concepts: list[torch.Tensor], initial: torch.Tensor | None, count: int, temperature: float = 0.0
) -> torch.Tensor:
    compositions = [Composition(own[:, None], torch.ones(len(own))) for own in concepts]
    draws = [generator("cpu", number) for number in range(len(concepts))]
    seen = None if initial is None else {OBSERVED: initial}
    return model.sample(compositions, count, Sampling("ddpm", 1, temperature), draws, seen)


def test_networks_side_by_side_are_the_networks_alone() -> None:
    torch.manual_seed(0)
    together = ParallelMLP(3, 4, 8, 2)
    x = torch.randn(5, 4)
    out = together(x[None])
    for member in range(3):
        first, last = nn.Linear(4, 8), nn.Linear(8, 2)
        for layer, depth in ((first, 0), (last, 1)):
            layer.weight.data = together.weights[depth][member].T
            layer.bias.data = together.biases[depth][member, 0]
        assert torch.allclose(out[member], last(torch.relu(first(x))), atol=1e-6)


@pytest.mark.parametrize(("stride", "called"), [(1, 9), (2, 5), (4, 3)])
def test_plans_are_unrolled_state_by_state_and_straight_between(stride: int, called: int) -> None:
    model = cloning(horizon=10, stride=stride)
    seen = []

    def predict(observed: torch.Tensor | None) -> torch.Tensor:
        seen.append(observed[:, :13].clone())
        return torch.stack((torch.zeros(2, 13), torch.full((2, 13), 0.1 * stride)), dim=1)

    initial = torch.randn(2, 52)
    plans = unroll(model, model.config, predict, {OBSERVED: initial})
    expected = initial[:, None, :13] + 0.1 * torch.arange(10)[None, :, None]
    assert torch.allclose(plans, expected, atol=1e-5)
    assert len(seen) == called
    assert all(torch.allclose(one, expected[:, stride * step], atol=1e-5) for step, one in enumerate(seen))


def test_a_plan_that_no_state_can_be_unrolled_from_is_refused() -> None:
    with pytest.raises(UserError, match=r"model.plan_horizon: expected 2 states, and stride 1 \(what domain agent observes"):
        StepConfig(
            **(AGENT | {"observed": {OBSERVED: replace(FEATURE, state=())}}), horizon=3, concept_dim=2, training_concepts=TEXTS
        )  # type: ignore[arg-type]


def test_the_view_in_steps_goes_there_and_back_and_short_windows_start_anywhere_long_ones_early() -> None:
    drives = DOMAIN.source(None).draw("go to bowl", 2, 0)
    states, initial = drives.windows(torch.tensor([0, 1]), torch.tensor([0, 7]), 16)
    view = DOMAIN.plans.views["steps"]
    steps = view.encode(states, initial)
    assert torch.allclose(steps[:, 0], torch.zeros(2, 13), atol=1e-6)
    assert torch.allclose(steps[:, 3], states[:, 3] - states[:, 2])
    assert torch.allclose(view.decode(steps, initial), states, atol=1e-5)
    plans = DOMAIN.plans
    assert [plans.exponent(window) for window in (2, 9, plans.horizon)] == [1.0, 1.0, 3.0]


def test_cloning_and_the_vae_compose_by_adding_and_the_vaes_noise_is_the_temperatures() -> None:
    model = cloning()
    one, other = torch.randn(2, 5)
    initial = torch.randn(4, 52)
    both = sampled(model, [torch.stack((one, other))], initial, 4)
    assert torch.allclose(both, sampled(model, [(one + other)[None]], initial, 4), atol=1e-6)
    assert not torch.allclose(both, sampled(model, [one[None]], initial, 4), atol=1e-3)
    config = {"domain": "object_rearrangement", "state_dim": 21, "encoder": "e", "horizon": 1, "concept_dim": 4, "hidden_dim": 8}
    torch.manual_seed(0)
    own = VAEConfig(**config, training_concepts=("a", "b"))  # type: ignore[arg-type]
    model = VAEModel(Prepared(own, load_domain("object_rearrangement"), limits(21), torch.randn(3, 4))).eval()
    both = sampled(model, [torch.stack((model.concept("a"), model.concept("b")))], None, 3)
    alone = model.plans((model.concept("a") + model.concept("b"))[None], {})
    assert torch.allclose(both[0], model.decode(alone, {}).expand(3, -1, -1), atol=1e-6)
    assert sampled(model, [model.concept("a")[None]], None, 3, temperature=0.5).std(dim=1).max() > 1e-3


def test_in_context_reads_only_the_demonstrations_that_are_given() -> None:
    model = transformer()
    initial = torch.randn(4, 52)
    three, one = torch.randn(3, 3 * 65), torch.randn(1, 3 * 65)
    together = sampled(model, [three, one], initial, 2)  # the second is padded to three
    assert torch.allclose(together[0], sampled(model, [three], initial[:2], 2)[0], atol=1e-5)
    assert torch.allclose(together[1], sampled(model, [one], initial[2:], 2)[0], atol=1e-5)
    apart = torch.stack([sampled(model, [one], start[None], 1)[0, 0] for start in initial[2:]])
    assert torch.allclose(together[1], apart, atol=1e-5)  # queries do not see each other
    assert not torch.allclose(together[1], sampled(model, [three[:1]], initial[2:], 2)[0], atol=1e-3)


def test_bins_are_even_and_prompts_hold_what_was_seen_and_what_followed() -> None:
    model = transformer()
    assert model.bins(torch.tensor([-2.0, -1.0, -0.91, -0.89, 0.0, 0.99, 1.0, 3.0])).tolist() == [0, 0, 0, 1, 10, 19, 19, 19]
    model.config = replace(model.config, stride=2)
    drive = DOMAIN.source(None).draw("go to bowl", 1, 0)
    prompt = model.prompts(drive).unflatten(-1, (3, 65))[0]
    for token, time in enumerate((0, 2, 4)):
        assert torch.allclose(prompt[token, :52], drive.observed[OBSERVED][0, time], atol=1e-5)
        assert torch.allclose(prompt[token, 52:], drive.states[0, time + 2] - drive.states[0, time], atol=1e-5)


QUIET = [*sizes.QUIET, "--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0", "--evaluation.diversity=false"]
BASELINES = sizes.CONFIGURATIONS[len(sizes.OURS) :]
CHEAP = Path("bc/object_rearrangement.yaml")


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("path", "members"),
    [
        *(pytest.param(one, [], marks=[] if one == CHEAP else pytest.mark.slow) for one in BASELINES),
        pytest.param(CHEAP, ["--model.members=2"], marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_every_baseline_from_fit_to_results(path: Path, members: list[str]) -> None:
    domain = path.stem
    steps = ["--data.batch_size=8", "--data.steps_per_epoch=2", "--trainer.max_steps=2"]
    succeed(*sizes.fit(path, *members, *QUIET, *steps, "--model.output=made"))
    model = load_model("made")
    assert load_model("made").hash == model.hash
    assert "root" not in model.config.training["data"]  # no model says where its maker's recordings lay
    concept = model.concept(model.config.training_concepts[0])
    assert concept.isfinite().all()
    assert concept.any()  # a VAE's and a transformer's are made after the fit, not left at zero
    goal = load_domain(domain).concepts.suites["validation"].learned[0]
    demonstrations = ["--data.suite=validation", "--data.demonstrations_per_concept=2"]
    if domain == "driving":  # its expert takes long; any drives will do
        drives = load_domain(domain).source(None).split("train", 2, 0).select("merge")
        replace(drives, concepts=(goal,) * len(drives)).save("drives.safetensors")
        demonstrations = ["--data.demonstrations=drives.safetensors"]
    recorded = ["--data.root=recordings"] if domain == "mocap" else []
    executed = [] if domain == "object_rearrangement" else ["--evaluation.closed_loop=false"]
    adapt = ["--model.pretrained=made", "--data.steps=2", "--evaluation.suites=[validation]", "--evaluation.results=r.csv"]
    succeed("invert", f"--config={CONF / path}", *demonstrations, *recorded, *adapt, *executed, *QUIET, "--model.output=concepts")
    learned = Concept.load(next(Path("concepts").iterdir()))
    assert learned.origin.pretrained == model.hash
    if domain not in ("driving", "tabletop"):  # which judge episodes alone
        own = read_rows("r.csv").query("role == 'method'")
        assert set(own["method"]) == {model.method.name}
        assert set(own["demonstrations"]) == {2}


def test_a_baselines_window_must_hold_a_transition(capsys: pytest.CaptureFixture[str]) -> None:
    expected = "data.horizon: expected 2 (states that a transition spans), found 5"
    refused(capsys, sizes.fit(Path("bc/driving.yaml"), "--data.horizon=5", "--trainer.max_steps=1"), expected)


@pytest.mark.parametrize("method", ["cvae", "in_context"])
def test_a_method_whose_concepts_are_demonstrations_asks_for_one_of_each(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    fit = ["fit", f"--config={CONF / method / 'mocap.yaml'}", f"--data.root={folder(Path('few'))}", "--trainer.max_steps=1", *QUIET]
    refused(capsys, fit, "expected a demonstration of each of 82 training concepts, found none of 78, such as")


def test_the_wrong_verb_is_told() -> None:
    trainer = Trainer(accelerator="cpu", logger=False, max_steps=1)
    drives = load_domain("driving").source(None).split("train", 2, 0).select("merge")
    drives.save("drives.safetensors")
    data = InversionData("driving", demonstrations="drives.safetensors")
    with pytest.raises(UserError, match="expected a module that adapts a pretrained model, found InContextPretraining"):
        trainer.invert(InContextPretraining(), data)  # type: ignore[arg-type]
    adaptation = LearnerAdaptation(str(DRIVER))
    with pytest.raises(UserError, match=r"expected invert \(model.class_path: LearnerAdaptation learns nothing\), found fit"):
        trainer.fit(adaptation, datamodule=data)
    with pytest.raises(UserError, match="key 'per_step': expected every feature to be observed at each time"):
        adaptation.model.read_concepts(replace(drives, observed=drives.initial_states.observed, per_step=()))


def test_concepts_of_other_sizes_that_a_method_reads_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    adaptation = LearnerAdaptation(str(DRIVER))
    drives = load_domain("driving").source(None).split("train", 2, 0).select("merge")
    adaptation.demonstrations = drives
    concept = adaptation.learn()["merge"]
    wide = replace(concept, embeddings=concept.embeddings.repeat(1, 1, 2))
    monkeypatch.setattr(InContextModel, "read_concepts", lambda self, demonstrations: {"merge": wide})
    with pytest.raises(UserError, match="key 'embeddings': expected"):
        adaptation.learn()


def test_prompts_can_hide_the_road() -> None:
    model = load_model(DRIVER)
    assert isinstance(model, InContextModel)
    drives = load_domain("driving").source(None).split("train", 1, 0)
    shown, hidden = (model.prompts(drives, perturbed=hide).unflatten(-1, (model.config.tokens, -1)) for hide in (False, True))
    place = [0, 1, 2, 3]  # of what the view observes: place, and place with what is far squashed
    assert (hidden[..., place] == hidden[0, 0, place]).all()  # nowhere
    assert not (shown[..., place] == hidden[..., place]).all()
    assert torch.allclose(shown[..., 4], hidden[..., 4], atol=1e-5)  # the speed stays


@pytest.mark.slow
def test_language_generates_from_the_description() -> None:
    # In this domain descriptions are the tasks' names, which the table holds: no language model is needed.
    language = [f"--config={CONF / name}" for name in ("agent.yaml", "method/language.yaml")]
    language += [f"--model.pretrained={ROOT / 'pretrained' / 'agent'}", "--model.encoder=table", "--model.output=c"]
    judged = ["--evaluation.suites=[paper]", "--evaluation.closed_loop=false", "--evaluation.results=r.csv"]
    succeed("invert", *language, *judged, *QUIET, "--data.demonstrations_per_concept=1")
    assert set(read_rows("r.csv").query("role == 'method'")["method"]) == {"language"}
    for path in Path("c").iterdir():
        concept = Concept.load(path)
        assert concept.embeddings.shape == (1, 1, 384)
        assert concept.weights.tolist() == [pytest.approx(1.2)]


def test_tasks_are_told_in_the_papers_words_of_which_a_table_knows_no_new_ones(tiny: Path) -> None:
    sentence = load_domain("object_rearrangement").concepts.sentence
    assert sentence("circle diagonal to triangle") == "circle right and above diagonally to triangle"
    ring = "circle triangle and square in a circle of radius 1.67"
    assert sentence(ring.replace("circle triangle", "circle, triangle")) == ring
    assert sentence("square diagonal to triangle and circle above square").endswith("to triangle and circle above square")
    assert DOMAIN.concepts.sentence("go to red bowl") == "go to red bowl"
    module = LanguageAdaptation(str(tiny), encoder="table")
    module.domain = load_domain("object_rearrangement")
    with pytest.raises(UserError, match="'square right and above diagonally to triangle': not in the table"):
        module._embedding("square diagonal to triangle")


def test_models_that_add_concepts_refuse_weights_on_some_columns() -> None:
    part = Composition(torch.zeros(1, 1, 1, 3), torch.ones(1, 1)).on((0,), 4)
    with pytest.raises(UserError, match="expected concepts without '@' for a model that adds them up"):
        added(part)
