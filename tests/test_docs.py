"""The documentation: its length, its links, and the commands that it shows."""

import json
import re
import runpy
from pathlib import Path
from statistics import mean, pstdev
from typing import Any

import pytest

from ftl_lightning.apps.paper import items
from ftl_lightning.cli.main import COMMANDS, TRAINER_VERBS
from ftl_lightning.domains.registry import domain_of_file
from ftl_lightning.reporting.table import plus_minus

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
CARDS = (
    *ROOT.glob("pretrained/*/README.md"),
    *ROOT.glob("examples/*/README.md"),
    *ROOT.glob("ftl_lightning/domains/**/README.md"),
    ROOT / "conf" / "README.md",
    ROOT / "results" / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
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


def included(page: Path) -> list[Path]:
    """Files that a page includes."""
    return [(page.parent / name).resolve() for name in INCLUDED.findall(page.read_text(encoding="utf-8"))]


def commands(text: str) -> list[tuple[str, list[str]]]:
    """The verb and the configuration files of every command that a page shows."""
    return [(verb, CONFIG.findall(options)) for verb, options in COMMAND.findall(text)]


def test_the_readme_has_at_most_900_words() -> None:
    assert len(README.read_text(encoding="utf-8").split()) <= 900


CLAIMS = runpy.run_path(str(ROOT / "docs" / "claims.py"))
TIED = {str(page.relative_to(ROOT)): page for page in CLAIMS["pages"]()}


@pytest.mark.parametrize("name", list(TIED))
def test_every_decimal_of_a_page_is_what_its_source_says(name: str) -> None:
    assert CLAIMS["wrong"](TIED[name]) == []


def test_every_file_of_claims_is_of_a_page() -> None:
    files = set((ROOT / "docs" / "claims").rglob("*.yaml"))
    assert files - {CLAIMS["claims_of"](page) for page in TIED.values()} == set()


def found_wrong(text: str, *claims: dict[str, Any]) -> list[str]:
    return [message for _, message in CLAIMS["problems"](text, list(claims))]


def test_a_number_without_a_source_or_with_another_value_is_told() -> None:
    steps = {"file": "docs/claims/nothing.yaml", "at": []}
    said = {"given": 0.5, "why": "a definition"}
    assert found_wrong("right in .50, wrong in `.1`\n\n    code .2\n", {"text": "right in .50", "values": [said]}) == []
    assert found_wrong("right in .50") == ["expected a claim that says where .50 comes from, found none"]
    [message] = found_wrong("right in 0.51", {"text": "in 0.51", "values": [said]})
    assert message.startswith("found 0.51, expected 0.50 (0.5) from {'given': 0.5")
    assert "found it 2 times" in found_wrong(".5 and .5", {"text": ".5", "values": [said]})[0]
    assert "found one that another claim covers" in " ".join(
        found_wrong("a .5 b", {"text": "a .5", "values": [said]}, {"text": ".5 b", "values": [said]})
    )
    assert "expected a value for each of ['.5', '.6'], found 1" in found_wrong(".5 .6", {"text": ".5 .6", "values": [said]})[0]
    assert "No such file" in found_wrong(".5", {"text": ".5", "values": [steps]})[0]
    assert "expected why the number needs no source" in found_wrong(".5", {"text": ".5", "values": [{"given": 0.5}]})[0]
    assert found_wrong(
        "at most 1,000 steps, -0.5",
        {"text": "at most 1,000", "whole": True, "values": [{"product": [10, 100], "why": "a definition"}]},
    ) == ["expected a claim that says where -0.5 comes from, found none"]


def test_rows_of_several_settings_are_no_number() -> None:
    values = CLAIMS["values"]
    chosen = {"file": "tabletop.csv", "method": "FTL-IGM", "metric": "closed loop success"}
    with pytest.raises(CLAIMS["SourceError"], match="expected rows of one setting, found"):
        values({"rows": chosen})
    own = {**chosen, "setting": "new concept", "form": "with adapter", "demonstrations": 10}
    assert sum(values({"rows": {**own, "seed": "*"}})) / 3 == pytest.approx(values({"mean": [{"rows": own}]})[0])


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
def test_every_link_command_and_benchmark_of_a_page_is_there(path: Path) -> None:
    """Relative links point to something, commands name a verb and files that exist, and benchmarks are files."""
    text = path.read_text(encoding="utf-8")
    assert [target for target in targets(text) if not (path.parent / target.partition("#")[0]).exists()] == []
    for verb, files in commands(text):
        assert verb in TRAINER_VERBS | COMMANDS, verb
        for name in files:
            found = (any(folder.glob(PLACEHOLDER.sub("*", name))) for folder in FOLDERS)
            assert any(found), f"{verb} --config {name}"
    named = set(re.findall(r"benchmarks/[\w/]+\.py", text))
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_every_page_is_in_the_contents() -> None:
    index = ROOT / "docs" / "index.md"
    listed = {line for block in re.findall(r"```\{toctree\}\n(.*?)```", index.read_text(), re.DOTALL) for line in block.split()}
    pages = {str(path.relative_to(index.parent).with_suffix("")) for path in PAGES} - {"index"}
    pages |= {f"cards/{path.stem}" for path in (ROOT / "docs" / "cards").iterdir()}
    notebooks = (ROOT / "notebooks").rglob("*.ipynb")
    pages |= {str(path.relative_to(ROOT).with_suffix("")) for path in notebooks if ".ipynb_checkpoints" not in path.parts}
    assert pages - listed == set()


def test_the_tables_of_forms_are_what_the_results_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "experiments"))
    forms = runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "forms.py"))
    content = json.loads((ROOT / "results" / "forms.json").read_text(encoding="utf-8"))
    assert forms["summary"](content["families"]) == content["summary"]
    assert forms["page"](content) == (ROOT / "results" / "forms.md").read_text(encoding="utf-8"), (
        "run benchmarks/experiments/forms.py"
    )


def test_pages_tell_the_numbers_of_strokes() -> None:
    content = json.loads((ROOT / "results" / "strokes.json").read_text(encoding="utf-8"))
    rates = [f"{content[encoder]['recognised']['new kinds']:.2f}" for encoder in ("hashing", "minilm")]
    looks = {
        name: [f"{content[encoder]['looks'][name]:.2f}" for encoder in ("hashing", "minilm")]
        for name in ("spread", "novelty", "roughness")
    }
    told = f"new kinds {rates[0]} with hashing and {rates[1]} with MiniLM; "
    told += ", ".join(f"{name} {one} and {other}" for name, (one, other) in looks.items())
    assert told in (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("script", "results", "out", "names"),
    [
        ("tabletop_table.py", "results", ".", ("tabletop.md", "tabletop_wide.md")),
        ("mocap_table.py", "results/mocap.csv", "mocap.md", ("mocap.md",)),
    ],
)
def test_the_tables_of_the_table_top_and_of_human_motion_are_what_the_results_say(
    script: str, results: str, out: str, names: tuple[str, ...], tmp_path: Path
) -> None:
    runpy.run_path(str(ROOT / "benchmarks" / "making" / script))["main"]([f"--results={ROOT / results}", f"--out={tmp_path / out}"])
    for name in names:
        kept = (ROOT / "results" / name).read_text(encoding="utf-8")
        assert (tmp_path / name).read_text(encoding="utf-8") == kept, f"run benchmarks/making/{script}"


@pytest.mark.parametrize("name", ["settings", "paper"])
def test_a_generated_page_is_what_its_command_writes(name: str) -> None:
    """The table of settings by the configurations, and the page of the paper by the results."""
    made = runpy.run_path(str(ROOT / "docs" / f"{name}.py"))
    page = (made["PAGE"] if name == "settings" else ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert (made["written"](page) if name == "settings" else made["page"]()) == page, f"run docs/{name}.py"


def test_the_table_of_starts_is_what_was_measured() -> None:
    imports = runpy.run_path(str(ROOT / "benchmarks" / "speed" / "imports.py"))
    page = (ROOT / "results" / "imports.md").read_text(encoding="utf-8")
    found = json.loads((ROOT / "results" / "imports.json").read_text(encoding="utf-8"))
    assert imports["table"](found) == page, "run benchmarks/speed/imports.py --page"
    assert set(found["help"]) <= TRAINER_VERBS.keys() | COMMANDS.keys(), "run benchmarks/speed/imports.py"


ONLY_PRINTED = {"0.32": "Section 5.1", "people 80 %": "Table 1", "people 40 %": "Table 1", "people 26.7 %": "Table 1"}
"""The paper's numbers that stand beside ours in no table of a domain, as `apps/paper.yaml` has them, and where they are printed."""


def test_the_papers_numbers_on_its_page_are_those_of_the_domains() -> None:
    checked = 0
    for item in items():
        for name, papers, chosen in item.get("rows", ()):
            row = {**item.get("all", {}), **chosen}
            if not papers or papers in ONLY_PRINTED:
                continue
            of = domain_of_file(row.get("domain", Path(row["file"]).stem)).comparison.paper
            assert of is not None
            subject = (row["setting"], row["method"], row.get("metric", ""))
            same = [one for one in of.numbers if (one.setting, one.method, one.metric) == subject]
            same = [one for one in same if one.task in ("", row.get("task")) and one.components == row.get("K", one.components)]
            assert papers in {plus_minus(one.value, one.error) for one in same}, f"{item['item']}, {name}"
            checked += 1
    assert checked > 30


def test_the_notes_tell_how_well_the_judge_of_motion_recognises_unseen_people() -> None:
    content = json.loads((ROOT / "results" / "mocap_judge.json").read_text(encoding="utf-8"))
    runs = content["across people"]
    notes = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
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
