"""Numbers in these pages, each tied to its source by an entry in ``claims/PAGE.yaml``: ``python docs/claims.py [PAGE ...]``.

Prints what is wrong: a decimal number that no entry covers, or that is not what its source says.
"""

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

import yaml

from docs.sources import SourceError, values
from ftl_lightning.services.text import say

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "claims"
NUMBER = re.compile(r"(?<![\w.])(?<!\d,)-?(?:\d{1,3}(?:,\d{3})+|\d+)?(?:\.\d+|(?<=\d))(?!\d|\.\d|,\d{3})")
"""A number, such as ``1,000``, ``-0.5`` or ``.96``; no part of a name or of a version of three parts."""
UNREAD = (
    r"<!-- (\w+): begin.*?<!-- \1: end",  # compared by tests of their own, or noted by hand, as the page says
    r"^( *)(`{3,}|~{3,})[^\n]*\n.*?^ *\3`*$",  # code, included files
    r"(?<=\n\n)(?: {4}[^\n]*\n+)+",  # indented code
    r"(`+)(?!`)(?:(?!\n\n).)*?(?<!`)\4(?!`)",
    r"\]\([^)\s]*\)",
    r"https?://\S+",
)
PATTERN = re.compile("|".join(UNREAD), re.DOTALL | re.MULTILINE)


def pages() -> list[Path]:
    """All pages whose numbers are tied to sources; the page of the paper is generated."""
    docs = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "domains").glob("*.md")]
    tied = [page for page in docs if page.name != "paper.md"]
    return [ROOT / "README.md", *sorted(tied), *sorted(ROOT.glob("pretrained/*/README.md"))]


def claims_of(page: Path) -> Path:
    """The file of a page's claims, such as ``claims/domains/driving.yaml`` and ``claims/pretrained/agent.yaml``."""
    name = page.relative_to(ROOT).with_suffix("")
    parts = [part for part in name.parts if part != "docs"]
    return FOLDER / (Path(*parts[:-1]) if parts[0] == "pretrained" else Path(*parts)).with_suffix(".yaml")


def prose(text: str) -> str:
    """A page of the same length, with spaces in place of what is not read: code, links' targets, generated and included parts."""
    return PATTERN.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)


def shown(value: float, like: str) -> str:
    """A number with as many digits as another."""
    digits = f"{value:,.{len(like.partition('.')[2])}f}"
    return digits.replace("0.", ".", 1) if re.match(r"-?\.", like) else digits


def problems(text: str, claims: list[Mapping[str, Any]]) -> Iterator[tuple[int, str]]:
    """What is wrong with a page, given its claims: positions in its text, and messages."""
    flat, read = text.replace("\n", " "), prose(text).replace("\n", " ")
    decimals = {found.start(): found[0] for found in NUMBER.finditer(read) if "." in found[0]}
    covered: set[int] = set()
    for claim in claims:
        fragment = claim["text"]
        if (count := flat.count(fragment)) != 1:
            yield max(flat.find(fragment), 0), f"claim {fragment!r}: expected it once in the page, found it {count} times"
            continue
        begin = flat.index(fragment)
        found = [match for match in NUMBER.finditer(read, begin, begin + len(fragment)) if claim.get("whole") or "." in match[0]]
        twice = covered & {match.start() for match in found}
        covered |= {match.start() for match in found}
        if twice:
            yield min(twice), f"claim {fragment!r}: expected numbers of its own, found one that another claim covers"
        yield from _wrong(claim, begin, found)
    for start in sorted(decimals.keys() - covered):
        yield start, f"expected a claim that says where {decimals[start]} comes from, found none"


def _wrong(claim: Mapping[str, Any], begin: int, found: list[re.Match[str]]) -> Iterator[tuple[int, str]]:
    told: list[tuple[float, Any]] = []
    for reference in claim["values"]:
        try:
            told += [(value, reference) for value in values(reference)]
        except SourceError as error:
            yield begin, f"claim {claim['text']!r}: {reference}: {error}"
            return
    if len(told) != len(found):
        yield begin, f"claim {claim['text']!r}: expected a value for each of {[one[0] for one in found]}, found {len(told)}"
        return
    for match, (value, reference) in zip(found, told, strict=True):
        if (expected := shown(value, match[0])) != match[0]:
            yield match.start(), f"found {match[0]}, expected {expected} ({value:.6g}) from {reference}"


def wrong(page: Path) -> list[str]:
    """What is wrong with a page, a line each: its name, the line, the number found, the one expected, and from where."""
    text, path = page.read_text(encoding="utf-8"), claims_of(page)
    content = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {"claims": []}
    found = sorted(problems(text, content["claims"]))
    return [f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, start) + 1}: {message}" for start, message in found]


if __name__ == "__main__":
    lines = [line for page in map(Path.resolve, map(Path, sys.argv[1:])) for line in wrong(page)]
    lines += [] if len(sys.argv) > 1 else [line for page in pages() for line in wrong(page)]
    for line in lines:
        say(line)
    sys.exit(bool(lines))
