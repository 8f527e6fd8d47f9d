"""Methods: their declaration, offered by a package in the entry-point group ``ftl_lightning.methods``, and their registry."""

import importlib
import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.tensor_file import content_hash, file_hash
from ftl_lightning.services.trust import entry_points

if TYPE_CHECKING:
    from ftl_lightning.domains.domain import Domain


@dataclass(frozen=True)
class Form:
    """A form of a method's concepts beyond the paper's, with a row in tables.

    Attributes:
        name: name in the results' column ``form``, such as ``'with modes'``.
        option: the adaptation's hyper-parameter that decides.
        usual: value of the option in the paper's form.
    """

    name: str
    option: str
    usual: Any


@dataclass(frozen=True)
class Method:
    """A way to learn tasks from a few demonstrations.

    ``model``, ``pretraining`` and ``adaptation`` are functions that return a class, so that the declaration needs no torch.

    Attributes:
        name: name in tables and results.
        kind: kind of the pretrained models, as in ``config.json``. A method that adapts another method's models has their kind.
        model: the network, a :class:`~ftl_lightning.training.concept_model.ConceptModel`, which also learns concepts; ``None`` for
            another method's network.
        pretraining: the LightningModule of ``fit``, a :class:`~ftl_lightning.training.pretraining.Pretraining`; ``None`` for
            another method's network.
        adaptation: the LightningModule of ``invert``, an :class:`~ftl_lightning.training.adaptation.Adaptation`; by default
            gradient descent if the model is invertible, else the model's ``learn``.
        forms: forms of its concepts, in the order in which their names are joined.
        configurations: folder with a configuration file for each domain; empty for none.
        suits: raises a ``UserError`` for an unsupported domain.
    """

    name: str
    kind: str
    model: Callable[[], type[Any]] | None = None
    pretraining: Callable[[], type[Any]] | None = None
    adaptation: Callable[[], type[Any]] | None = None
    forms: Sequence[Form] = ()
    configurations: str = ""
    suits: "Callable[[Domain], None]" = lambda domain: None

    def check_domain(self, domain: "Domain") -> None:
        """Refuse an unsupported domain; ``UserError`` with what the domain lacks."""
        with about(f"method {self.name}"):
            self.suits(domain)

    def form(self, hparams: Mapping[str, Any]) -> str:
        """Form of concepts for these options; empty for the paper's form."""
        return ", ".join(form.name for form in self.forms if hparams[form.option] != form.usual)


def check_present(domain: "Domain") -> None:
    """Refuse domains without observations; ``UserError`` with the domain."""
    reason = f"{domain.name}: there is no present to go on from"
    require(domain.observed, "domain", "a domain with observed features", reason)


def check_present_or_moment(domain: "Domain") -> None:
    """Refuse domains without observations, unless plans are single states; ``UserError`` with the domain."""
    if domain.plans.horizon > 1:
        check_present(domain)


GROUP = "ftl_lightning.methods"
"""Entry-point group of methods: ``name = package.module:METHOD``."""
SHIPPED = ("ftl_igm", "bc", "regression", "cvae", "in_context", "language", "lora")
"""This package's methods, in the order of tables; others follow by name."""


def method_names() -> tuple[str, ...]:
    """Names of all methods, in the order of tables."""
    offered = _offered()
    return (*(name for name in SHIPPED if name in offered), *sorted(set(offered) - set(SHIPPED)))


def _offered() -> dict[str, str]:
    """``module:ATTRIBUTE`` of methods by name; this package's names take precedence."""
    offered = {point.name: point.value for point in reversed(entry_points(GROUP))}
    return offered | _ours()


def _ours() -> dict[str, str]:
    """Methods of this package, without a look-up of installed packages."""
    return {name: f"ftl_lightning.methods.declared:{name.upper()}" for name in SHIPPED}


def load_method(name: str) -> Method:
    """Load a method by name; ``UserError`` for an unknown name, or an object that is no method."""
    offered = _ours() if name in SHIPPED else _offered()
    if name not in offered:
        raise UserError(f"method: expected one of {', '.join(method_names())}, found {short(name)!r}")
    return _loaded(name, offered[name])


def code_hash(name: str) -> str:
    """Hash of the modules and settings of a method's package; empty for this package, which has a version.

    Raises:
        UserError: for an unknown name.
    """
    load_method(name)
    if name in SHIPPED:
        return ""
    spec = importlib.util.find_spec(_offered()[name].partition(":")[0].partition(".")[0])
    places = [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
    files = [path for place in places for kind in ("*.py", "*.yaml") for path in place.rglob(kind)]
    if spec is not None and spec.origin and not places:  # a single-file package
        files = [Path(spec.origin)]
    return content_hash(sorted((path.name, file_hash(path)) for path in files))


def _loaded(name: str, reference: str) -> Method:
    module, _, attribute = reference.partition(":")
    try:
        method = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # an imported module may raise anything
        raise UserError(f"method {name!r}: cannot be imported ({type(error).__name__}: {error}); mend its package") from error
    if not isinstance(method, Method):
        raise UserError(f"method {name!r}: expected a Method, found {type(method).__name__}; mend its package")
    return method


def methods() -> Iterator[Method]:
    """All methods, in the order of tables, imported lazily."""
    yield from (_loaded(name, reference) for name, reference in _ours().items())
    yield from (_loaded(name, reference) for name, reference in sorted(_offered().items()) if name not in SHIPPED)


def method_of(kind: str) -> Method:
    """The method with the network of a kind; ``UserError`` without any."""
    for method in methods():
        if method.model and method.kind == kind:
            return method
    raise UserError(f"kind: expected one of {', '.join(kinds())}, found {short(kind)!r}; install the method's package")


def kinds() -> list[str]:
    """All kinds of pretrained models."""
    return [method.kind for method in methods() if method.model]


def class_path(kind: type) -> str:
    """Name of a class in a configuration file."""
    return f"{kind.__module__}.{kind.__qualname__}"
