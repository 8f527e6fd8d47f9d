"""Learned concepts that are kept and shared: by name in a library, as a folder with a card, and on the Hub."""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from markdown_it import MarkdownIt
from PIL import Image

from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.agent.scenes import OBSERVED
from ftl_lightning.few_shot import shared_concept
from ftl_lightning.few_shot.learner import FewShot, LearnedConcept
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.library import concepts_folder
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.services.text import line
from tests.conftest import ROOT
from tests.test_outputs import NAMES

NEW, KNOWN = "square diagonal to triangle", "circle right of square"
PLACE = "somebody/diagonal"


@pytest.fixture(scope="module")
def scenes() -> FewShot:
    found = FewShot.from_pretrained("object_rearrangement")
    found.tuned = replace(found.tuned, sampling=Sampling("ddim", 3))
    return found


@pytest.fixture(scope="module")
def five(scenes: FewShot) -> Demonstrations:
    return scenes.domain.source(None).draw(NEW, 5, 1)


@pytest.fixture(scope="module")
def learned(scenes: FewShot, five: Demonstrations) -> LearnedConcept:
    return scenes.learn(five, steps=2, form="paper")


def renamed(learned: LearnedConcept, **changes: Any) -> LearnedConcept:
    """With another origin; as from a file, nothing can be measured."""
    concept = replace(learned.concept, origin=replace(learned.concept.origin, **changes))
    return replace(learned, concept=concept, demonstrations=None)


def metadata(card: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(card.split("\n---\n")[0].removeprefix("---\n"))
    return found


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """A Hub that holds the folder ``hub`` under every name; what it was asked for."""
    asked: list[tuple[str, list[str]]] = []

    def download(repository: str, allow_patterns: list[str]) -> str:
        asked.append((repository, allow_patterns))
        if not Path("hub").is_dir():
            raise ConnectionError("no network\nat all")
        return str(Path("hub").absolute())

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    return asked


# A library by name


def test_a_concept_that_is_kept_is_composed_by_its_name(scenes: FewShot, learned: LearnedConcept) -> None:
    path = learned.keep()
    assert path == concepts_folder() / scenes.model.hash / "square_diagonal_to_triangle.safetensors"
    (entry,) = scenes.library().learned
    assert (entry.name, entry.kind, entry.count, entry.form) == (NEW, "saved", 5, "one set")
    assert entry.accuracy == learned.quality.right[1]  # type: ignore[index]
    assert entry.metric == "accuracy"
    for name in (NEW, path.stem):
        told = scenes.compose(f"{NEW}:0.5 + {KNOWN}") if name == NEW else scenes.compose(f"{name}:0.5 + {KNOWN}")
        assert torch.equal(told.embeddings, (0.5 * learned + scenes[KNOWN]).embeddings)
        assert torch.equal(told.weights, (0.5 * learned + scenes[KNOWN]).weights)
    assert learned.keep() == path
    assert len(scenes.library().learned) == 1


def test_a_kept_concept_is_sampled_from_on_the_command_line(learned: LearnedConcept, capsys: pytest.CaptureFixture[str]) -> None:
    learned.keep()
    options = ["sample", "--pretrained=object_rearrangement", "--count=3", "--steps=3", f"--goal={NEW}"]
    states = []
    for told in (
        f"--compose={NEW}",
        f"--concept={concepts_folder() / learned.model.hash / 'square_diagonal_to_triangle'}.safetensors",
    ):
        assert main([*options, told, "--out=o.safetensors"]) == 0
        states.append(Demonstrations.load("o.safetensors").states)
    assert torch.equal(*states)
    capsys.readouterr()
    assert main(["concepts", "object_rearrangement"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"{NEW}  saved  5               one set  ")


def test_training_concepts_go_first_and_names_are_exact(scenes: FewShot, learned: LearnedConcept) -> None:
    renamed(learned, name=KNOWN).keep()
    assert torch.equal(scenes.compose(KNOWN).embeddings, scenes[KNOWN].embeddings)
    with pytest.raises(UserError) as told:
        scenes.compose("square diagonal")
    expected = "concept 'square diagonal': expected a training concept or one of the model's library: .* nearest of 13; list all"
    assert told.match(expected)
    learned.save("mine.safetensors")
    learned.save("yours.safetensors")
    assert scenes.library(".").nearest("yors")[0] == "yours"  # names of several are told by their files
    with pytest.raises(UserError, match=r"expected one, found mine\.safetensors and yours\.safetensors; give one of these files"):
        scenes.library(".").learned_as(NEW)


def test_names_with_one_file_name_are_kept_apart_and_inside(scenes: FewShot, learned: LearnedConcept) -> None:
    names = ["a b", "a_b", "../../evil", "/etc/passwd", ".hidden", "..", "", "x" * 500, "x" * 501, "Ü\n\x00"]
    paths = [renamed(learned, name=name).keep() for name in names]
    assert len(set(paths)) == len(names)
    folder = (concepts_folder() / scenes.model.hash).resolve()
    assert {path.resolve().parent for path in paths} == {folder}
    assert sorted(entry.name for entry in scenes.library().learned) == sorted(names)
    assert [path.name for path in paths[:3]] == ["a_b.safetensors", "a_b_1.safetensors", "_.._evil.safetensors"]


def test_quality_is_written_where_it_is_asked_for(scenes: FewShot, learned: LearnedConcept) -> None:
    learned.save("plain.safetensors")
    learned.save("judged.safetensors", quality=True)
    assert Concept.load("plain.safetensors").quality is None
    learned.concept.save("again.safetensors")
    assert Path("plain.safetensors").read_bytes() == Path("again.safetensors").read_bytes()
    record = Concept.load("judged.safetensors").quality
    assert record is not None
    assert (record.samples, record.spread) == (40, learned.quality.quality.spread)
    again = scenes.load("judged.safetensors")
    again.save("again.safetensors")  # it stays
    assert Path("judged.safetensors").read_bytes() == Path("again.safetensors").read_bytes()
    with pytest.raises(UserError, match="quality: expected a concept that was learned here"):
        again.save("other.safetensors", quality=True)


# A folder


def test_a_folder_holds_the_concept_a_card_and_a_picture(scenes: FewShot, learned: LearnedConcept) -> None:
    learned.save_pretrained("shared")
    assert {path.name for path in Path("shared").iterdir()} == {"concept.safetensors", "README.md", "picture.png"}
    found = scenes.load("shared")
    assert torch.equal(found.embeddings, learned.embeddings)
    assert found.concept.origin == learned.concept.origin
    assert found.concept.quality == learned.quality.record
    with Image.open("shared/picture.png") as picture:
        assert picture.width > 300
    assert Path("shared/picture.png").stat().st_size < 1_000_000
    card = Path("shared/README.md").read_text()
    keys = metadata(card)
    assert keys["library_name"] == "ftl-lightning"
    own = {"concept": NEW, "model": "object_rearrangement", "hash": scenes.model.hash, "domain": "object_rearrangement"}
    assert keys["ftl_lightning"] == own
    assert "base_model" not in keys  # the Hub refuses what is not there
    assert "learned from | 5 demonstrations" in card
    assert f"accuracy {learned.quality.record.right:.2f}, spread" in card
    assert 'FewShot.from_pretrained("object_rearrangement")' in card
    Path("shared/README.md").write_text("mine")
    learned.save_pretrained("shared")
    assert Path("shared/README.md").read_text() == "mine"


@pytest.mark.slow
def test_demonstrations_go_along_where_they_are_asked_for(scenes: FewShot, five: Demonstrations, learned: LearnedConcept) -> None:
    learned.save_pretrained("shared", demonstrations=True)
    assert Demonstrations.load("shared/demonstrations.safetensors").hash == five.hash
    assert "`demonstrations.safetensors`" in Path("shared/README.md").read_text()
    with pytest.raises(UserError, match="demonstrations: expected a concept that was learned here, found a concept from a file"):
        scenes.load("shared").save_pretrained("other", demonstrations=True)
    assert not Path("other").exists()
    scenes.load("shared").save_pretrained("other")
    assert scenes.load("other").concept.quality == learned.quality.record  # that of the file


@pytest.mark.slow
def test_motion_is_filmed_and_films_are_small(monkeypatch: pytest.MonkeyPatch) -> None:
    mocap = FewShot.from_pretrained("mocap")
    mocap.tuned = replace(mocap.tuned, sampling=Sampling("ddim", 3))
    circle = mocap.load(ROOT / "pretrained/mocap/arm_circle.safetensors")
    draw, drawn = shared_concept._frames, list[Any]()

    def frames(*arguments: Any) -> list[Any]:
        """Drawn once."""
        drawn[:] = drawn or draw(*arguments)
        return drawn

    monkeypatch.setattr(shared_concept, "_frames", frames)
    circle.save_pretrained("whole")
    monkeypatch.setattr(shared_concept, "MOST_BYTES", Path("whole/film.gif").stat().st_size - 1)
    circle.save_pretrained("half")
    films = [Path(name, "film.gif") for name in ("whole", "half")]
    assert [Image.open(film).n_frames for film in films] == [32, 16]  # type: ignore[attr-defined]
    assert films[1].stat().st_size < films[0].stat().st_size < 1_000_000
    monkeypatch.setattr(shared_concept, "MOST_BYTES", 100)
    circle.save_pretrained("none")
    assert {path.name for path in Path("none").iterdir()} == {"concept.safetensors", "README.md"}
    assert "![" not in Path("none/README.md").read_text()
    assert "quality | not measured" in Path("none/README.md").read_text()


@pytest.mark.slow
def test_episodes_are_filmed_and_without_a_simulator_there_is_a_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = FewShot.from_pretrained("agent")
    agent.tuned = replace(agent.tuned, sampling=Sampling("ddim", 2), replan=128)
    states = agent.domain.source(None).draw("go to bowl", 2, 0)
    one = replace(agent.learn(states, steps=1, form="paper", samples=2), demonstrations=None)
    one.save_pretrained("film")
    with Image.open("film/film.gif") as film:
        assert film.n_frames > 2  # type: ignore[attr-defined]
    assert OBSERVED in states.observed

    def missing(*_: object) -> None:
        raise UserError("no simulator")

    monkeypatch.setattr(shared_concept, "episodes", missing)
    one.save_pretrained("picture")
    assert {path.name for path in Path("picture").iterdir()} == {"concept.safetensors", "README.md", "picture.png"}


@pytest.mark.parametrize(
    "name", [*NAMES, "```\nrm -rf ~\n```", "a\n---\nb: c", '"; !!python/object:os.system', "# x\n\n    code", ""]
)
def test_names_of_strangers_mean_nothing_in_a_card(learned: LearnedConcept, name: str) -> None:
    Path("shared").mkdir()
    renamed(learned, name=name, demonstrations=name, domain=name).concept.save("shared/concept.safetensors")
    card = shared_concept.card(Path("shared/concept.safetensors"), "", "", with_demonstrations=False)
    keys = metadata(card)
    assert set(keys) == {"library_name", "tags", "ftl_lightning"}
    assert set(keys["ftl_lightning"]) == {"concept", "hash", "domain"}
    assert keys["ftl_lightning"]["concept"] == line(name)
    tokens = MarkdownIt("commonmark").enable("table").parse(card.split("\n---\n", 1)[1])
    assert [token.tag for token in tokens if token.type == "heading_open"] == ["h1"]
    assert not [token for token in tokens if token.type in ("fence", "html_block", "hr", "blockquote_open")]
    assert len([token for token in tokens if token.type == "code_block"]) == 1
    inside = [child for token in tokens for child in token.children or ()]
    assert {child.type for child in inside} <= {"text", "text_special", "code_inline", "softbreak"}


# The Hub


def test_a_concept_is_uploaded(scenes: FewShot, learned: LearnedConcept, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []

    class Hub:
        def create_repo(self, repository: str, private: bool, exist_ok: bool) -> None:
            calls.append((repository, private, exist_ok))

        def upload_folder(self, repo_id: str, folder_path: str) -> str:
            calls.append((repo_id, {path.name for path in Path(folder_path).iterdir()}))
            return f"https://hub/{repo_id}"

    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    assert learned.push_to_hub(PLACE) == f"https://hub/{PLACE}"
    assert calls == [(PLACE, False, True), (PLACE, {"concept.safetensors", "README.md", "picture.png"})]
    learned.push_to_hub(PLACE, private=True, demonstrations=True)
    assert calls[2] == (PLACE, True, True)
    assert "demonstrations.safetensors" in calls[3][1]  # type: ignore[index]

    assert scenes.publish(learned, PLACE) == f"https://hub/{PLACE}"
    with pytest.raises(UserError, match=r"^publish: expected a learned concept"):
        scenes.publish(scenes["circle above square"], PLACE)  # type: ignore[arg-type]

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("401\nlong story")

    monkeypatch.setattr(Hub, "create_repo", refuse)
    with pytest.raises(UserError, match=r"somebody/diagonal: expected a place on the Hub .* found none \(401\); log in first"):
        learned.push_to_hub(PLACE)


@pytest.mark.parametrize("name", ["diagonal", "a/b/c", "../x", "a/..", "", "a b/c", "a/b\n", 3])
def test_a_name_to_upload_to_that_is_none_is_told_before_any_work(
    scenes: FewShot, learned: LearnedConcept, name: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.HfApi", lambda: pytest.fail("asked the Hub"))
    for push in (learned.push_to_hub, scenes.push_to_hub):
        with pytest.raises(UserError, match="repository: expected a name on the Hub, such as 'owner/name', found"):
            push(name)


def test_a_concept_on_the_hub_is_downloaded(scenes: FewShot, learned: LearnedConcept, hub: list[tuple[str, list[str]]]) -> None:
    with pytest.raises(UserError) as told:
        scenes.load(PLACE)
    assert str(told.value) == f"{PLACE}: expected a concept's file, its folder or one on the Hub, found none (no network)"
    learned.save_pretrained("hub")
    found = scenes.load(PLACE)
    assert torch.equal(found.embeddings, learned.embeddings)
    assert hub == [(PLACE, ["concept.safetensors", "README.md"])] * 2
    learned.save_pretrained(PLACE)
    assert scenes.load(PLACE).concept.origin == learned.concept.origin
    assert len(hub) == 2  # what is here needs no Hub


@pytest.mark.parametrize("name", ["mine", "./a", "~/a", "../a", "a/b/c", "conf/a", "pretrained/a", "a/b.safetensors"])
def test_the_hub_is_not_asked_for_what_is_a_path(scenes: FewShot, name: str, hub: list[tuple[str, list[str]]]) -> None:
    with pytest.raises(UserError, match="expected a concept file, found nothing"):
        scenes.load(name)
    assert hub == []


def test_compositions_never_ask_the_hub(scenes: FewShot, learned: LearnedConcept, hub: list[tuple[str, list[str]]]) -> None:
    learned.save_pretrained("hub")
    with pytest.raises(UserError, match=f"concept '{PLACE}': expected a training concept"):
        scenes.compose(PLACE)
    assert hub == []


def test_the_card_of_a_concept_names_a_model_of_the_hub(
    scenes: FewShot, learned: LearnedConcept, hub: list[tuple[str, list[str]]]
) -> None:
    scenes.save_pretrained("hub")
    model = FewShot.from_pretrained("somebody/scenes")
    assert model.known_as == "somebody/scenes"
    assert model.folder == Path("hub").absolute()
    replace(learned, known_as=model.known_as).save_pretrained("shared")
    keys = metadata(Path("shared/README.md").read_text())
    assert keys["base_model"] == keys["ftl_lightning"]["model"] == "somebody/scenes"
    scenes.save_pretrained("mine")
    assert FewShot.from_pretrained("mine").known_as == ""  # a path says nothing to others
    assert scenes.known_as == "object_rearrangement"
    assert hub[0][0] == "somebody/scenes"


# Folders of strangers

OTHER = "object_rearrangement (hash ea5aa92a1ef3e100), found one of agent (hash 0123)"
CARDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "honest": (lambda path: path.write_text('---\nftl_lightning:\n  model: "a/b"\n---\n'), ", which its card calls 'a/b'; load"),
    "none": (lambda path: None, "; load"),
    "code": (lambda path: path.write_text('---\nx: !!python/object/apply:os.system ["touch ran"]\n---\n```\nrm\n```'), "; load"),
    "fences": (lambda path: path.write_text('```\n  model: "x"\n---\n```sh\ntouch ran\n```\n'), ", which its card calls 'x'; load"),
    "below": (lambda path: path.write_text('---\na: b\n---\n  model: "x"\n'), "; load"),
    "escapes": (lambda path: path.write_text('---\n  model: "\x1b[31m\u202e' + "x" * 150 + '"\n---\n'), "calls '?[31m?xx"),
    "bytes": (lambda path: path.write_bytes(b"---\n\xff\xfe\n"), "; load"),
    "large": (lambda path: path.write_text("---\n" + "x" * 100_000), "; load"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "; load"),
    "pipe": (os.mkfifo, "; load"),
    "folder": (lambda path: path.mkdir(), "; load"),
}


@pytest.mark.parametrize("case", CARDS)
def test_a_concept_of_another_model_is_told_with_the_model(
    scenes: FewShot, learned: LearnedConcept, case: str, hub: list[tuple[str, list[str]]]
) -> None:
    make, expected = CARDS[case]
    Path("hub").mkdir()
    renamed(learned, pretrained="0123", domain="agent").save("hub/concept.safetensors")
    make(Path("hub/README.md"))
    for place in ("hub", PLACE):
        with pytest.raises(UserError) as told:
            scenes.load(place)
        message = str(told.value)
        assert message.startswith(f"{place}: expected a concept of this model, {OTHER}")
        assert expected in message
        assert message.endswith("load that model")
        assert len(message) <= LONGEST
        assert message.isprintable()
    assert not Path("ran").exists()


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(3 * 2**30)


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda path: None, "nothing"),
        (lambda path: path.write_text("hello"), "a damaged or foreign file"),
        (lambda path: path.symlink_to("/dev/zero"), "a device, pipe or socket"),
        (os.mkfifo, "a device, pipe or socket"),
        (lambda path: path.mkdir(), "a folder"),
        (sparse, "3221225472"),
        (lambda path: path.symlink_to(ROOT / "pretrained/agent/model.safetensors"), "a generative model file"),
    ],
)
def test_a_folder_without_an_honest_concept_is_one_line(
    scenes: FewShot, make: Callable[[Path], object], found: str, hub: list[tuple[str, list[str]]]
) -> None:
    Path("hub").mkdir()
    make(Path("hub/concept.safetensors"))
    for place in ("hub", PLACE):
        with pytest.raises(UserError, match=r"concept\.safetensors: .*expected a concept file.*found") as told:
            scenes.load(place)
        assert found in str(told.value)


def test_nothing_else_in_a_folder_is_read_or_run(scenes: FewShot, learned: LearnedConcept) -> None:
    learned.save_pretrained("shared")
    evil = 'open("ran", "w")'
    for name in ("concept.py", "__init__.py", "sitecustomize.py", "torch.py", "modeling.py"):
        Path("shared", name).write_text(evil)
    told = {"auto_map": {"AutoModel": "modeling.Model"}, "domain": "concept:DOMAIN", "kind": "concept:METHOD", "hash": "x"}
    Path("shared/config.json").write_text(json.dumps(told))
    os.mkfifo("shared/demonstrations.safetensors")
    os.mkfifo("shared/film.gif")
    Path("shared/model.safetensors").symlink_to("/dev/zero")
    before = set(sys.modules)
    scenes.load("shared")
    assert not {"concept", "modeling", "sitecustomize"} & (set(sys.modules) - before)
    assert not Path("ran").exists()
    assert [entry.name for entry in scenes.library(".").learned] == [NEW]
