"""The API reference: it names all that is public, and docstrings name arguments, shapes and errors."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from typing import NamedTuple

import pytest

import ftl_lightning
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "reference.md").read_text("utf-8")
MODULES = re.findall(r"^\.\. automodule:: (\S+)$", PAGE, re.M)
ENTRANCE = [
    "ftl_lightning.cli.concepts",
    "ftl_lightning.cli.demonstrations",
    "ftl_lightning.cli.experiments",
    "ftl_lightning.cli.pages",
    "ftl_lightning.igm.composition",
    "ftl_lightning.igm.concept",
    "ftl_lightning.igm.forms.modes",
    "ftl_lightning.data.demonstrations",
    "ftl_lightning.few_shot.plans",
    "ftl_lightning.few_shot.learner",
    "ftl_lightning.few_shot.learned_concept",
    "ftl_lightning.igm.library",
    "ftl_lightning.services.shipped",
    "ftl_lightning.few_shot.tuned",
]
"""What programs of users meet first: here every argument is named."""
IMPORT = re.compile(r"^\s*from (ftl_lightning(?:\.\w+)*) import ", re.M)
SECTION = re.compile(r"^\s*(?:Args|Attributes):", re.M)


class Documented(NamedTuple):
    """A public function or method, or a class with its constructor."""

    name: str
    node: ast.FunctionDef
    doc: str
    member: bool
    own: bool = True

    @property
    def arguments(self) -> list[ast.arg]:
        """But for the object itself, and those that are passed on by any name."""
        given = self.node.args
        bound = self.member and not any(ast.unparse(one) == "staticmethod" for one in self.node.decorator_list)
        return [*given.posonlyargs, *given.args, *given.kwonlyargs][bound:]

    @property
    def refuses(self) -> bool:
        """Whether it raises a mistake of the user's itself."""
        raised = [node.exc for node in ast.walk(self.node) if isinstance(node, ast.Raise)]
        return any(isinstance(one, ast.Call) and ast.unparse(one.func) == "UserError" for one in raised)


def documented(name: str) -> Iterator[Documented]:
    """All of a module; a method without words of its own has those of the method that it overrides."""
    module = importlib.import_module(name)
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield Documented(f"{name}.{node.name}", node, ast.get_docstring(node) or "", member=False)
        if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
            continue
        kind = getattr(module, node.name)
        for inner in node.body:
            if not isinstance(inner, ast.FunctionDef):
                continue
            if inner.name == "__init__":
                yield Documented(f"{name}.{node.name}", inner, ast.get_docstring(node) or "", member=True)
            elif not inner.name.startswith("_"):
                own = ast.get_docstring(inner)
                doc = own or inspect.getdoc(getattr(kind, inner.name)) or ""
                yield Documented(f"{name}.{node.name}.{inner.name}", inner, doc, member=True, own=own is not None)


def test_everything_that_the_package_offers_is_in_the_reference() -> None:
    offered = {f"ftl_lightning.{module}" for module in ftl_lightning._MODULES.values()} - {"ftl_lightning.version"}
    assert offered <= set(MODULES)
    assert len(MODULES) == len(set(MODULES))


def test_what_the_pages_import_is_in_the_reference() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/domains/*.md")]
    used = {module for page in pages for module in IMPORT.findall(page.read_text("utf-8"))} - {"ftl_lightning"}
    missing = {name for name in used if not any(name == known or known.startswith(f"{name}.") for known in MODULES)}
    assert used - missing
    assert missing == set()


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_says_what_it_is_and_what_it_refuses(name: str) -> None:
    assert importlib.import_module(name).__doc__
    found = list(documented(name))
    assert [one.name for one in found if not one.doc] == []
    assert [one.name for one in found if one.own and one.refuses and "UserError" not in one.doc] == []


@pytest.mark.parametrize("name", ENTRANCE)
def test_arguments_are_named_and_tensors_have_shapes(name: str) -> None:
    wrong = []
    for one in documented(name):
        for argument in one.arguments:
            if not re.search(rf"\b{argument.arg}\b", one.doc):
                wrong.append(f"{one.name}: {argument.arg} is not named")
            kind = "" if argument.annotation is None else ast.unparse(argument.annotation)
            if re.search(r"\b(?:Tensor|ArrayLike)\b", kind) and "``(" not in one.doc and "see :meth:" not in one.doc:
                wrong.append(f"{one.name}: {argument.arg} has no shape")
    assert wrong == []
