"""The documentation's pages as people see them: tables that fit, in Markdown and in a browser."""

import html
import http.server
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from ftl_lightning.reporting.table import MOST_COLUMNS
from tests.test_docs import PAGES, README, ROOT, included

SITE = ROOT / "docs" / "_build" / "html"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WIDTHS = (1280, 390)
"""Pixels of a window on a desk, and of one in a hand."""
MEASURE = """<!doctype html><title>measuring</title><pre id="found"></pre><script>
const pages = %s, widths = %s, found = [];
const scrolls = (one) => ["auto", "scroll"].includes(getComputedStyle(one).overflowX);
function wider(frame, width) {
  const page = frame.contentDocument, told = [];
  for (const one of page.querySelectorAll("details")) one.open = true;
  for (const one of page.querySelectorAll("article *")) {
    let above = one.parentElement;
    while (above && !scrolls(above)) above = above.parentElement;
    if (!above && one.getBoundingClientRect().right > width + 1) told.push(one.tagName + " " + one.className);
  }
  return {scroll: page.documentElement.scrollWidth, elements: told.slice(0, 5), articles: page.querySelectorAll("article").length};
}
async function measure(page, width) {
  const frame = document.createElement("iframe");
  frame.style.cssText = `width: ${width}px; height: 900px; border: 0`;
  frame.src = page;
  document.body.append(frame);
  await new Promise((done) => frame.addEventListener("load", done));
  found.push({page, width, ...wider(frame, width)});
  frame.remove();
}
(async () => {
  for (const page of pages) for (const width of widths) await measure(page, width);
  document.getElementById("found").textContent = JSON.stringify(found);
})();
</script>"""


WIDE = "wide.html"
SHEET = "<style>body {margin: 0} p {width: 700px; margin: 0} div {width: 300px; overflow-x: auto}</style>"
"""Of a page that is wider than a window in a hand, by one of its two paragraphs; the other one scrolls by itself."""


def columns(text: str) -> list[int]:
    """How many columns each of a text's tables has."""
    rules = re.findall(r"^\|?(?:\s*:?-+:?\s*\|)+(?:\s*:?-+:?\s*)?\|?$", text, re.MULTILINE)
    return [len(rule.strip().strip("|").split("|")) for rule in rules]


def test_columns_are_counted() -> None:
    assert columns("| a | b |\n| --- | :-: |\n| 1 | 2 |\n\n|a|b|c|\n|---|---|---|\n") == [2, 3]
    assert columns("a | b\n--- | ---\n") == [2]
    assert columns("---\ntitle\n---\n") == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_table_of_a_page_has_more_columns_than_fit(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    texts = {path: text} | {shown: shown.read_text(encoding="utf-8") for shown in included(path)}
    wide = {str(shown.relative_to(ROOT)): max(columns(told), default=0) for shown, told in texts.items()}
    assert {name: count for name, count in wide.items() if count > MOST_COLUMNS} == {}


def test_the_readmes_table_has_at_most_one_column_more() -> None:
    assert max(columns(README.read_text(encoding="utf-8"))) <= MOST_COLUMNS + 1


@pytest.mark.parametrize("sheet", sorted((ROOT / "ftl_lightning").glob("*/**/*.css")), ids=lambda path: path.name)
def test_text_of_pages_has_at_least_twelve_pixels(sheet: Path) -> None:
    sizes = [float(size) for size in re.findall(r"font-size: ([\d.]+)rem", sheet.read_text(encoding="utf-8"))]
    assert sizes
    assert min(sizes) * 16 >= 12


def test_commands_wrap_and_have_a_button_that_copies_them() -> None:
    page = SITE / "quick-start.html"
    if not page.is_file():
        pytest.skip("the documentation is not built: make docs")
    text = page.read_text(encoding="utf-8")
    assert "copybutton.js" in text
    assert "site.css" in text
    assert "pre-wrap" in (SITE / "_static" / "site.css").read_text(encoding="utf-8")


@contextmanager
def served(pages: list[str]) -> Iterator[str]:
    """The site on this machine alone, with a page that measures these."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            path = urlsplit(self.path).path
            if path == "/measure":
                body = (MEASURE % (json.dumps(pages), json.dumps(WIDTHS))).encode()
            elif path == f"/{WIDE}":
                body = f"<!doctype html>{SHEET}<article><p>wide</p><div><p class=inside>scrolls</p></div></article>".encode()
            else:
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(SITE))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/measure"
        server.shutdown()
        thread.join()


@pytest.mark.browser
def test_pages_of_results_are_no_wider_than_their_window(tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    pages = sorted(
        str(page.relative_to(SITE))
        for pattern in ("index.html", "baselines.html", "paper.html", "findings.html", "tables.html", "domains/*.html")
        for page in SITE.glob(pattern)
    )
    if not pages:
        pytest.skip("the documentation is not built: make docs")
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
    options += ("--disable-component-update", "--disable-sync", "--window-size=1400,1000", "--virtual-time-budget=120000")
    pages.append(WIDE)
    with served(pages) as address:
        command = [CHROMIUM, *options, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", address]
        shown = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True).stdout
    told = re.search(r'<pre id="found">(.*?)</pre>', shown, re.DOTALL)
    assert told is not None
    found = json.loads(html.unescape(told[1]))
    assert [(one["page"], one["width"]) for one in found] == [(page, width) for page in pages for width in WIDTHS]
    assert all(one["articles"] for one in found)
    wider = [one for one in found if one["scroll"] > one["width"] or one["elements"]]
    assert wider == [{"page": WIDE, "width": 390, "scroll": 700, "elements": ["P "], "articles": 1}]
