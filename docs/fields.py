"""The tables of fields in ``own-domain.md``, written from the docstrings of the classes: ``make fields``."""

import ast
import dataclasses
import inspect
import re
import sys
import textwrap
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from ftl_lightning.data.features import Feature
from ftl_lightning.domains.comparison import Comparison, Paper, Published
from ftl_lightning.domains.domain import Concepts, Domain, Metric, Plans, Privileged, Recordings, View
from ftl_lightning.domains.execution import ClosedLoop
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.tasks import EvaluationTask

CLASSES: tuple[type, ...] = (
    Domain,
    Plans,
    Concepts,
    EvaluationTask,
    Feature,
    Metric,
    Show,
    ClosedLoop,
    View,
    Comparison,
    Paper,
    Published,
    Recordings,
    Privileged,
)
PAGE = Path(__file__).parent / "own-domain.md"
BEGIN, END = "<!-- fields: begin, written by `make fields` -->\n", "<!-- fields: end -->\n"

ATTRIBUTE = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {8,}.*)*)", re.MULTILINE)
ROLE = re.compile(r":\w+:`~?(?:[\w.]*\.)?(\w+)`")


def attributes(docstring: str) -> list[tuple[tuple[str, ...], str]]:
    """Names of fields and what a docstring's section ``Attributes`` says of them, as Markdown."""
    section = docstring.partition("Attributes:\n")[2].partition("\n\n")[0]
    found = []
    for names, text in ATTRIBUTE.findall(section):
        code = ROLE.sub(r"``\1``", " ".join(text.split()))
        found.append((tuple(names.split(", ")), code.replace("``", "`").replace("|", r"\|")))
    return found


def _type(annotation: ast.expr) -> str:
    """A field's type. A function is called so: its description says what it takes and returns."""
    match annotation:
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            return f"{_type(left)} or {_type(right)}"
        case ast.Subscript(value=ast.Name(id="Callable")):
            return "function"
        case ast.Subscript(value=ast.Name(id="Mapping"), slice=ast.Tuple(elts=[_, values])):
            return f"names to {_type(values).removesuffix(' or `None`')}"
        case ast.Subscript(value=ast.Name(id="Literal"), slice=ast.Tuple(elts=values)):
            return " or ".join(f"`{ast.unparse(value)}`" for value in values)
        case ast.Name(id="Distance"):
            return "function"
        case ast.Constant(value=str(quoted)):
            return _type(ast.parse(quoted, mode="eval").body)
    return f"`{ast.unparse(annotation)}`"


def _default(field: "dataclasses.Field[object]") -> str:
    if dataclasses.is_dataclass(field.default_factory):
        return f"`{field.default_factory.__name__}()`"
    if field.default_factory is not dataclasses.MISSING:
        return f"`{field.default_factory()!r}`"
    if field.default is dataclasses.MISSING:
        return "required"
    return "a function" if callable(field.default) else f"`{field.default!r}`"


def table(described: type) -> str:
    """One class: its name and first sentence, and a row for each field."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(described))).body[0]
    assert isinstance(definition, ast.ClassDef)
    lines = [line for line in definition.body if isinstance(line, ast.AnnAssign)]
    types = {ast.unparse(line.target): line.annotation for line in lines}
    # a default that follows from the other fields is a private constant in the code; the description says what it is
    follows = {ast.unparse(line.target) for line in lines if getattr(line.value, "id", "").startswith("_")}
    fields = {field.name: field for field in dataclasses.fields(described)}
    docstring = inspect.getdoc(described) or ""
    rows = attributes(docstring)
    if sorted(named := [name for names, _ in rows for name in names]) != sorted(fields):
        raise ValueError(f"{described.__name__}: the docstring describes {named}, the class has {list(fields)}")
    rendered = [
        f"`{described.__name__}`. {docstring.splitlines()[0]}",
        "",
        "| field | type | default | what it holds |",
        "|---|---|---|---|",
    ]
    for names, text in rows:
        default = "follows from other fields" if names[0] in follows else _default(fields[names[0]])
        rendered.append(f"| {', '.join(f'`{name}`' for name in names)} | {_type(types[names[0]])} | {default} | {text} |")
    return "\n".join(rendered) + "\n"


def written(page: str) -> str:
    """The page with its tables as the docstrings say them.

    Raises:
        ValueError: if the page lacks one of the two marks, or a docstring does not describe each field of its class.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"expected the marks {BEGIN.strip()} and {END.strip()}")
    tables = "\n".join(table(described) for described in CLASSES)
    return f"{before}{begin}\n{tables}\n{end}{after}"


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
