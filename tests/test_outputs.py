"""What is written and printed is for its reader: names from files mean nothing to LaTeX, Markdown, HTML, figures and terminals."""

import io
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from ftl_lightning.cli import main
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.domains.line_plots import picture
from ftl_lightning.escape import figure_text, latex, latex_row, markdown
from ftl_lightning.evaluation.animation import captioned
from ftl_lightning.evaluation.results import append_rows
from ftl_lightning.evaluation.row import Row
from ftl_lightning.printing import line, plain, say
from ftl_lightning.study.answers import read_key
from tests.conftest import ROOT
from tests.study import simulated, write_films

NAMES = (
    r"\input{/etc/passwd}",
    "$x_1$",
    r"$\frac{$",
    r"\$a$b$",
    "_begins and ends_ a_name",
    r"\write18{touch planted}",
    r"\end{tabular}\end{document}",
    "[1cm] of a row",
    "* of a row",
    "100 % & # ^ ~ {braces}",
    "^^5cinput",
    "a | b || c",
    "ends in a backslash \\",
    "ends in two \\\\",
    "`code` ``more``",
    "**bold** __bold__ ~~gone~~",
    "<script>alert(1)</script>",
    "<!-- results: end -->",
    "<img src=x onerror=alert(1)>",
    "&lt;b&gt; &copy;",
    "![picture](http://example.com/x.png)",
    "[link](http://example.com) <http://example.com>",
    "[link][reference] [[page]] [^note]",
    "https://example.com www.example.com",
    "{{ value }} {role}`text`",
    "two\nlines\r\nor | three",
    CLEARS := "clear \x1b[2J\x1b]0;title\x07 \x9b31m \x08\x7f",
    TURNED := "turned \u202eround\u202c \u2066and\u2069",
    "wide\u00a0space\u2028and\u2029ends",
    MARKED := "[bold red]mark[/bold red] [/] [link=http://example.com]there[/link]",
    "%DATA% %TITLE% {minutes} %s {} {0}",
)
"""Names that mean something somewhere."""
UNPRINTABLE = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""What moves a terminal's cursor or turns writing round, a line's end aside."""
LITERAL = ("${HOME}", "$x", "{seed}", "%s", "${oc.env:HOME}", "$(touch planted)")
"""Folders whose names mean something elsewhere."""


def row(setting: str, method: str, **changes: Any) -> Row:
    values = {"domain": "strange", "task": "one", "K": 2, "omega": "learned", "demonstrations": 5, "seed": 0, "n": 50}
    values |= {"metric": "accuracy", "value": 0.5, "model_hash": "m", "config_hash": "c"}
    return Row(setting=setting, method=method, **(values | changes))


def tempered(name: str, **changes: Any) -> dict[str, Any]:
    values = {"domain": "strange", "suite": name, "setting": name, "task": "one", "method": name, "variant": name}
    return {**values, "temperature": 1.0, "seed": 0, "n": 9, "accuracy": 0.5, "novelty": 1.0, "coverage": 2.0, **changes}


def write_results(folder: Path) -> Path:
    """Results of which every name is strange, in every table and figure that there is."""
    rows = [
        row(NAMES[number % 6], method, variant=name, omega=name, task="two" if method == "FTL-IGM" else "one", **role)
        for number, name in enumerate(NAMES)
        for method, role in (("FTL-IGM", {"form": name}), (name, {}), ("FTL-IGM", {}), (name, {"role": "reference"}))
    ]
    for name in ("ablation", "comparison"):
        append_rows(folder / f"{name}.csv", rows)
    append_rows(folder / "changes.csv", [row(name, "FTL-IGM", variant=name) for name in NAMES])
    grown = {"domain": "agent", "omega": "0.6", "n": 60}
    append_rows(folder / "curves.csv", [row(name, "FTL-IGM", demonstrations=count, **grown) for name in NAMES for count in (5, 9)])
    (folder / "frontier.json").write_text(json.dumps({"rows": [tempered(name) for name in NAMES]}))
    curves = [{"curve": name, "steps": at, "seconds": at, "accuracy": 0.5} for name in NAMES for at in (1, 2)]
    (folder / "speed.json").write_text(json.dumps({"curves": curves}))
    return folder


class Reported:
    """What one run of ``report`` wrote, printed and drew."""

    def __init__(self, folder: Path) -> None:
        self.figures: dict[str, list[Text]] = {}
        saved = Figure.savefig

        def savefig(figure: Figure, path: Path, **options: Any) -> None:
            saved(figure, path, **options)
            self.figures[path.name.split(".")[1]] = [one for one in figure.findobj(Text) if isinstance(one, Text)]

        results = write_results(folder / "results")
        before = Path.cwd()
        os.chdir(folder)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Figure, "savefig", savefig)
            (folder / "README.md").write_text("<!-- results: begin -->\nold\n<!-- results: end -->\nafter\n")
            with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
                assert main(["report", f"--results={results}", "--out=out", "--readme=README.md"]) == 0
        os.chdir(before)
        self.folder, self.printed = folder, out.getvalue() + err.getvalue()
        self.tables = {path.name: path.read_text(encoding="utf-8") for path in (folder / "out").rglob("*.md")}
        self.latex = {path.name: path.read_text(encoding="utf-8") for path in (folder / "out").rglob("*.tex")}


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    return Reported(tmp_path_factory.mktemp("reported"))


# LaTeX.

FRAME = re.compile(
    r"\\(begin|end)\{table\}|\\begin\{tabular\}\{lc*\}|\\end\{tabular\}|\\(top|mid|bottom)rule"
    r"|\\caption\{(?P<caption>.*)\}|(?P<row>.*) \\\\"
)
LETTERS = re.compile(
    r"(\\text(backslash|bar|ascii\w+)\{\}|\\[{}$&%#_]|\$(\\pm|<|>)\$|\{\}(?=[\[*])|[^\\{}$%#_^~`|\x00-\x1f\x7f-\x9f])*"
)
"""What a cell may be made of."""


def test_a_latex_table_holds_nothing_but_letters_and_its_frame(reported: Reported) -> None:
    assert {"accuracy.tex", "comparison.tex", "changes.tex", "curves.tex", "frontier.tex", "omega.tex", "overview.tex"} <= {
        *reported.latex
    }
    for name, text in reported.latex.items():
        columns = text.count("c", text.index("{tabular}{"), text.index("\n\\toprule"))
        for one in text.splitlines():
            found = FRAME.fullmatch(one)
            assert found, (name, one)
            assert LETTERS.fullmatch(found["caption"] or ""), (name, one)
            if found["row"] is not None:
                assert not one.startswith(("[", "*")), (name, one)  # the end of the row before would take it
                cells = re.split(r"(?<!\\)&", found["row"])
                assert len(cells) == columns + 1, (name, one)
                assert all(LETTERS.fullmatch(cell) for cell in cells), (name, one)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_read_back_from_latex(name: str) -> None:
    meant = {r"\textbackslash{}": "\\", r"\textasciicircum{}": "^", r"\textasciitilde{}": "~", r"\textasciigrave{}": "`"}
    meant |= {r"\textbar{}": "|", "$<$": "<", "$>$": ">", **{f"\\{one}": one for one in "{}$&%#_"}}
    told = re.sub("|".join(map(re.escape, meant)), lambda found: meant[found[0]], latex(name))
    assert told == line(name)


def test_names_of_our_own_are_written_as_they_were() -> None:
    for name in ("FTL-IGM", "K = 2", "learned ω", "0.82 [0.67]", "the paper's", "FTL-IGM (entities, free)", "+0.003; -", "", "a/b"):
        assert latex(name) == markdown(name) == figure_text(name) == name
    assert markdown("object_rearrangement, p < .001, 0.8 ± 0.1, 95 %") == "object_rearrangement, p < .001, 0.8 ± 0.1, 95 %"
    assert latex("object_rearrangement, p < .001, 0.8 ± 0.1, 95 %") == r"object\_rearrangement, p $<$ .001, 0.8 $\pm$ 0.1, 95 \%"
    assert latex_row(["a", "[b]"]) == r"a & [b] \\"
    assert latex_row(["[a]", "b"]) == r"{}[a] & b \\"


def test_the_committed_tables_are_what_the_committed_results_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: None)  # which takes most of the time
    assert main(["report", f"--results={ROOT / 'results'}", "--out=out"]) == 0
    written = [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".md", ".tex")]
    assert len(written) > 50
    for path in written:
        assert path.read_bytes() == (ROOT / "results" / "report" / path.relative_to(tmp_path / "out")).read_bytes(), path


# Markdown.

READER = MarkdownIt("commonmark").enable(["table", "strikethrough"])


def read_tables(text: str) -> list[list[list[str]]]:
    """Cells of the tables of a Markdown text, as a reader sees them; nothing but text may be in them."""
    tables: list[list[list[str]]] = []
    for token in READER.parse(text):
        if token.type == "table_open":
            tables.append([])
        elif token.type == "tr_open":
            tables[-1].append([])
        elif token.type == "inline":
            kinds = {child.type for child in token.children or ()}
            cell = token.level > 1
            assert kinds <= ({"text", "text_special"} | (set() if cell else {"strong_open", "strong_close"})), token.content
            if cell:
                tables[-1][-1].append("".join(child.content for child in token.children or ()))
        else:
            assert token.type in ("paragraph_open", "paragraph_close") or token.type.split("_")[0] in (
                "table", "thead", "tbody", "tr", "th", "td"
            ), token.type  # fmt: skip
    return tables


def test_a_markdown_table_holds_nothing_but_text_in_as_many_cells_as_it_has_columns(reported: Reported) -> None:
    assert {"accuracy.md", "comparison.md", "changes.md", "curves.md", "frontier.md", "omega.md", "overview.md"} <= {
        *reported.tables
    }
    for name, text in reported.tables.items():
        (cells,) = read_tables(text)
        assert len({len(one) for one in cells}) == 1, name
        assert text.count("\n|") == len(cells) + 1, name  # the reader has left none out
        assert not re.search(r"<(?=\S)|(?<!\\)://|\bwww\.", text), name  # addresses and tags that other readers look for


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_read_back_from_markdown(reported: Reported, name: str) -> None:
    (cells,) = read_tables(reported.tables["changes.md"])
    assert line(name) in [one[0] for one in cells[1:]]
    (cells,) = read_tables(reported.tables["comparison.md"])
    assert line(name) in [one[2] for one in cells[1:]]
    (cells,) = read_tables(f"| {markdown(name)} | {markdown(name)} |\n| --- | --- |\n")
    assert cells == [[line(name)] * 2]


def test_the_marks_of_a_readme_are_there_once(reported: Reported) -> None:
    text = (reported.folder / "README.md").read_text()
    assert text.count("<!--") == 2
    assert text.endswith("<!-- results: end -->\nafter\n")


# Figures.


@pytest.mark.parametrize("figure", ["accuracy", "comparison_accuracy", "curves", "frontier", "speed"])
def test_a_figure_shows_names_letter_by_letter(reported: Reported, figure: str) -> None:
    texts = [one for one in reported.figures[figure] if one.get_text() and not one.get_text().startswith("$\\mathdefault")]
    shown, formula = zip(*(one._preprocess_math(one.get_text()) for one in texts), strict=True)  # type: ignore[attr-defined]
    assert not any(formula)
    assert not any(UNPRINTABLE.search(one) for one in shown)
    assert {*NAMES[:5]} <= {re.split(r" \(|, ", one)[0].strip() for one in shown}  # some figures show five curves


def test_a_legend_leaves_no_name_out_and_long_ones_are_shortened() -> None:
    assert figure_text("_hidden") == " _hidden"
    assert len(figure_text("long " * 1000)) <= 120


def test_columns_and_titles_of_own_data_are_no_formulas() -> None:
    import torch

    figure = picture(["$x$", "_y"] * 2)(torch.zeros(2, 5, 4), None, r"go to $\frac{$" + "\x1b[2J", None)
    figure.savefig("f.png")
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert [one.get_text() for one in legend.get_texts()] == [r"\$x\$", " _y"] * 2
    assert figure.get_suptitle() == r"go to \$\frac{\$?[2J"


def test_a_caption_draws_what_cannot_be_printed_as_question_marks() -> None:
    picture = np.zeros((20, 200, 3), dtype=np.uint8)
    (strange,), (honest,) = captioned([picture], "a\x1b[2J\x00\u202eb\nc"), captioned([picture], "a?[2J??b\nc")
    assert (strange == honest).all()


def test_a_hundred_settings_are_no_picture_of_gigabytes(tmp_path: Path) -> None:
    append_rows(tmp_path / "r.csv", [row(f"setting {number}", "FTL-IGM") for number in range(100)])
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    width, height = Image.open("out/strange/accuracy.png").size
    assert (width, height) == (60 * 120, 408)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            [row(f"s{one}", f"m{one}") for one in range(101)],
            "domain 'strange': expected at most 10000 pairs of a setting and a method",
        ),
        ([row("s", "FTL-IGM", omega=f"{one}", K=one) for one in range(101)], "expected at most 10000 pairs"),
        ([row("s", "FTL-IGM", domain=f"d{one}") for one in range(101)], "expected at most 100 domains, found 101"),
    ],
)
def test_tables_that_would_take_hours_are_refused_at_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], rows: list[Row], message: str
) -> None:
    append_rows(tmp_path / "r.csv", rows)
    assert main(["report", "--results=r.csv", "--out=out"]) == 2
    told = capfd.readouterr().err
    assert told.startswith("error: r.csv: ")
    assert message in told
    assert told.count("\n") == 1
    assert not Path("out").exists()


# What a metric and a domain are called decides no place.


@pytest.mark.parametrize("metric", ["../../planted", "/planted", "a/b", "..", ".hidden", "\x1b[2J", "$x$", "m" * 400])
def test_a_figure_stays_in_its_folder_whatever_the_metric_is_called(tmp_path: Path, metric: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", metric=metric)])
    assert main(["report", "--results=in", "--out=in/out/deep"]) == 0
    written = [path.relative_to(tmp_path / "in") for path in (tmp_path / "in").rglob("*") if path.is_file()]
    assert [path for path in written if path.parts[:3] != ("out", "deep", "strange")] == [Path("r.csv")]
    assert [path.name for path in written if path.suffix == ".png" and not path.name.startswith(".") and len(path.name) < 110]
    assert not (tmp_path / "planted.png").exists()


@pytest.mark.parametrize("domain", ["../../x", "/tmp/x", "a/b", "..", ".hidden", "\x1b[2J", "module:DOMAIN", "x" * 400])
def test_a_domain_that_no_folder_can_be_called_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str], domain: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM"), row("new", "FTL-IGM", domain=domain)])
    assert main(["report", "--results=in", "--out=in/out"]) == 2
    told = capfd.readouterr().err
    assert "column 'domain': expected a name of letters, digits and - . +, found" in told
    assert told.splitlines()[-1].startswith("error: ")
    assert not UNPRINTABLE.search(told)
    assert not (tmp_path / "in" / "out").exists() or not [*(tmp_path / "in" / "out").rglob("x*")]


def test_a_domain_that_is_not_installed_is_told_and_shown(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    append_rows(tmp_path / "r.csv", [row("new", "FTL-IGM", domain="chess")])
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    assert capfd.readouterr().err == "domain 'chess' is not installed: its tables are made from the results alone\n"
    assert Path("out/chess/accuracy.md").is_file()


# Measurements that are none.


def replaced(values: dict[str, Any], **changes: Any) -> str:
    return json.dumps({**values, **changes})


CURVE = {"curve": "a", "steps": 1, "seconds": 1, "accuracy": 1}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("speed.json", f'{{"curves": [{json.dumps(CURVE)}, {replaced(CURVE, accuracy=None)}]}}', "key 'curves[1].accuracy'"),
        ("speed.json", f'{{"curves": [{replaced(CURVE, seconds="1")}]}}', "key 'curves[0].seconds'"),
        ("speed.json", f'{{"curves": [{replaced(CURVE, curve=["a"])}]}}', "key 'curves[0].curve'"),
        ("speed.json", f'{{"curves": [{replaced(CURVE, accuracy=True)}]}}', "key 'curves[0].accuracy'"),
        ("speed.json", '{"curves": [{"curve": "a"}]}', "key 'curves[0].steps'"),
        ("speed.json", '{"curves": {}}', "key 'curves': expected a list"),
        ("speed.json", '{"curves": [7]}', "key 'curves[0]': expected a mapping, found 7"),
        ("speed.json", "[]", "key 'curves': expected a list"),
        (
            "frontier.json",
            f'{{"rows": [{replaced(tempered("a"), domain=None)}]}}',
            "key 'rows[0].domain': expected a value",
        ),
        ("frontier.json", f'{{"rows": [{replaced(tempered("a"), method=5)}]}}', "key 'rows[0].method': expected a text"),
        ("frontier.json", f'{{"rows": [{replaced(tempered("a"), setting={})}]}}', "key 'rows[0].setting': expected a text"),
        ("frontier.json", f'{{"rows": [{replaced(tempered("a"), coverage="far")}]}}', "key 'rows[0].coverage'"),
        ("frontier.json", '{"rows": [null]}', "key 'rows[0]': expected a mapping"),
        ("frontier.json", '{"rows": "many"}', "key 'rows': expected a list"),
    ],
)
def test_measurements_of_something_else_are_told_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: str, message: str
) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", domain="agent")])
    (tmp_path / "in" / name).write_text(content)
    assert main(["report", "--results=in", "--out=out"]) == 2
    told = capfd.readouterr().err
    assert told.startswith(f"error: in/{name}: expected ")
    assert message in told
    assert told.count("\n") == 1


def test_measurements_without_a_rate_are_left_out_and_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM")])
    rows = [tempered("a"), tempered("b", accuracy=None), tempered("c", coverage=None)]
    (tmp_path / "in" / "frontier.json").write_text(json.dumps({"rows": rows}))
    assert main(["report", "--results=in", "--out=out"]) == 0
    assert "in: 2 rows of frontier.json are left out, which have no accuracy or no coverage\n" in capfd.readouterr().out
    (cells,) = read_tables(Path("out/strange/frontier.md").read_text())
    assert len(cells) == 2


@pytest.mark.parametrize("value", ["", "nan", "inf", "null", "1e999", "half"])
def test_a_rate_that_is_no_number_is_told_with_its_row(tmp_path: Path, capfd: pytest.CaptureFixture[str], value: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", value=0.25)])
    text = (tmp_path / "in" / "r.csv").read_text()
    (tmp_path / "in" / "r.csv").write_text(text.replace("0.25", value))
    assert main(["report", "--results=in", "--out=out"]) == 2
    told = capfd.readouterr().err
    assert told.startswith("error: in/r.csv: row 2, ")
    assert "column 'value': expected a finite number" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(("won", "lost", "n"), [(-1.0, 0.0, 50), (1e300, 0.0, 50), (1.0, 1.0, 50), (0.0, 0.0, 0)])
def test_episodes_that_cannot_be_are_told_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], won: float, lost: float, n: int
) -> None:
    shares = {"won against FASTER": won, "lost against FASTER": lost}
    place: dict[str, Any] = {"domain": "driving", "setting": "new initial state", "n": n}
    append_rows(tmp_path / "r.csv", [row(method="FTL-IGM", metric=name, value=value, **place) for name, value in shares.items()])
    assert main(["report", "--results=r.csv", "--out=out"]) == 2
    told = capfd.readouterr().err
    assert "expected shares of the same episodes" in told
    assert told.count("\n") == 1


def test_an_episode_count_of_quadrillions_takes_no_time(tmp_path: Path) -> None:
    shares = {"won against FASTER": 0.5, "lost against FASTER": 0.5}
    place: dict[str, Any] = {"domain": "driving", "setting": "new initial state", "n": 2**52}
    append_rows(tmp_path / "r.csv", [row(method="FTL-IGM", metric=name, value=value, **place) for name, value in shares.items()])
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    assert "same outcome in 0 of 4503599627370496" in Path("out/driving/paired.md").read_text()


def test_a_readme_in_another_encoding_is_told_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    append_rows(tmp_path / "r.csv", [row("new", "FTL-IGM", domain="agent")])
    Path("README.md").write_bytes("<!-- results: begin -->\n<!-- results: end -->\ncafé\n".encode("latin-1"))
    assert main(["report", "--results=r.csv", "--out=out", "--readme=README.md"]) == 2
    told = capfd.readouterr().err
    assert told == "error: README.md: expected a Markdown file in utf-8, found other bytes; save it as UTF-8\n"


# The study's page.


class Page(HTMLParser):
    """A page as a browser reads it: its elements, and the text of its title and scripts."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[str] = []
        self.texts: dict[str, list[str]] = {"title": [], "script": []}
        self.feed(text)
        self.close()
        self.data = json.loads(self.texts["script"][0])

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.elements.append(tag)

    def handle_data(self, data: str) -> None:
        if self.elements and self.elements[-1] in self.texts and data.strip():
            self.texts[self.elements[-1]].append(data)


@pytest.fixture
def films(tmp_path: Path) -> Path:
    return write_films(tmp_path / "films")


WORDS = (
    "%DATA%",
    "%SCRIPT%%STYLE%%TITLE%%DATA%",
    r"\1 \g<0> \n",
    "</title><script>alert(1)</script>",
    "</script><script>alert(1)</script>",
    "<!-- <script> -->",
    "--> ]]> &amp; & ' \"",
    "a\u2028b\u2029c",
    "\x1b[2J\x07\x00 \u202eturned",
)


@pytest.mark.parametrize("words", WORDS)
def test_words_of_a_study_change_nothing_in_its_page(films: Path, words: str) -> None:
    assert main(["study", "tests.study:PEOPLE", f"--films={films}", "--out=honest"]) == 0
    listing = [
        {"concept": f"{concept} {words}", "method": method, "file": f"{method}/{concept}.safetensors"}
        for method in ("BC", "VAE", "Ours")
        for concept in ("walk", "run", "march", "breaststroke", "chop_wood", "jumping_jacks")
    ]
    (films / "films.json").write_text(json.dumps(listing))
    Path("consent.txt").write_text(words, encoding="utf-8")
    title = "".join(one for one in words if one != "\x00")  # no argument of a program has one
    options = [f"--films={films}", "--out=study", f"--title={title}", "--consent=consent.txt"]
    assert main(["study", "tests.study:PEOPLE", *options]) == 0
    text = Path("study/study.html").read_text(encoding="utf-8")
    page, honest = Page(text), Page(Path("honest/study.html").read_text(encoding="utf-8"))
    assert page.elements == honest.elements
    assert page.texts["title"] == [line(title)]
    assert page.texts["script"][1] == honest.texts["script"][1]
    assert not re.search("[<>&\u2028\u2029]", page.texts["script"][0])
    assert page.data["title"] == line(title)
    assert page.data["consent"] == plain(words).strip()
    assert f"Does this film depict “{line(f'walk {words}')}”?" in {one["text"] for one in page.data["questions"]}
    assert not UNPRINTABLE.search(text)


def test_a_row_of_a_film_that_is_no_number_is_refused(films: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for value in (True, 1.0, "1", None, [1], -1, 2, 10**400):
        listing = [{"concept": "walk", "method": "BC", "file": "BC/walk.safetensors", "row": value}]
        (films / "films.json").write_text(json.dumps(listing))
        assert main(["study", "tests.study:PEOPLE", f"--films={films}", "--out=study"]) == 2
        told = capfd.readouterr().err
        assert "films.json: key 'row' of BC/walk.safetensors: expected 0 to 1, found " in told
        assert told.count("\n") == 1
        assert len(told) < 400


@pytest.mark.parametrize("change", [{"scenario": ["a"]}, {"setting": None}, {"method": 3}, {"x" * 1000: 1}])
def test_a_film_of_something_else_is_told_in_one_short_line(
    films: Path, capfd: pytest.CaptureFixture[str], change: dict[str, Any]
) -> None:
    (films / "films.json").write_text(json.dumps([{"concept": "walk", "method": "BC", "file": "BC/walk.safetensors", **change}]))
    assert main(["study", "tests.study:PEOPLE", f"--films={films}", "--out=study"]) == 2
    told = capfd.readouterr().err
    assert "films.json: film 0: " in told
    assert told.count("\n") == 1
    assert len(told) < 400


@pytest.mark.parametrize("folder", LITERAL)
def test_a_folder_is_the_one_that_is_named(
    tmp_path: Path, films: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], folder: str
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("x", str(home))
    append_rows(Path(folder) / "r.csv", [row("new", "FTL-IGM")])
    assert main(["report", f"--results={folder}", f"--out={folder}/out"]) == 0
    assert capfd.readouterr().out.endswith(f"written to {folder}/out\n")
    assert Path(folder, "out", "strange", "accuracy.md").is_file()
    films.rename(Path(folder, "films"))
    assert main(["study", "tests.study:PEOPLE", f"--films={folder}/films", f"--out={folder}/study"]) == 0
    assert {path.name for path in Path(folder, "study").iterdir()} == {"study.html", "key.json"}
    Path("c.yaml").write_text(json.dumps({"results": f"{folder}/r.csv", "out": f"{folder}/configured"}))
    assert main(["report", "--config=c.yaml"]) == 0
    assert Path(folder, "configured", "strange", "accuracy.md").is_file()
    assert not [*home.iterdir()]
    assert {path.name for path in tmp_path.iterdir()} == {"home", folder, "c.yaml"}


# Terminals.


def strange_key(folder: Path) -> Path:
    """A study's key in which methods and settings have strange names, with the answers of two people."""
    write_films(folder / "films")
    assert main(["study", "tests.study:PEOPLE", f"--films={folder / 'films'}", f"--out={folder / 'study'}"]) == 0
    path = folder / "study" / "key.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for film in content["films"].values():
        film["method"] = {"BC": CLEARS, "VAE": MARKED}.get(film["method"], film["method"])
        film["setting"] = {"new": "new " + TURNED}.get(film["setting"], "[/]" + CLEARS)
    for question in content["questions"].values():
        if question["kind"] == "best":
            question["setting"] = {"new": "new " + TURNED}.get(question["setting"], "[/]" + CLEARS)
    path.write_text(json.dumps(content))
    key = read_key(path)
    for number in range(2):
        simulated(folder / "study" / f"answers-{number}.json", key, f"r{number}")
    (folder / "study" / f"answers-{CLEARS.replace('/', '')}.json").write_text("{")
    return folder / "study"


def test_a_report_prints_nothing_that_a_terminal_would_act_on(reported: Reported) -> None:
    assert "clear ?[2J?]0;title? ?31m ??" in reported.printed
    assert not UNPRINTABLE.search(reported.printed)


def test_a_report_of_a_study_prints_nothing_that_a_terminal_would_act_on(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = strange_key(tmp_path)
    capfd.readouterr()
    assert main(["study-report", str(folder)]) == 0
    out, err = capfd.readouterr()
    assert not UNPRINTABLE.search(out + err)
    assert "clear ?[2J?]0;title?" in out
    assert "refused: " in err
    assert "answers-clear ?[2J" in err


@contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """Both ends of a terminal."""
    ours, theirs = pty.openpty()
    try:
        yield ours, theirs
    finally:
        os.close(ours)
        os.close(theirs)


def run(*arguments: str, **changes: Any) -> "subprocess.CompletedProcess[bytes]":
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **changes.pop("env", {})}
    command = [sys.executable, "-m", "ftl_lightning", *arguments]
    return subprocess.run(command, env=variables, check=False, timeout=120, **changes)


def test_a_table_in_a_real_terminal_has_its_names_as_they_read(tmp_path: Path) -> None:
    folder = strange_key(tmp_path)
    with terminal() as (ours, theirs):
        done = run("study-report", str(folder), stdout=theirs, stderr=subprocess.PIPE, env={"COLUMNS": "600", "TERM": "xterm"})
        os.set_blocking(ours, False)
        out = os.read(ours, 1_000_000).decode()
    assert done.returncode == 0
    styles = re.sub("\x1b\\[[0-9;]*m", "", out).replace("\r\n", "\n")  # of the table itself
    assert not UNPRINTABLE.search(styles)
    assert "[/]clear ?[2J?]0;title?" in styles
    assert line(MARKED) in styles


ASCII = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "LANG": "C", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}


def test_outputs_work_where_the_terminal_knows_ascii_alone(tmp_path: Path) -> None:
    rows = [row("new ω", "FTL-IGM", task=task, value=value) for task, value in (("a", 0.2), ("b", 0.4))]
    append_rows(tmp_path / "in" / "r.csv", rows)
    done = run("report", "--results=in", "--out=out", env=ASCII, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert "| new ? | FTL-IGM | 0.30 ? 0.10" in done.stdout.decode("ascii")
    assert "0.30 ± 0.10" in Path("out/strange/accuracy.md").read_text(encoding="utf-8")
    done = run("study-report", str(strange_key(tmp_path)), env=ASCII, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert "mean ? standard deviation" in done.stdout.decode("ascii")
    done = run("report", "--results=wörk", env=ASCII, capture_output=True)
    assert done.returncode == 2
    assert done.stderr.decode("ascii").startswith("error: w")


@pytest.mark.parametrize("name", NAMES)
def test_what_is_said_is_printable_in_as_many_lines(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "\n" not in line(name)
    assert not UNPRINTABLE.search(line(name))
    say(name)
    say(name, error=True)
    out, err = capsys.readouterr()
    assert out == err == plain(name) + "\n"
    assert out.count("\n") == name.count("\n") + 1
    assert not UNPRINTABLE.search(out)


@pytest.mark.parametrize("name", ["cleared\x1b[2J\x07", "turned \u202egnp.exe"], ids=ascii)
def test_what_a_concept_is_called_moves_no_cursor(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    concept = Concept.load(ROOT / "pretrained" / "mocap" / "arm_circle.safetensors")
    replace(concept, origin=replace(concept.origin, name=name)).save("c.safetensors")
    assert main(["explain", "--concept=c.safetensors", f"--pretrained={ROOT / 'pretrained' / 'mocap'}"]) == 0
    out, err = capfd.readouterr()
    assert out.startswith(f"{line(name)}: learned from ")
    assert not UNPRINTABLE.search(out + err)
