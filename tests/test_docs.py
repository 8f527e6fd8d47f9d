"""The documentation: its length, its links, and the commands that it shows."""

import json
import re
import runpy
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, pstdev

import pytest

from ftl_lightning.cli import COMMANDS, TRAINER_VERBS
from ftl_lightning.domains.tabletop.tasks import AROUND_BOWL, PUSH, TO_BOOK, TO_WHITE
from ftl_lightning.evaluation.results import read_rows

ROOT = Path(__file__).parent.parent
PAPERS_FORM = "the paper's form of the concept: two components, learned weights"
README = ROOT / "README.md"
CARDS = (
    *ROOT.glob("pretrained/*/README.md"),
    *ROOT.glob("examples/*/README.md"),
    *ROOT.glob("ftl_lightning/domains/**/README.md"),
    ROOT / "conf" / "README.md",
    ROOT / "results" / "README.md",
)
PAGES = tuple(path for path in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in path.parts and not path.is_symlink())
TEXTS = (README, *PAGES, *CARDS)

FOLDERS = (ROOT, *ROOT.glob("examples/*"))
"""In which commands are run."""

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
INCLUDED = re.compile(r"^`{3,}\{include\} (\S+)", re.MULTILINE)
CODE = re.compile(r"^(`{3,})(?!\{include\}).*?^\1`*$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"python -m ftl_lightning ([a-z]+(?:-[a-z]+)*)((?:[^\n`\\]|\\\n)*)")
CONFIG = re.compile(r"--config[ =]([\w./-]+)")
PLACEHOLDER = re.compile(r"[A-Z]{2,}")
"""A word in capitals stands for any name, as in conf/DOMAIN.yaml."""


def targets(text: str) -> list[str]:
    """Files that a page links to, shows or includes, as written."""
    found = LINK.findall(CODE.sub("", text)) + INCLUDED.findall(text)
    return [target for target in found if not re.match(r"[a-z]+:|#", target)]


def commands(text: str) -> list[tuple[str, list[str]]]:
    """The verb and the configuration files of every command that a page shows."""
    return [(verb, CONFIG.findall(options)) for verb, options in COMMAND.findall(text)]


def test_the_readme_has_at_most_1500_words() -> None:
    assert len(README.read_text(encoding="utf-8").split()) <= 1500


def test_the_pages_are_found() -> None:
    names = {path.name for path in PAGES}
    assert {"index.md", "quick-start.md", "navigation.md"} <= names
    assert targets("[a](b.md) ![c](d.png) [e](https://f.g) [h](#i)\n```python\n[j](k)\n```\n") == ["b.md", "d.png"]
    assert targets("```{include} l.md\n```\n") == ["l.md"]
    shown = (
        "python -m ftl_lightning fit --a b \\\n  --config c.yaml\n`python -m ftl_lightning VERB` `python -m ftl_lightning report`"
    )
    assert commands(shown) == [("fit", ["c.yaml"]), ("report", [])]


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_points_to_something(path: Path) -> None:
    missing = [
        target for target in targets(path.read_text(encoding="utf-8")) if not (path.parent / target.partition("#")[0]).exists()
    ]
    assert missing == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_command_names_a_verb_and_files_that_exist(path: Path) -> None:
    for verb, files in commands(path.read_text(encoding="utf-8")):
        assert verb in TRAINER_VERBS | COMMANDS, verb
        for name in files:
            found = (any(folder.glob(PLACEHOLDER.sub("*", name))) for folder in FOLDERS)
            assert any(found), f"{verb} --config {name}"


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_benchmark_that_is_named_is_there(path: Path) -> None:
    named = set(re.findall(r"benchmarks/[\w/]+\.py", path.read_text(encoding="utf-8")))
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_every_page_is_in_the_contents() -> None:
    index = ROOT / "docs" / "index.md"
    listed = {line for block in re.findall(r"```\{toctree\}\n(.*?)```", index.read_text(), re.DOTALL) for line in block.split()}
    pages = {str(path.relative_to(index.parent).with_suffix("")) for path in PAGES} - {"index"}
    pages |= {f"cards/{path.stem}" for path in (ROOT / "docs" / "cards").iterdir()}
    notebooks = (ROOT / "notebooks").rglob("*.ipynb")
    pages |= {str(path.relative_to(ROOT).with_suffix("")) for path in notebooks if ".ipynb_checkpoints" not in path.parts}
    assert pages - listed == set()


def test_the_tables_of_fields_are_what_the_docstrings_say() -> None:
    fields = runpy.run_path(str(ROOT / "docs" / "fields.py"))
    page = fields["PAGE"].read_text(encoding="utf-8")
    assert fields["written"](page) == page, "run `make fields`"
    stale = page.replace("number of states in a plan", "what nobody wrote")
    assert stale != page
    assert fields["written"](stale) == page


def test_the_tables_of_forms_are_what_the_results_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    forms = runpy.run_path(str(ROOT / "benchmarks" / "forms.py"))
    content = json.loads((ROOT / "results" / "forms.json").read_text(encoding="utf-8"))
    assert forms["summary"](content["families"]) == content["summary"]
    assert forms["page"](content) == (ROOT / "results" / "forms.md").read_text(encoding="utf-8"), "run benchmarks/forms.py"


def test_pages_tell_the_numbers_of_strokes() -> None:
    content = json.loads((ROOT / "results" / "strokes.json").read_text(encoding="utf-8"))
    rates = [f"{content[encoder]['recognised']['new kinds']:.2f}" for encoder in ("hashing", "minilm")]
    looks = {
        name: [f"{content[encoder]['looks'][name]:.2f}" for encoder in ("hashing", "minilm")]
        for name in ("spread", "novelty", "roughness")
    }
    told = f"new kinds {rates[0]} with hashing and {rates[1]} with MiniLM; "
    told += ", ".join(f"{name} {one} and {other}" for name, (one, other) in looks.items())
    assert told in (ROOT / "docs" / "experiments-own-data.md").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "own-data.md").read_text(encoding="utf-8")
    assert f"recognises {rates[0]} of the samples of the three new kinds" in page
    assert f"spread {looks['spread'][0]} of fresh strokes and are smoother (roughness {looks['roughness'][0]})" in page


def test_the_page_of_own_data_tells_what_check_finds() -> None:
    content = json.loads((ROOT / "results" / "check.json").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "own-data.md").read_text(encoding="utf-8")
    found = [content["faults"][name] for name in ("strokes", "object_rearrangement", "agent", "tabletop", "mocap")]
    for fault in found[0]:
        cells = " | ".join(f"{one[fault]:.2f}" if fault in one else "-" for one in found)
        row = "good sets in which it finds fault" if fault == "good" else fault
        assert f"| {row} | {cells} |" in page
    paths, relations = (content["odd one, after learning"][name]["found"] for name in ("paths", "relations"))
    assert f"in {paths:.2f} of the sets of paths and in {relations:.2f} of those of relations" in page


def test_the_tables_of_the_table_top_are_what_the_results_say(tmp_path: Path) -> None:
    tables = runpy.run_path(str(ROOT / "benchmarks" / "tabletop_table.py"))
    tables["main"]([f"--results={ROOT / 'results'}", f"--out={tmp_path}"])
    for name in ("tabletop.md", "tabletop_wide.md"):
        kept = (ROOT / "results" / name).read_text(encoding="utf-8")
        assert (tmp_path / name).read_text(encoding="utf-8") == kept, "run benchmarks/tabletop_table.py"


def test_numbers_of_the_table_top_in_texts_are_those_of_its_tables() -> None:
    rows = [line.strip("| ").split(" | ") for line in (ROOT / "results" / "tabletop.md").read_text(encoding="utf-8").splitlines()]
    told = {row[0]: [cell.split(" ")[0] for cell in row[1:]] for row in rows if len(row) == 4 or len(row) == 5}
    (adapter, moved, *_), (paper, dragged, *_) = told["**FTL-IGM with an adapter**"], told[PAPERS_FORM]
    readme, limits, page = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/limits.md", "docs/domains/table-top.md")
    )
    succeeds = f"succeeds in {adapter} of new scenes with an adapter and in {paper} in the paper's form; BC in {told['BC'][0]}"
    assert succeeds in readme
    assert f"embeddings alone move the book in {dragged} of the scenes; an adapter in {moved}" in limits
    known = [told[task][0] for task in (TO_BOOK, TO_WHITE, PUSH)]
    assert f"succeed in {min(known)} to {max(known)} of new scenes, pushing around the bowl in {told[AROUND_BOWL][0]};" in limits
    from_push = told["the training concept of pushing on the table (the paper's baseline)"]
    assert f"succeeds in {from_push[0]} of the scenes, in the paper in {from_push[2]}." in page


def test_the_table_of_settings_is_what_the_configurations_say() -> None:
    settings = runpy.run_path(str(ROOT / "docs" / "settings.py"))
    page = settings["PAGE"].read_text(encoding="utf-8")
    assert settings["written"](page) == page, "run docs/settings.py"


def test_the_page_of_the_paper_is_what_the_results_say() -> None:
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert runpy.run_path(str(ROOT / "docs" / "paper.py"))["page"]() == page, "run docs/paper.py"


def test_the_page_of_the_paper_says_what_has_no_rows() -> None:
    paper = runpy.run_path(str(ROOT / "docs" / "paper.py"))
    rows = paper["read_rows"](ROOT / "results" / "tabletop.csv")
    assert re.fullmatch(r"0\.\d\d.*", paper["measured"](rows, {"method": "BC", "metric": "closed loop success"}, "BC"))
    with pytest.raises(SystemExit, match=r"BC: expected rows with .*, found none"):
        paper["measured"](rows, {"method": "BC", "metric": "accuracy"}, "BC")
    with pytest.raises(SystemExit, match="all: expected rows of one setting, found"):
        paper["measured"](rows, {"method": "FTL-IGM", "metric": "closed loop success"}, "all")


def test_the_tables_of_human_motion_are_what_the_results_say(tmp_path: Path) -> None:
    tables = runpy.run_path(str(ROOT / "benchmarks" / "mocap_table.py"))
    tables["main"]([f"--results={ROOT / 'results' / 'mocap.csv'}", f"--out={tmp_path / 'found.md'}"])
    kept = (ROOT / "results" / "mocap.md").read_text(encoding="utf-8")
    assert (tmp_path / "found.md").read_text(encoding="utf-8") == kept, "run benchmarks/mocap_table.py"


def test_the_page_of_human_motion_tells_how_often_rules_hold_in_recordings() -> None:
    content = json.loads((ROOT / "results" / "mocap_rules.json").read_text(encoding="utf-8"))
    jacks, circle = content["jumping jacks"], content["arm circle"]
    page = (ROOT / "docs" / "domains" / "human-motion.md").read_text(encoding="utf-8")
    held = [f"{value:.2f}".lstrip("0") for one in (jacks, circle) for value in one["holds"].values()]
    assert f"They hold in {held[0]} and {held[1]} of the windows of two people's jumping jacks" in page
    assert f"in {held[2]} and {held[3]} of those of arm circles" in page
    assert jacks["demonstrations"] == circle["demonstrations"] == 1
    wrong = [f"{one['training concepts']:.4f}".lstrip("0") for one in (jacks, circle)]
    assert f"in all demonstrations, and in {wrong[0]} and {wrong[1]} of the training concepts' windows" in page


def test_texts_tell_the_numbers_of_human_motion() -> None:
    rows = read_rows(ROOT / "results" / "mocap.csv")

    def told(form: str, task: str, metric: str) -> str:
        own = rows[(rows["method"] == "FTL-IGM") & (rows["form"] == form) & (rows["setting"] == "new concept")]
        values = own[(own["task"] == task) & (own["metric"] == metric)]["value"]
        assert len(values) == 3
        return f"{values.mean():.2f}".lstrip("0")

    ours, adapted = "with modes over time", "with modes over time with adapter"
    jacks, circle = (told(ours, task, "rule") for task in ("jumping jacks", "arm circle"))
    strides, judged = (told(ours, "jumping jacks", metric) for metric in ("strides", "accuracy"))
    readme, limits, page = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/limits.md", "docs/domains/human-motion.md")
    )
    assert f"in {jacks} of new samples (from strides {strides}; paper's form, text .00), arm circles in {circle}." in readme
    assert f"right in {jacks} of the samples (from strides {strides}); the trained judge recognises {judged}." in limits
    assert f"Arm circles turn fully in {circle}." in limits
    assert f"The rule holds in {jacks} of the samples of ours, from strides in {strides}; the judge recognises {judged}." in page
    card = (ROOT / "pretrained" / "mocap" / "README.md").read_text(encoding="utf-8")
    assert f"{jacks} by a rule of hands and feet (from strides {strides}), {judged} by the trained judge" in card
    assert f"arm circles {circle} and {told(ours, 'arm circle', 'accuracy')}; see" in card
    assert f"- **Arm circles** satisfy the rule in {circle}:" in page
    both = [told(adapted, task, metric) for metric in ("rule", "accuracy") for task in ("jumping jacks", "arm circle")]
    assert "({} and {} by the rule, {} and {} by the judge)".format(*both) in page
    chosen, single = "mixtures of them), an adapter alone in one: {} and {}.", "({} and {}), nor can one set"
    for form, text in (("over time form chosen", chosen), ("over time", single)):
        assert text.format(*(told(form, task, "rule") for task in ("jumping jacks", "arm circle"))) in page


def test_the_page_of_human_motion_tells_distances_and_compositions() -> None:
    content = json.loads((ROOT / "results" / "mocap_distances.json").read_text(encoding="utf-8"))
    page, limits = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("domains/human-motion.md", "limits.md"))

    def far(concept: str, form: str) -> str:
        rows = [row["kid over that between people"] for name, row in content[concept].items() if name.startswith(f"{form}, ")]
        assert len(rows) == 3
        return f"{mean(rows):.1f}"

    jacks, circles = ([far(concept, form) for form in ("ours", "ours with adapter")] for concept in ("jumping jacks", "arm circle"))
    assert f"jumping jacks are {jacks[0]} times as far from another person as two people are from each other" in page
    assert f"(with an adapter {jacks[1]}), arm circles {circles[0]} times ({circles[1]})" in page
    assert f"is {jacks[0]} times the distance between two people's; with an adapter {jacks[1]} times." in limits
    rows = read_rows(ROOT / "results" / "mocap.csv")
    own = rows[(rows["form"] == "with modes over time") & (rows["metric"] == "accuracy")]
    own = own[own["setting"] == "new + training, by parts of the body"]
    rates = own.groupby("task")["value"].mean()
    tasks = [f"{concept} + {other}" for concept in ("jumping jacks", "arm circle") for other in ("walk", "jump")]
    told = [f"{rates[task]:.2f}".lstrip("0") for task in tasks]
    assert "recognises both concepts in {} (jumping jacks + walk), {}, {} and {};".format(*told) in page


def test_the_notes_tell_how_well_the_judge_of_motion_recognises_unseen_people() -> None:
    content = json.loads((ROOT / "results" / "mocap_judge.json").read_text(encoding="utf-8"))
    runs = content["across people"]
    notes = (ROOT / "docs" / "experiments-mocap.md").read_text(encoding="utf-8")
    cells = []
    for key in ("balanced accuracy", "of the tested classes alone"):
        shares = [run["whole together"][key] for run in runs]
        cells.append(f"**{mean(shares):.3f}** ({pstdev(shares):.3f})".replace("0.", "."))
    assert f"| **whole body, with verifiers** | {' | '.join(cells)} |" in notes
    first = runs[0]["hard negatives"]
    nearly = [first[f"{name} of subject {person}"] for name in ("jumping jacks", "arm circle") for person in (13, 14)]
    nearly += [content["hard negatives"][f"{name} of subject 13"] for name in ("jumping jacks", "arm circle")]
    for kind in dict.fromkeys(kind for found in nearly for kind in found):
        cells = [f"{found[kind]:.2f}".replace("0.", ".") if kind in found else "" for found in nearly]
        assert f"| {kind} | {' | '.join(cells)} |" in notes, kind
    kept = ("as recorded", "begun in another pose", "seven tenths of the amplitude")
    every = [found for run in runs for found in run["hard negatives"].values()] + nearly
    worst = max(share for found in every for kind, share in found.items() if kind not in kept)
    assert f"over all seeds {worst:.2f}".replace("0.", ".") in notes


def test_a_docstring_that_leaves_out_a_field_is_an_error() -> None:
    fields = runpy.run_path(str(ROOT / "docs" / "fields.py"))

    @dataclass
    class Half:
        """Half described.

        Attributes:
            told: what is said.
        """

        told: int
        untold: int = 0

    with pytest.raises(ValueError, match=r"Half: the docstring describes \['told'\], the class has \['told', 'untold'\]"):
        fields["table"](Half)
