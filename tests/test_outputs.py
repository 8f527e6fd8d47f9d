"""What is written and printed is for its reader: names from files mean nothing to LaTeX, Markdown, HTML, figures and terminals."""

import io
import json
import os
import pty
import re
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from ftl_lightning.apps.study.report import read_key
from ftl_lightning.cli.main import main
from ftl_lightning.domains.pictures import line_drawings
from ftl_lightning.evaluation.pictures import captioned
from ftl_lightning.evaluation.results import Row, append_rows, read_rows
from ftl_lightning.igm.concept import Concept
from ftl_lightning.reporting import report
from ftl_lightning.reporting.figures import TALLEST, WIDTH, accuracy_bars
from ftl_lightning.reporting.measurements import read_frontier, read_speed
from ftl_lightning.reporting.report import write_report
from ftl_lightning.reporting.table import domain_of
from ftl_lightning.services.text import figure_text, latex, latex_row, line, markdown, plain, say
from tests import conftest
from tests.conftest import ROOT, Once, python, succeed
from tests.study import simulated, write_films
from tests.test_mistakes import refusal

Told = pytest.CaptureFixture[str]
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


def write_results(folder: Path, names: Sequence[str], settings: int) -> Path:
    """Results of which every name is strange, in every table and figure that there is."""
    rows = [
        row(NAMES[number % settings], method, variant=name, omega=name, task="two" if method == "FTL-IGM" else "one", **role)
        for number, name in enumerate(names)
        for method, role in (("FTL-IGM", {}), (name, {}), (name, {"role": "reference"}), ("FTL-IGM", {"form": name}))
        if number < 6 or "form" not in role
    ]
    append_rows(folder / "ablation.csv", rows[: 4 * max(settings, 2)])  # whose tables take much longer than the others
    append_rows(folder / "comparison.csv", rows)
    changes = [row(NAMES[number % settings], "FTL-IGM", variant=name) for number, name in enumerate(names)]
    append_rows(folder / "changes.csv", changes)
    grown = {"domain": "agent", "omega": "0.6", "n": 60}
    append_rows(folder / "curves.csv", [row(name, "FTL-IGM", demonstrations=count, **grown) for name in names for count in (5, 9)])
    (folder / "frontier.json").write_text(json.dumps({"rows": [tempered(name) for name in names]}))
    curves = [{"curve": name, "steps": at, "seconds": at, "accuracy": 0.5} for name in names for at in (1, 2)]
    (folder / "speed.json").write_text(json.dumps({"curves": curves}))
    return folder


def write_reported(folder: Path) -> None:
    """Run ``report`` on results of all names, and keep what it prints."""
    results = write_results(folder / "results", NAMES, 1)
    with pytest.MonkeyPatch.context() as patch:
        # which take most of the time, and have a test of their own
        for name in ("accuracy_bars", "comparison_bars", "frontier", "growth", "learning_time", "overview_dots"):
            patch.setattr(report, name, lambda *arguments: Figure())
        (folder / "README.md").write_text("<!-- results: begin -->\nold\n<!-- results: end -->\nafter\n")
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
            succeed("report", f"--results={results}", "--out=out", "--readme=README.md")
    (folder / "printed.txt").write_bytes((out.getvalue() + err.getvalue()).encode())


class Reported:
    """What one run of ``report`` wrote and printed, of all names."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.printed = folder, (folder / "printed.txt").read_bytes().decode()
        self.tables = {path.name: path.read_text(encoding="utf-8") for path in (folder / "out").rglob("*.md")}
        self.latex = {path.name: path.read_text(encoding="utf-8") for path in (folder / "out").rglob("*.tex")}
        self.cells = cache(lambda: {name: cells for name, text in self.tables.items() for cells in read_tables(text)})


@pytest.fixture(scope="module")
def reported(once: Once) -> Reported:
    return Reported(once("reported", write_reported))


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Text]]:
    """The texts in each figure of a report of some names."""
    folder, texts = tmp_path_factory.mktemp("figures"), dict[str, list[Text]]()

    def savefig(figure: Figure, path: Path, **options: Any) -> None:
        figure.draw_without_rendering()
        texts[path.name.split(".")[1]] = [one for one in figure.findobj(Text) if isinstance(one, Text)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        write_report(write_results(folder / "results", NAMES[:5], 5), folder / "out")
    return texts


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of a report are empty files, since drawing takes most of its time."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: None)


undrawn = pytest.mark.usefixtures("_undrawn")


def refused(capsys: Told, arguments: list[str], *expected: str) -> None:
    """As for every mistake, with nothing else on standard error."""
    told = conftest.refused(capsys, arguments, *expected)
    assert told.count("\n") == 1
    assert not UNPRINTABLE.search(told)


# LaTeX.

FRAME = re.compile(
    r"\\(begin|end)\{table\}|\\begin\{tabular\}\{lc*\}|\\end\{tabular\}|\\(top|mid|bottom)rule"
    r"|\\caption\{(?P<caption>.*)\}|(?P<row>.*) \\\\"
)
LETTERS = re.compile(
    r"(\\text(backslash|bar|ascii\w+)\{\}|\\[{}$&%#_]|\$(\\pm|<|>)\$|\{\}(?=[\[*])|[^\\{}$%#_^~`|\x00-\x1f\x7f-\x9f])*"
)
"""What a cell may be made of."""


TABLES = {"accuracy", "comparison", "changes", "curves", "frontier", "omega", "overview"}


def test_a_latex_table_holds_nothing_but_letters_and_its_frame(reported: Reported) -> None:
    assert {Path(name).stem for name in reported.latex} >= TABLES
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
def test_every_name_is_read_back_from_latex_and_markdown(reported: Reported, name: str) -> None:
    meant = {r"\textbackslash{}": "\\", r"\textasciicircum{}": "^", r"\textasciitilde{}": "~", r"\textasciigrave{}": "`"}
    meant |= {r"\textbar{}": "|", "$<$": "<", "$>$": ">", **{f"\\{one}": one for one in "{}$&%#_"}}
    told = re.sub("|".join(map(re.escape, meant)), lambda found: meant[found[0]], latex(name))
    assert told == line(name)
    assert line(name) in [one[0] for one in reported.cells()["changes.md"][1:]]
    assert line(name) in [one[2] for one in reported.cells()["comparison.md"][1:]]
    (cells,) = read_tables(f"| {markdown(name)} | {markdown(name)} |\n| --- | --- |\n")
    assert cells == [[line(name)] * 2]


def test_names_of_our_own_are_written_as_they_were() -> None:
    for name in ("FTL-IGM", "K = 2", "learned ω", "0.82 [0.67]", "the paper's", "FTL-IGM (entities, free)", "+0.003; -", "", "a/b"):
        assert latex(name) == markdown(name) == figure_text(name) == name
    assert markdown("object_rearrangement, p < .001, 0.8 ± 0.1, 95 %") == "object_rearrangement, p < .001, 0.8 ± 0.1, 95 %"
    assert latex("object_rearrangement, p < .001, 0.8 ± 0.1, 95 %") == r"object\_rearrangement, p $<$ .001, 0.8 $\pm$ 0.1, 95 \%"
    assert latex_row(["a", "[b]"]) == r"a & [b] \\"
    assert latex_row(["[a]", "b"]) == r"{}[a] & b \\"


def expect_committed(folder: Path) -> int:
    """Compare every table of a folder with the committed one, and count them."""
    written = [path for path in folder.rglob("*") if path.suffix in (".md", ".tex")]
    for path in written:
        assert path.read_bytes() == (ROOT / "results" / "report" / path.relative_to(folder)).read_bytes(), path
    return len(written)


@pytest.mark.slow
@undrawn
def test_the_committed_tables_are_what_the_committed_results_say() -> None:
    write_report(ROOT / "results", Path("out"))
    assert expect_committed(Path("out")) > 50


@pytest.mark.slow
@undrawn
def test_the_committed_tables_of_a_domain_are_what_its_committed_results_say() -> None:
    for name in ("tabletop_wide", "comparison", "curves", "changes"):
        lines = (ROOT / "results" / f"{name}.csv").read_text(encoding="utf-8").splitlines(keepends=True)
        rows = "".join(line for line in lines[1:] if line.startswith("tabletop_wide,"))
        if rows:
            Path(f"in/{name}.csv").parent.mkdir(exist_ok=True)
            Path(f"in/{name}.csv").write_text(lines[0] + rows, encoding="utf-8")
    write_report(Path("in"), Path("out"))
    for path in Path("out").glob("*.*"):  # of all domains
        path.unlink()
    assert expect_committed(Path("out")) > 5


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
    assert {Path(name).stem for name in reported.tables} >= TABLES
    for name, text in reported.tables.items():
        cells = reported.cells()[name]
        assert len({len(one) for one in cells}) == 1, name
        assert text.count("\n|") == len(cells) + 1, name  # the reader has left none out
        assert not re.search(r"<(?=\S)|(?<!\\)://|\bwww\.", text), name  # addresses and tags that other readers look for


# Figures.


@pytest.mark.slow
@pytest.mark.parametrize("figure", ["accuracy", "comparison_accuracy", "curves", "frontier", "speed"])
def test_a_figure_shows_names_letter_by_letter(figures: dict[str, list[Text]], figure: str) -> None:
    texts = [one for one in figures[figure] if one.get_text() and not one.get_text().startswith("$\\mathdefault")]
    shown, formula = zip(*(one._preprocess_math(one.get_text()) for one in texts), strict=True)  # type: ignore[attr-defined]
    assert not any(formula)
    assert not any(UNPRINTABLE.search(one) for one in shown)
    assert {*NAMES[:5]} <= {re.split(r" \(|, ", " ".join(one.split()))[0] for one in shown}  # some figures show five curves


def test_texts_of_figures_are_no_formulas_and_none_is_left_out_and_long_ones_are_shortened() -> None:
    import torch

    assert figure_text("_hidden") == " _hidden"
    assert len(figure_text("long " * 1000)) <= 120
    figure = line_drawings(["$x$", "_y"] * 2).picture(torch.zeros(2, 5, 4), None, r"go to $\frac{$" + "\x1b[2J", None)
    figure.savefig("f.png")
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert [one.get_text() for one in legend.get_texts()] == [r"\$x\$", " _y"] * 2
    assert figure.get_suptitle() == r"go to \$\frac{\$?[2J"


def test_a_caption_draws_what_cannot_be_printed_as_question_marks() -> None:
    film = [np.zeros((20, 200, 3), dtype=np.uint8)]
    (strange,), (honest,) = captioned(film, "a\x1b[2J\x00\u202eb\nc"), captioned(film, "a?[2J??b\nc")
    assert (strange == honest).all()


def test_many_settings_are_no_picture_of_gigabytes(tmp_path: Path) -> None:
    append_rows(tmp_path / "r.csv", [row(f"setting {number}", "FTL-IGM") for number in range(70)])
    rows = read_rows("r.csv")
    assert tuple(accuracy_bars(domain_of("strange", rows), rows).get_size_inches()) == (WIDTH, TALLEST)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([row(f"s{n}", f"m{n}") for n in range(101)], "domain 'strange': expected at most 10000 pairs of a setting and a method"),
        ([row("s", "FTL-IGM", omega=f"{one}", K=one) for one in range(101)], "expected at most 10000 pairs"),
        ([row("s", "FTL-IGM", domain=f"d{one}") for one in range(101)], "expected at most 100 domains, found 101"),
    ],
)
def test_tables_that_would_take_hours_are_refused_at_once(tmp_path: Path, capsys: Told, rows: list[Row], message: str) -> None:
    append_rows(tmp_path / "r.csv", rows)
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "error: r.csv: ", message)


# What a metric and a domain are called decides no place.


@undrawn
@pytest.mark.parametrize("metric", ["../../planted", "/planted", "a/b", "..", ".hidden", "\x1b[2J", "$x$", "m" * 400])
def test_a_figure_stays_in_its_folder_whatever_the_metric_is_called(tmp_path: Path, metric: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", metric=metric)])
    assert main(["report", "--results=in", "--out=in/out/deep"]) == 0
    written = [path.relative_to(tmp_path / "in") for path in (tmp_path / "in").rglob("*") if path.is_file()]
    assert [path for path in written if path.parts[:3] != ("out", "deep", "strange")] == [Path("r.csv")]
    assert [path.name for path in written if path.suffix == ".png" and not path.name.startswith(".") and len(path.name) < 110]
    assert not (tmp_path / "planted.png").exists()


DOMAINS = ("../../x", "/tmp/x", "a/b", "a\\b", "..", ".hidden", "", "~", "\x1b[2J", "module:DOMAIN", "x" * 300, "x" * 400)


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda value: ascii(value)[:20])
def test_a_domain_that_no_folder_can_be_called_is_refused(tmp_path: Path, capsys: Told, domain: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM"), row("new", "FTL-IGM", domain=domain)])
    expected = "r.csv: row 3, column 'domain': expected a name of letters, digits and - . +, found"
    refused(capsys, ["report", "--results=in", "--out=in/out"], expected)


def test_a_domain_that_is_not_installed_is_told_and_shown(tmp_path: Path, capfd: Told) -> None:
    append_rows(tmp_path / "r.csv", [row("new", "FTL-IGM", domain="chess")])
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    assert capfd.readouterr().err == "domain 'chess' is not installed: its tables are made from the results alone\n"
    assert Path("out/chess/accuracy.md").is_file()
    assert Image.open("out/chess/accuracy.png").size == (528, 125)


# Measurements that are none.


CURVE = {"curve": "a", "steps": 1, "seconds": 1, "accuracy": 1}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("speed.json", {"curves": [CURVE, CURVE | {"accuracy": None}]}, "key 'curves[1].accuracy'"),
        ("speed.json", {"curves": [CURVE | {"seconds": "1"}]}, "key 'curves[0].seconds'"),
        ("speed.json", {"curves": [CURVE | {"curve": ["a"]}]}, "key 'curves[0].curve'"),
        ("speed.json", {"curves": [CURVE | {"accuracy": True}]}, "key 'curves[0].accuracy'"),
        ("speed.json", {"curves": [{"curve": "a"}]}, "key 'curves[0].steps'"),
        *(("speed.json", content, "key 'curves': expected a list") for content in ({"curves": {}}, [])),
        ("speed.json", {"curves": [7]}, "key 'curves[0]': expected a mapping, found 7"),
        ("frontier.json", {"rows": [tempered("a", domain=None)]}, "key 'rows[0].domain': expected a value"),
        ("frontier.json", {"rows": [tempered("a", method=5)]}, "key 'rows[0].method': expected a text"),
        ("frontier.json", {"rows": [tempered("a", setting={})]}, "key 'rows[0].setting': expected a text"),
        ("frontier.json", {"rows": [tempered("a", coverage="far")]}, "key 'rows[0].coverage'"),
        ("frontier.json", {"rows": [None]}, "key 'rows[0]': expected a mapping"),
        ("frontier.json", {"rows": "many"}, "key 'rows': expected a list"),
    ],
)
def test_measurements_of_something_else_are_told_in_one_line(name: str, content: object, message: str) -> None:
    Path(name).write_text(json.dumps(content))
    with refusal(message) as told:
        (read_speed if name == "speed.json" else read_frontier)(name)
    assert str(told.value).startswith(f"{name}: expected ")


@pytest.mark.parametrize(("name", "key"), [("speed.json", "curves"), ("frontier.json", "rows")])
@undrawn
def test_measurements_of_something_else_are_refused_by_a_report(tmp_path: Path, capfd: Told, name: str, key: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", domain="agent")])
    (tmp_path / "in" / name).write_text(json.dumps({key: [7]}))
    assert main(["report", "--results=in", "--out=out"]) == 2
    told = capfd.readouterr().err
    assert told.startswith(f"error: in/{name}: expected ")
    assert f"key '{key}[0]': expected a mapping, found 7" in told
    assert told.count("\n") == 1


@undrawn
def test_measurements_without_a_rate_are_left_out_and_told(tmp_path: Path, capfd: Told) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM")])
    rows = [tempered("a"), tempered("b", accuracy=None), tempered("c", coverage=None)]
    (tmp_path / "in" / "frontier.json").write_text(json.dumps({"rows": rows}))
    assert main(["report", "--results=in", "--out=out"]) == 0
    assert "in: 2 rows of frontier.json are left out, which have no accuracy or no coverage\n" in capfd.readouterr().out
    (cells,) = read_tables(Path("out/strange/frontier.md").read_text())
    assert len(cells) == 2


@pytest.mark.parametrize("value", ["", "nan", "inf", "null", "None", "1e999", "half"])
def test_a_rate_that_is_no_number_is_told_with_its_row(tmp_path: Path, capsys: Told, value: str) -> None:
    append_rows(tmp_path / "in" / "r.csv", [row("new", "FTL-IGM", value=0.25)])
    text = (tmp_path / "in" / "r.csv").read_text()
    (tmp_path / "in" / "r.csv").write_text(text.replace("0.25", value))
    expected = "error: in/r.csv: row 2, column 'value': expected a finite number"
    refused(capsys, ["report", "--results=in", "--out=out"], expected)


def shared(tmp_path: Path, won: float, lost: float, n: int) -> None:
    """Results ``r.csv`` with shares of episodes that end otherwise than a policy's."""
    place: dict[str, Any] = {"domain": "driving", "setting": "new initial state", "n": n}
    shares = {"won against FASTER": won, "lost against FASTER": lost}
    append_rows(tmp_path / "r.csv", [row(method="FTL-IGM", metric=name, value=value, **place) for name, value in shares.items()])


@pytest.mark.parametrize(("won", "lost", "n"), [(-1.0, 0.0, 50), (1e300, 0.0, 50), (1.0, 1.0, 50), (0.0, 0.0, 0)])
def test_episodes_that_cannot_be_are_told_in_one_line(tmp_path: Path, capsys: Told, won: float, lost: float, n: int) -> None:
    shared(tmp_path, won, lost, n)
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "expected shares of the same episodes")


@undrawn
def test_an_episode_count_of_quadrillions_takes_no_time(tmp_path: Path) -> None:
    shared(tmp_path, 0.5, 0.5, 2**52)
    assert main(["report", "--results=r.csv", "--out=out"]) == 0
    assert "same outcome in 0 of 4503599627370496" in Path("out/driving/paired.md").read_text()


@undrawn
def test_a_readme_in_another_encoding_is_told_in_one_line(tmp_path: Path, capfd: Told) -> None:
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


@pytest.mark.parametrize(
    "words",
    [
        "%DATA%",
        "%SCRIPT%%STYLE%%TITLE%%DATA%",
        r"\1 \g<0> \n",
        "</title><script>alert(1)</script>",
        "</script><script>alert(1)</script>",
        "<!-- <script> -->",
        "--> ]]> &amp; & ' \"",
        "a\u2028b\u2029c",
        "\x1b[2J\x07\x00 \u202eturned",
    ],
)
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


def test_a_film_of_something_else_is_told_in_one_short_line(films: Path, capsys: Told) -> None:
    rows = [{"row": value} for value in (True, 1.0, "1", None, [1], -1, 2, 10**400)]
    for change in (*rows, {"scenario": ["a"]}, {"setting": None}, {"method": 3}, {"x" * 1000: 1}):
        film = {"concept": "walk", "method": "BC", "file": "BC/walk.safetensors", **change}
        (films / "films.json").write_text(json.dumps([film]))
        expected = "key 'row' of BC/walk.safetensors: expected 0 to 1, found 2" if change == {"row": 2} else "key 'films[0]."
        refused(capsys, ["study", "tests.study:PEOPLE", f"--films={films}", "--out=study"], f"films.json: {expected}")


@undrawn
@pytest.mark.parametrize("folder", LITERAL)
def test_a_folder_is_the_one_that_is_named(
    tmp_path: Path, films: Path, monkeypatch: pytest.MonkeyPatch, capfd: Told, folder: str
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    for name in ("HOME", "x"):
        monkeypatch.setenv(name, str(home))
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


def test_a_report_prints_nothing_that_a_terminal_would_act_on_and_leaves_a_readme_its_marks(reported: Reported) -> None:
    text = (reported.folder / "README.md").read_text()
    assert text.count("<!--") == 2
    assert text.endswith("<!-- results: end -->\nafter\n")
    assert "clear ?[2J?]0;title? ?31m ??" in reported.printed
    assert not UNPRINTABLE.search(reported.printed)


def test_a_report_of_a_study_prints_nothing_that_a_terminal_would_act_on(tmp_path: Path, capfd: Told) -> None:
    folder = strange_key(tmp_path)
    capfd.readouterr()
    assert main(["study-report", str(folder)]) == 0
    out, err = capfd.readouterr()
    assert not UNPRINTABLE.search(out + err)
    assert "clear ?[2J?]0;title?" in out
    assert "refused: " in err
    assert "answers-clear ?[2J" in err


def test_a_table_in_a_real_terminal_has_its_names_as_they_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = strange_key(tmp_path)
    for name, value in (("COLUMNS", "600"), ("TERM", "xterm")):
        monkeypatch.setenv(name, value)
    written = b""
    ours, theirs = pty.openpty()
    with os.fdopen(ours, "rb"), os.fdopen(theirs, "w") as file, redirect_stdout(file):
        assert main(["study-report", str(folder)]) == 0
        file.flush()
        os.set_blocking(ours, False)
        with suppress(BlockingIOError):
            while part := os.read(ours, 1_000_000):
                written += part
    out = written.decode()
    assert "\x1b[" in out
    styles = re.sub("\x1b\\[[0-9;]*m", "", out).replace("\r\n", "\n")  # of the table itself
    assert not UNPRINTABLE.search(styles)
    assert "[/]clear ?[2J?]0;title?" in styles
    assert line(MARKED) in styles


ASCII = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "LANG": "C", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}


def spread(tmp_path: Path) -> None:
    rows = [row("new ω", "FTL-IGM", task=task, value=value) for task, value in (("a", 0.2), ("b", 0.4))]
    append_rows(tmp_path / "in" / "r.csv", rows)


@undrawn
def test_outputs_work_where_the_terminal_knows_ascii_alone(tmp_path: Path) -> None:
    spread(tmp_path)
    folder = strange_key(tmp_path)
    with redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)) as out:
        assert main(["report", "--results=in", "--out=out"]) == 0
        assert main(["study-report", str(folder)]) == 0
    told = out.buffer.getvalue().decode("ascii")  # type: ignore[attr-defined]
    assert "| new ? | FTL-IGM | 0.30 ? 0.10" in told
    assert "0.30 ± 0.10" in Path("out/strange/accuracy.md").read_text(encoding="utf-8")
    assert "mean ? standard deviation" in told


@pytest.mark.slow
def test_the_program_works_where_the_terminal_knows_ascii_alone(tmp_path: Path) -> None:
    spread(tmp_path)
    done = python("-m", "ftl_lightning", "report", "--results=in", "--out=out", **ASCII)
    assert done.returncode == 0, done.stderr
    assert "| new ? | FTL-IGM | 0.30 ? 0.10" in done.stdout
    done = python("-m", "ftl_lightning", "report", "--results=wörk", **ASCII)
    assert done.returncode == 2
    assert done.stderr.startswith("error: w")
    assert (done.stdout + done.stderr).isascii()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_said_is_printable_in_as_many_lines(name: str, capsys: Told) -> None:
    assert "\n" not in line(name)
    assert not UNPRINTABLE.search(line(name))
    say(name)
    say(name, error=True)
    out, err = capsys.readouterr()
    assert out == err == plain(name) + "\n"
    assert out.count("\n") == name.count("\n") + 1
    assert not UNPRINTABLE.search(out)


@pytest.mark.parametrize("name", ["cleared\x1b[2J\x07", "turned \u202egnp.exe"], ids=ascii)
def test_what_a_concept_is_called_moves_no_cursor(name: str, capfd: Told) -> None:
    concept = Concept.load(ROOT / "pretrained" / "mocap" / "arm_circle.safetensors")
    replace(concept, origin=replace(concept.origin, name=name)).save("c.safetensors")
    assert main(["explain", "--concept=c.safetensors", f"--pretrained={ROOT / 'pretrained' / 'mocap'}"]) == 0
    out, err = capfd.readouterr()
    assert out.startswith(f"{line(name)}: learned from ")
    assert not UNPRINTABLE.search(out + err)
