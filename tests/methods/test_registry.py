"""Methods are found by the name under which a package offers them, and say which models they adapt."""

from pathlib import Path

import pytest
import torch

from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.settings import AdapterOptions
from ftl_lightning.methods.adaptation import FineTuning, LanguageAdaptation
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.adaptation import Adaptation, LearnerAdaptation
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.inversion_module import InversionModule, adaptation_of
from ftl_lightning.training.method import SHIPPED, Form, Method, kinds, load_method, method_names, method_of, methods
from ftl_lightning.training.model_folder import kinds_for, model_class
from ftl_lightning.training.pretraining import Pretraining
from tests.conftest import ROOT

KINDS = ["diffusion", "bc", "regression", "cvae", "in-context"]
MODULE = """
from ftl_lightning.training.method import SHIPPED, Form, Method, kinds, load_method, method_names, method_of, methods
from ftl_lightning.training.model_folder import kinds_for, model_class
METHOD = Method(name="echo", kind="diffusion")
NOTHING = "a text"
"""
BROKEN = "raise RuntimeError('no luck')"
OFFERED = """[ftl_lightning.methods]
echo = echo_method:METHOD
absent = not_installed_anywhere:METHOD
nameless = echo_method:OTHER
text = echo_method:NOTHING
unlucky = unlucky_method:METHOD
bc = echo_method:METHOD
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package that offers methods, of which one is as it should be."""
    (tmp_path / "echo_method.py").write_text(MODULE)
    (tmp_path / "unlucky_method.py").write_text(BROKEN)
    card = tmp_path / "echo_method-1.0.dist-info"
    card.mkdir()
    (card / "METADATA").write_text("Metadata-Version: 2.1\nName: echo-method\nVersion: 1.0\n")
    (card / "entry_points.txt").write_text(OFFERED)
    monkeypatch.syspath_prepend(tmp_path)


def test_all_are_offered_in_the_order_of_tables() -> None:
    assert SHIPPED == ("ftl_igm", "bc", "regression", "cvae", "in_context", "language", "lora")
    assert method_names()[: len(SHIPPED)] == SHIPPED
    names = [method.name for method in methods()]
    assert len(set(names)) == len(names)
    assert kinds() == KINDS


@pytest.mark.parametrize("name", SHIPPED)
def test_each_has_its_classes(name: str) -> None:
    method = load_method(name)
    assert issubclass(adaptation_of(method), Adaptation)
    assert method.configurations in ("", "conf", f"conf/{name}")
    if method.model is None or method.pretraining is None:
        assert method.kind == "diffusion"
    else:
        assert issubclass(method.model(), ConceptModel)
        assert method_of(method.model().kind) is method
        assert issubclass(method.pretraining(), Pretraining)
        assert model_class(method.kind) is method.model()


def test_a_kind_that_no_package_offers_has_no_model() -> None:
    assert model_class("diffusion") is GenerativeModel
    assert model_class("alchemy") is None


@pytest.mark.parametrize(
    ("adaptation", "expected"),
    [
        (InversionModule, ["diffusion", "bc", "regression", "cvae"]),
        (FineTuning, ["diffusion", "bc", "regression", "cvae"]),  # what it is derived from adapts these
        (LanguageAdaptation, ["diffusion"]),
        (LearnerAdaptation, ["in-context"]),
    ],
)
def test_an_adaptation_adapts_models_of_some_kinds(adaptation: type[Adaptation], expected: list[str]) -> None:
    assert kinds_for(adaptation.adapts) == expected


def test_a_form_is_told_by_the_option_that_decides() -> None:
    method = Method("name", "kind", forms=(Form("with modes", "modes", 1), Form("with knots", "knots", 1)))
    assert method.form({"modes": 1, "knots": 1}) == ""
    assert method.form({"modes": "each", "knots": 1}) == "with modes"
    assert method.form({"modes": 2, "knots": 4}) == "with modes, with knots"


def test_a_package_of_ones_own_offers_a_method_beside_ours_and_never_in_place_of_one(package: None) -> None:
    assert method_names() == (*SHIPPED, "absent", "echo", "nameless", "text", "unlucky")
    assert load_method("echo").name == "echo"
    assert load_method("bc").name == "BC"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("chess", r"method: expected one of ftl_igm, bc, regression, cvae, in_context, language, lora, absent, .*, found 'chess'"),
        ("absent", r"method 'absent': cannot be imported \(ModuleNotFoundError: No module named 'not_installed_anywhere'\); mend"),
        ("nameless", r"method 'nameless': cannot be imported \(AttributeError: .*has no attribute 'OTHER'\); mend its package"),
        ("text", "method 'text': expected a Method, found str; mend its package"),
        ("unlucky", r"method 'unlucky': cannot be imported \(RuntimeError: no luck\); mend its package"),
    ],
)
def test_each_broken_entry_point_is_one_line(name: str, message: str, package: None) -> None:
    with pytest.raises(UserError, match=message) as told:
        load_method(name)
    assert "\n" not in str(told.value)


def test_a_model_that_reads_demonstrations_learns_and_samples_without_a_trainer() -> None:
    learner = FewShot.from_pretrained(ROOT / "pretrained" / "baseline" / "in_context" / "agent")
    shown = learner.domain.source(None).draw("go to bowl", 2, 0)
    learned = learner.learn(shown)
    expected = learner.model.read_concepts(shown)["go to bowl"]
    assert torch.equal(learned.concept.embeddings, expected.embeddings)
    assert learned.concept.weights.tolist() == [1.0, 1.0]
    assert learned.concept.origin.count == 2
    assert torch.equal(learner.learn(shown, steps=9).concept.embeddings, expected.embeddings)
    with pytest.raises(UserError, match="as in-context learns without gradient descent, found samples"):
        learner.learn(shown, samples=3)
    starts = learner.starts("go to bowl", 2)
    found = learner.sample(learned, 2, starts, steps=1)
    assert found.states.shape == (2, learner.model.config.horizon, learner.model.config.state_dim)
    assert found.states.isfinite().all()


def test_an_adaptation_refuses_the_model_of_another_method(shipped: Path) -> None:
    with pytest.raises(UserError, match=r"model\.pretrained: expected a model of kind in-context, found diffusion in"):
        LearnerAdaptation(str(shipped))


def test_fine_tuning_changes_every_branch_whatever_the_adapter_s_options_say() -> None:
    module = FineTuning(str(ROOT / "pretrained" / "agent"), adapter=AdapterOptions(rank=2))
    assert (module.method, module.settings.adapter) == ("LoRA fine-tuning", AdapterOptions(rank=2, scope="all"))
