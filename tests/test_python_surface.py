"""What people meet in Python: what can be imported, what objects say of themselves, devices, batches, and mistakes in one line."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import ftl_lightning
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.agent.scenes import OBSERVED
from ftl_lightning.domains.driving.traffic import SHIPPED
from ftl_lightning.few_shot.learner import FewShot, LearnedConcept
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.explanation import explain
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.shipped import TOPICS, list_models, pretrained_folder
from ftl_lightning.training.checks import longer_than_plans
from tests.conftest import python
from tests.test_mistakes import refusal

GOAL, SCENE = "go to bowl", "circle above square"
QUICK: dict[str, Any] = {"sampler": "ddim", "steps": 3}
SCENES = np.zeros((3, 1, 21))
AGENT, OTHER = "agent (hash d7a9bd82a38b318c)", "object_rearrangement (hash ea5aa92a1ef3e100)"


class Things(NamedTuple):
    """What the tests talk about; nothing changes it."""

    agent: FewShot
    scenes: FewShot
    five: Demonstrations
    learned: LearnedConcept
    starts: InitialStates
    plans: Demonstrations


@pytest.fixture(scope="module")
def things() -> Things:
    agent, scenes = FewShot.from_pretrained("agent"), FewShot.from_pretrained("object_rearrangement")
    five = scenes.domain.source(None).draw("square diagonal to triangle", 5, 1)
    learned = scenes.learn(five, steps=2, modes="each")
    plans = scenes.sample(scenes[SCENE], 4, **QUICK)
    return Things(agent, scenes, five, learned, agent.starts(GOAL, 3), plans)


# What can be imported


def test_the_package_shows_what_it_offers_before_anything_is_imported_and_its_models_load() -> None:
    offered = {"Composition", "Concept", "Demonstrations", "FewShot", "__version__", "list_models"}
    done = python("-c", "import json, sys, ftl_lightning as f; print(json.dumps([dir(f), f.list_models(), [*sys.modules]]))")
    assert done.returncode == 0, done.stderr
    names, models, modules = map(set, json.loads(done.stdout))
    assert offered <= names
    assert "agent" in models
    assert not {"torch", "numpy"} & modules | {"TYPE_CHECKING"} & names
    assert all(getattr(ftl_lightning, name) is not None for name in offered)
    assert ftl_lightning.Composition is Composition
    assert ftl_lightning.Concept is Concept
    with pytest.raises(AttributeError, match=r"no attribute 'Fewshot'; it offers .*FewShot"):
        _ = ftl_lightning.Fewshot  # type: ignore[attr-defined]
    assert {"agent", "driving", "object_rearrangement"} <= set(list_models())
    assert not any("/" in name for name in list_models())
    assert {"baseline/bc/agent", *list_models()} <= set(list_models(baselines=True))
    for topic, name in TOPICS.items():
        assert (pretrained_folder(topic) / "config.json").samefile(pretrained_folder(name) / "config.json")
    assert FewShot.from_pretrained("baseline/bc/object_rearrangement").domain.name == "object_rearrangement"


# What objects say of themselves


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (lambda of: of.agent, ["FewShot('agent', ", "4 training concepts", "4,351,253 parameters", "d7a9bd82a38b318c", "on cpu"]),
        (lambda of: of.agent.model, ["GenerativeModel('agent', ", "hash d7a9bd82a38b318c"]),
        (lambda of: of.agent.domain, ["Domain('agent', plans of 128 states of 13 columns", "world (52,)", "accuracy", "128 steps"]),
        (lambda of: of.scenes.domain, ["Domain('object_rearrangement', plans of 1 state of 21 columns, 12 training concepts"]),
        (lambda of: of.learned, ["LearnedConcept('square diagonal to triangle', K = 2, 5 modes, loss ", "weights ", OTHER]),
        (lambda of: of.learned.concept, ["Concept('square diagonal to triangle', K = 2, 5 modes, loss ", "from 5 demonstrations"]),
        (lambda of: of.learned.modes, ["Modes(5 modes, K = 2)"]),
        (lambda of: of.agent[GOAL] + 0.8 * of.agent[GOAL], [f"Composition(K = 2, weights 1.00, 0.80, of {AGENT})"]),
        (lambda of: Composition(torch.zeros(9, 2, 1), torch.ones(9)), ["K = 9, 2 knots", "1.00, ..., of any model"]),
        (lambda of: of.starts, ["InitialStates(world (3, 52), scenes (3, 52))"]),
        (lambda of: of.plans, ["Demonstrations('object_rearrangement', states (4, 1, 21))"]),
        (
            lambda of: of.agent.domain.source(None).draw(GOAL, 2, 0),
            ["states (2, 150, 13), lengths ", f"'{GOAL}', world (2, 150, 52)"],
        ),
        (
            lambda of: of.agent.execute(of.agent[GOAL], of.starts, GOAL, replan=64, **QUICK),
            ["Execution('agent', 3 episodes, ", "success"],
        ),
    ],
)
def test_objects_say_in_one_line_what_they_are(things: Things, chosen: Callable[[Things], Any], words: list[str]) -> None:
    found = chosen(things)
    told, shown = repr(found), found._repr_html_()
    assert len(told) <= LONGEST
    assert "\n" not in told
    assert "tensor(" not in told
    assert [word for word in words if word not in told] == []
    assert len(shown) < 1000
    assert shown.count("<li>") >= 2 == shown.count("<ul>") + shown.count("</ul>")


def test_names_from_files_stand_for_themselves_in_a_notebook(things: Things) -> None:
    origin = replace(things.learned.concept.origin, name="<script>alert('&')</script>" + "x" * 1000 + "\x1b[2J")
    concept = replace(things.learned.concept, origin=origin)
    assert "<script" not in concept._repr_html_()
    assert "&lt;script&gt;alert(&#x27;&amp;" in concept._repr_html_()
    assert "\x1b" not in concept._repr_html_() + repr(concept)
    assert len(repr(concept)) <= LONGEST


# What is not explained


def test_an_explanation_ends_with_what_is_not_explained(things: Things) -> None:
    training = torch.eye(4, 6)
    half = explain(torch.tensor([1.0, 0, 0, 0, 3.0, 0]), "abcd", training)
    assert half.unexplained == pytest.approx(0.9)  # 9 of the squared length 1 + 9
    assert half.unexplained == pytest.approx(1 - half.explained)
    sentence = "; not explained: 90 % of its squared length, which no non-negative combination of training concepts holds"
    assert str(half).endswith(sentence)
    assert "not explained: 0 % " in str(explain(training[1], "abcd", training))
    assert "not explained: 100 % " in str(explain(-training[1], "abcd", training))
    many = explain(torch.ones(40), [f"c{number}" for number in range(40)], torch.eye(40))
    assert len(many.combination) == 40
    assert str(many).count("1.00 c") == 12
    assert " + 28 smaller ones (explains 1.00); not explained: 0 % " in str(many)
    learned = things.learned.explain()
    assert f"not explained: {100 * (1 - learned.explained):.0f} % of its squared length" in str(learned)


# Devices and batches


def test_a_model_is_moved_and_says_where_it_is_and_a_device_that_fails_is_not_told_to_be_absent(
    things: Things, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert things.agent.to("cpu") is things.agent
    assert things.agent.device == torch.device("cpu")
    asked = []
    monkeypatch.setattr(things.agent.model, "to", asked.append)
    assert things.agent.to(torch.device("cpu")) is things.agent
    assert asked == [torch.device("cpu")]

    def full(*size: int, **options: object) -> torch.Tensor:
        raise RuntimeError("out of memory\nand more lines")

    monkeypatch.setattr(torch, "ones", full)
    with pytest.raises(UserError, match=r"^device: expected cpu to compute, found that it cannot: out of memory$"):
        things.scenes.to("cpu")


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
@pytest.mark.parametrize("size", [1, 3, 100])
def test_plans_do_not_depend_on_the_size_of_a_batch(things: Things, sampler: str, size: int) -> None:
    scenes, agent, most = things.scenes, things.agent, []
    sample, model = scenes.model.sample, scenes.model

    def counted(compositions: list[Composition], count: int, *rest: Any) -> torch.Tensor:
        most.append(len(compositions) * count)
        return sample(compositions, count, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "sample", counted)
        for concept in (scenes[SCENE], things.learned):  # with modes too, which are drawn
            most.clear()
            whole = scenes.sample(concept, 7, seed=3, sampler=sampler, steps=4).states
            split = scenes.sample(concept, 7, seed=3, sampler=sampler, steps=4, batch_size=size).states
            assert torch.allclose(split, whole, atol=1e-2)
            assert most == [7, *([size] * (7 // size) + [7 % size] * (7 % size > 0) if size < 7 else [7])]
    started = agent.sample(agent[GOAL], observed=things.starts, sampler=sampler, steps=3)
    again = agent.sample(agent[GOAL], observed=things.starts, sampler=sampler, steps=3, batch_size=size)
    assert torch.allclose(again.states, started.states, atol=1e-3)
    assert not torch.allclose(again.states[0], again.states[1], atol=1e-1)
    assert torch.equal(again.observed[OBSERVED], started.observed[OBSERVED])


def test_a_bar_changes_no_plan(things: Things, capsys: pytest.CaptureFixture[str]) -> None:
    plain = things.scenes.sample(things.learned, 5, sampler="ddpm", steps=4).states
    shown = things.scenes.sample(things.learned, 5, sampler="ddpm", steps=4, progress=True).states
    assert torch.equal(plain, shown)
    assert "5 plans: 4 steps" in capsys.readouterr().err
    things.scenes.sample(things.learned, 5, sampler="ddpm", steps=4, batch_size=2, progress=True)
    assert "5 plans: 12 steps" in capsys.readouterr().err
    other = FewShot.from_pretrained("baseline/cvae/object_rearrangement")  # without a sampler
    one, two = (other.sample(other[SCENE], 5, batch_size=size, progress=True).states for size in (None, 2))
    assert torch.equal(one, two)
    assert "5 plans: 1 step, " in capsys.readouterr().err


def test_a_sample_with_modes_and_columns_is_drawn_whole() -> None:
    modes = Modes(torch.randn(3, 2, 1, 4), torch.rand(3, 2))
    own = Composition(torch.randn(2, 1, 4), torch.ones(2), modes=modes).on((1,), 5)
    found = own.drawn(generator("cpu", 0))
    assert found.columns is not None
    assert found.columns.shape == (2, 5)
    assert found.columns.sum(dim=0).tolist() == [0, 2, 0, 0, 0]


# Mistakes


def test_a_concept_keeps_where_it_comes_from(things: Things) -> None:
    scenes, learned = things.scenes, things.learned
    for concept in (
        scenes[SCENE],
        learned,
        learned + scenes[SCENE],
        2 * learned,
        -learned,
        learned - scenes[SCENE],
        learned.on((0, 1), 21),
        learned.to(torch.device("cpu")),
        learned.concept.composition,
        scenes.compose(f"{SCENE}:1.2 + {SCENE}"),
        Composition(learned.embeddings, learned.weights) + learned,
    ):
        assert concept.space == OTHER
        with refusal(f"sample: expected a concept of this model, {AGENT}, found one of"):
            things.agent.sample(concept, observed=things.starts)
    unknown = Composition(learned.embeddings, learned.weights)
    known = replace(unknown, space=OTHER)
    assert torch.equal(scenes.sample(unknown, 2, **QUICK).states, scenes.sample(known, 2, **QUICK).states)
    again = FewShot.from_pretrained("object_rearrangement")  # the same model, loaded anew
    assert torch.equal(again.sample(learned, 2, **QUICK).states, scenes.sample(learned, 2, **QUICK).states)


WRONG: list[tuple[Callable[[Things], Any], str]] = [
    (
        lambda of: of.agent.sample(of.scenes[SCENE], observed=of.starts),
        f"sample: expected a concept of this model, {AGENT}, found one of {OTHER}",
    ),
    (lambda of: of.agent.sample(of.learned), f"found one of {OTHER}"),
    (lambda of: of.agent.execute(of.scenes[SCENE], of.starts), f"execute: expected a concept of this model, {AGENT}"),
    (
        lambda of: of.agent[GOAL] + of.scenes[SCENE],
        f"compose: expected concepts of one model, found one of {AGENT} and one of {OTHER}",
    ),
    (lambda of: of.learned - of.agent[GOAL], "compose: expected concepts of one model"),
    (
        lambda of: of.scenes.sample(Composition(torch.ones(1, 1, 5), torch.ones(1))),
        "with embeddings (K, knots, 384), found (1, 1, 5)",
    ),
    (
        lambda of: of.agent.evaluate(of.plans, GOAL),
        "evaluate: expected behaviour of agent, the model's domain, found that of object_rearrangement",
    ),
    (lambda of: of.agent.render(of.plans), "render: expected behaviour of agent"),
    (lambda of: of.agent.learn(of.five), "states: expected behaviour of agent"),
    (lambda of: of.scenes[SCENE] + SCENE, f"expected a concept on each side of '+' and '-', found '{SCENE}'; model[text] is one"),
    (lambda of: of.scenes[SCENE] - 3, "expected a concept on each side of '+' and '-', found 3"),
    (lambda of: of.scenes[SCENE] * "2", "expected a number to multiply a concept with, found '2'"),
    (lambda of: float("nan") * of.scenes[SCENE], "weight: expected a finite number, found nan"),
    (lambda of: FewShot.from_pretrained("objectrearrangement"), "did you mean object_rearrangement"),
    (lambda of: FewShot.from_pretrained("pretrained/agnt"), "did you mean agent? shipped models: ftl_lightning.list_models()"),
    (
        lambda of: FewShot.from_pretrained("chess"),
        "agent, driving, driving_wide, mocap, mocap_root, object_rearrangement, strokes, tabletop, tabletop_wide ship",
    ),
    (lambda of: FewShot.from_pretrained("/nowhere/at/all"), "config.json: expected a pretrained model, found nothing"),
    (lambda of: FewShot.from_pretrained("./mine/model"), "config.json: expected a pretrained model, found nothing"),
    (lambda of: FewShot.from_pretrained(3), "name: expected the name of a model, such as agent, driving"),
    (lambda of: FewShot.from_pretrained("agent", settings=3), "settings: expected a configuration file of invert, found 3"),
    (lambda of: FewShot.from_pretrained("agent", device="meta"), "device: expected one that this machine has, cpu"),
    (lambda of: of.scenes.to("foo"), "device: expected one that this machine has, cpu"),
    (lambda of: of.agent["go to bowll"], "concept 'go to bowll': expected a training concept of the model: go to bowl; "),
    (lambda of: of.agent.compose("go to bowll:1.2"), "list all: python -m ftl_lightning concepts MODEL"),
    (lambda of: of.scenes.compose(""), "concept, compose: expected a learned concept, training concepts or both, found neither"),
    (lambda of: of.scenes.compose("none.safetensors:2"), "none.safetensors: expected a concept file, found nothing"),
    (lambda of: of.agent[3], "concept 3: expected a training concept"),
    (lambda of: of.agent.compose(3), "compose: expected a text, such as 'go to red object"),
    (lambda of: of.agent.load(3), "path: expected the file of a learned concept, its folder or 'owner/name' on the Hub, found 3"),
    (lambda of: of.scenes.learn(of.five, adapter=True), "learn: adapter: expected a whole number, found True"),
    (
        lambda of: of.scenes.learn(of.five, lr=3),
        "learn: expected components, omega, form, initial_omega, off_span, initial_spread, start, restarts, "
        "... (or steps, seed, progress, watch), found 'lr'; model.tuned shows all settings; "
        "did you mean learning_rate?",
    ),
    (lambda of: of.scenes.learn(of.five, components=0), "model.components: expected 1 or more, found 0"),
    (lambda of: of.scenes.learn(of.five, modes="some"), "model.modes.sets: expected a number, 'each' or 'auto', found 'some'"),
    (lambda of: of.scenes.learn(of.five, tolerance=1), "model.budget.tolerance: expected null or a share from 0 up to 1, found 1"),
    (lambda of: of.scenes.learn(of.five, components="two"), "learn: components: expected a whole number, found 'two'"),
    (lambda of: of.scenes.learn(of.five, modes=2.5), "modes: expected a whole number or 'each' or 'auto', found 2.5"),
    (lambda of: of.scenes.learn(of.five, steps=0), "steps: expected 1 or more, found 0"),
    (lambda of: of.scenes.learn(of.five, steps=2.5), "steps: expected a whole number, 1 or more, found 2.5"),
    (lambda of: of.scenes.learn(of.five, seed="x"), "seed: expected a whole number, 0 or more, found 'x'"),
    (lambda of: of.scenes.learn(of.five, name=3), "name: expected a text"),
    (
        lambda of: of.scenes.sample("text"),
        "sample: expected a concept, such as model['circle right of triangle'], model.compose(text), model.load(path) or what "
        "model.learn returns, found 'text'",
    ),
    (
        lambda of: of.scenes.sample(of.scenes[SCENE], num_inference_steps=3),
        "sample: expected sampler, steps, temperature (or count, observed, seed, pin, batch_size, progress), "
        "found 'num_inference_steps'; model.tuned shows all settings; did you mean steps?",
    ),
    *((lambda of, n=n: of.scenes.sample(of.scenes[SCENE], steps=n), f"steps: expected 1 or more, found {n}") for n in (0, -1)),
    (lambda of: of.scenes.sample(of.scenes[SCENE], steps=101), "steps: expected 1 to 100 (the model's T), found 101"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], sampler="euler"), "sampler: expected one of"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], temperature=-1.0), "temperature: expected 0 or more"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], observed=np.zeros((2, 3))), "observed: expected features by name"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], steps=2.5), "steps: expected a whole number, found 2.5"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], temperature="warm"), "temperature: expected a number, found 'warm'"),
    (lambda of: of.scenes.library("nowhere"), "folder: expected a folder of learned concepts, found nothing"),
    (lambda of: of.scenes.library(3), "folder: expected a folder of learned concepts, found 3"),
    (lambda of: of.learned.push_to_hub(3), "repository: expected a name on the Hub, such as 'owner/name'"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], count=0), "count: expected 1 or more, found 0"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], 0.5), "count: expected a whole number, 1 or more, found 0.5"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], batch_size=0), "batch_size: expected 1 or more, found 0"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], seed=-1), "seed: expected 0 or more, found -1"),
    (lambda of: of.scenes.sample(of.scenes[SCENE], seed="x"), "seed: expected a whole number, 0 or more, found 'x'"),
    (
        lambda of: of.agent.sample(of.agent[GOAL], observed=InitialStates({OBSERVED: torch.zeros(2, 52)}, torch.zeros(3, 52))),
        "observed: expected as many samples of every feature, found 2 of 'world', 3 of 'scenes'",
    ),
    (lambda of: of.agent.sample(of.agent[GOAL], observed=np.full((2, 52), np.nan)), "observed: expected finite numbers"),
    (
        lambda of: of.agent.sample(of.agent[GOAL], 2),
        "observed: expected where plans start (world (52,)), found nothing; model.starts(goal) draws some",
    ),
    (
        lambda of: of.agent.sample(of.agent[GOAL], 2, np.zeros((2, 51))),
        "key 'observed/world': expected float32 of shape (52,) a sample, found float32 of shape (51,)",
    ),
    (lambda of: of.agent.sample(of.agent[GOAL], 2, {"place": np.zeros((2, 52))}), "observed: expected world, found place"),
    (lambda of: of.agent.sample(of.agent[GOAL], observed=3), "observed: expected (sample, ...) of 'world'"),
    (lambda of: of.agent.sample(of.agent[GOAL], observed="here"), "expected an array of numbers, found 'here'"),
    (
        lambda of: of.agent.learn(np.zeros((5, 9, 13)), np.zeros((3, 9, 52))),
        "key 'observed/world': expected shape (5, 9, ...), found (3, 9, 52)",
    ),
    (
        lambda of: of.agent.learn(np.zeros((20, 13)), np.zeros((20, 52))),
        "states: expected shape (demo, time, 13), found (20, 13); give a single demonstration as states[None]",
    ),
    (lambda of: of.scenes.learn(np.zeros((20, 21))), "found (20, 21); give demonstrations as states[:, None]"),
    (lambda of: of.scenes.learn(np.zeros((3, 1, 20))), "states: expected shape (demo, time, 21), found (3, 1, 20)"),
    (lambda of: of.scenes.learn(SCENES, {"place": np.zeros((3, 2))}), "observed: expected nothing, found place"),
    (lambda of: of.scenes.learn(SCENES, np.zeros((3, 2))), "observed: expected features by name (none), found values without one"),
    (lambda of: of.agent.learn(np.zeros((2, 9, 13))), "key 'observed/world': expected float32 of shape (52,) each, found none"),
    (
        lambda of: of.agent.learn(np.zeros((2, 9, 13)), np.zeros((2, 9, 51))),
        "key 'observed/world': expected float32 of shape (52,) each, found float32 of shape (51,)",
    ),
    (
        lambda of: of.scenes.learn(of.scenes.domain.source(None).split("train", 1, 0)),
        "states: expected demonstrations of one concept, found those of circle above",
    ),
    (lambda of: of.agent.learn(np.zeros((20, 2))), "states: expected shape (demo, time, 13), found (20, 2)"),
    (lambda of: of.scenes.learn(np.full((2, 1, 21), np.nan)), "'states': expected finite numbers, found nan"),
    (lambda of: of.scenes.learn([]), "states: expected at least one demonstration, found an empty list"),
    (lambda of: of.scenes.learn(["a"]), "states: expected an array of numbers, found 'a'"),
    (lambda of: of.scenes.learn(3), "states: expected an array or a list of arrays, found 3"),
    (
        lambda of: of.scenes.learn([np.zeros((3, 21)), np.zeros((3, 20))]),
        "states: expected arrays of one shape but for their times, found (3, 20) and (3, 21)",
    ),
    (
        lambda of: of.agent.execute(of.agent[GOAL], 3),
        "scenes: expected where episodes start, what model.starts(goal, count) draws or finite numbers (episode, scene), found 3",
    ),
    (lambda of: of.agent.execute(of.agent[GOAL], of.starts, replan=0.5), "replan: expected a whole number, 1 or more"),
    (
        lambda of: of.agent.execute(of.agent[GOAL], of.starts, guidance=2),
        "execute: expected sampler, steps, temperature (or scenes, goal, replan, environment, seed), found 'guidance'",
    ),
    (lambda of: of.agent.execute(of.agent[GOAL], of.starts, GOAL, replan=0), "replan: expected 1 or more, found 0"),
    (lambda of: of.agent.execute(of.agent[GOAL], of.starts, "fly"), "goal: expected a task of agent, such as"),
    (
        lambda of: of.agent.execute(of.agent[GOAL], of.starts, GOAL, environment="step veto"),
        "environment: expected none, found 'step veto'",
    ),
    (
        lambda of: of.scenes.execute(of.scenes[SCENE], np.zeros((1, 2))),
        "execute: expected a domain with an environment, found object_rearrangement",
    ),
    (lambda of: of.scenes.starts(SCENE), "starts: expected a domain with initial states, found object_rearrangement"),
    (lambda of: of.agent.starts(GOAL, 0), "count: expected 1 or more, found 0"),
    (lambda of: of.scenes.evaluate(of.plans, "chess"), "goal: expected a task of object_rearrangement, such as "),
    (lambda of: of.scenes.render(of.plans, "chess"), "goal: expected a task of object_rearrangement, such as "),
    (lambda of: of.agent.starts("fly"), "found 'fly'"),
    (lambda of: of.scenes.evaluate(of.plans, 3), "goal: expected a text, such as 'circle right of triangle', found 3"),
    (lambda of: of.scenes.evaluate(3, SCENE), "evaluate: expected plans, such as model.sample returns, found 3"),
    (lambda of: of.learned.explain(nearest=0), "nearest: expected 1 or more, found 0"),
]
"""Wrong calls, each with a part of what is told."""


@pytest.mark.parametrize(("call", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_a_wrong_call_is_told_in_one_line(things: Things, call: Callable[[Things], Any], message: str) -> None:
    with refusal(message):
        call(things)


def test_cuda_is_told_where_there_is_none(things: Things) -> None:
    if torch.cuda.is_available():
        with pytest.raises(UserError, match=r"cpu or cuda:0.*, found 'cuda:99'"):
            things.scenes.to("cuda:99")
        assert things.scenes.to("cuda:0").device.type == "cuda"
        assert things.scenes.sample(things.learned, 2, **QUICK).states.device.type == "cpu"
        things.scenes.to("cpu")
        return
    for device in ("cuda", "cuda:1"):
        with pytest.raises(UserError, match=f"device: expected one that this machine has, cpu.*, found '{device}'"):
            FewShot.from_pretrained("object_rearrangement", device=device)


@pytest.mark.slow
def test_numpys_numbers_are_as_good_as_pythons(things: Things) -> None:
    scenes = things.scenes
    plain = scenes.sample(0.5 * scenes[SCENE], 3, seed=2, **QUICK, temperature=0.5).states
    numpys = {"sampler": "ddim", "steps": np.int64(3), "temperature": np.float32(0.5)}
    assert torch.equal(plain, scenes.sample(np.float64(0.5) * scenes[SCENE], np.int64(3), seed=np.int64(2), **numpys).states)
    assert scenes.learn(things.five, steps=np.int64(1), components=np.int64(3)).embeddings.shape == (3, 1, 384)


# Longer demonstrations


def still(agent: FewShot, lengths: list[int], per_step: bool) -> Demonstrations:
    """Demonstrations of these lengths in which nothing moves, with the world at each time or at the first alone."""
    states = [np.zeros((length, 13), dtype=np.float32) for length in lengths]
    world = [np.zeros((length, 52), dtype=np.float32) for length in lengths] if per_step else np.zeros((len(lengths), 52))
    return agent.demonstrations(states, world, "go to red bowl")


def test_longer_demonstrations_are_told_of(things: Things) -> None:
    model, shown = things.agent.model, partial(still, things.agent)
    assert longer_than_plans(shown([128, 100], True), model) == ""
    assert longer_than_plans(shown([140], False), model) == (
        "demonstrations of 140 steps are cut to the model's horizon of 128: the first 128 steps are learned from, "
        "as 'world' is known at the first time alone"
    )
    assert longer_than_plans(shown([160, 100], True), model) == ""  # a plan covers most of them
    assert longer_than_plans(shown([161, 100], True), model) == (
        "demonstrations of up to 161 steps are longer than the model's horizon of 128: they are learned from in windows of "
        "128 steps, which start anywhere, mostly early; a plan has 128 steps"
    )
    strokes = FewShot.from_pretrained("strokes")  # of a user's data, where every end counts
    path = np.zeros((strokes.model.window + 1, 2), dtype=np.float32)
    assert "longer than the model's horizon" in longer_than_plans(strokes.demonstrations([path], name="still"), strokes.model)
    driving = FewShot.from_pretrained("driving").model  # which plans anew
    longer = Demonstrations.load(SHIPPED / "merge.safetensors").rows([0])
    assert longer.states.shape[1] > driving.window
    assert longer_than_plans(longer, driving) == ""
    unseen = replace(longer, observed={}, per_step=())
    assert "in windows of 8 steps, which start anywhere; a plan has 8 steps" in longer_than_plans(unseen, driving)


@pytest.mark.slow
def test_what_longer_demonstrations_show_later_changes_no_number(things: Things) -> None:
    shown = partial(still, things.agent)
    long, other = shown([140], False), shown([140], False)
    other.states[:, 128:] = 1
    cut = "demonstrations of 140 steps are cut to the model's horizon of 128: the first 128"
    with pytest.warns(UserWarning, match=cut) as told:
        first = things.agent.learn(long, steps=1, samples=2, form="paper")
    assert told[0].filename == __file__
    with pytest.warns(UserWarning, match="are cut"):
        second = things.agent.learn(other, steps=1, samples=2, form="paper")
    assert torch.equal(first.embeddings, second.embeddings)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="demonstrations of")  # that nothing moves in them is told all the same
        things.agent.learn(shown([128], False), steps=1, samples=2, form="paper")
