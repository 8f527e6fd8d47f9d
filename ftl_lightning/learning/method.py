"""What a method is: one declaration that a package offers through the entry-point group ``ftl_lightning.methods``."""

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ftl_lightning.errors import UserError, about

if TYPE_CHECKING:  # a declaration is read without torch
    from ftl_lightning.domains.domain import Domain

INVERSION = "ftl_lightning.learning.forms:learn"
"""The learner of methods whose concepts are learned by gradient descent."""


@dataclass(frozen=True)
class Form:
    """A form of a method's concepts that the paper does not have, which tables show beside the method's own.

    Attributes:
        name: in the results' column ``form``, such as ``'with modes'``.
        option: of the adaptation's hyper-parameters, the one that decides.
        usual: its value in the paper's form.
    """

    name: str
    option: str
    usual: Any


@dataclass(frozen=True)
class Method:
    """A way to learn tasks from a few demonstrations.

    ``model``, ``pretraining``, ``adaptation``, ``learner`` and ``suits`` are ``'package.module:NAME'``, imported when they are
    needed.

    Attributes:
        name: in tables and results.
        kind: of its pretrained models, as their ``config.json`` says. A method that adapts another's models has that one's kind.
        adaptation: the LightningModule of ``invert``, an :class:`~ftl_lightning.learning.adaptation.Adaptation`.
        model: the network, a :class:`~ftl_lightning.learning.concept_model.ConceptModel`; empty where it is another method's.
        pretraining: the LightningModule of ``fit``, a :class:`~ftl_lightning.learning.pretraining.Pretraining`; empty where the
            network is another method's.
        learner: how concepts are learned without a trainer, a :class:`~ftl_lightning.learning.learner.Learner`; gradient descent
            through the model's losses unless it says otherwise.
        forms: of its concepts, in the order in which their names are joined.
        configurations: folder of its configuration files, one for each domain; empty for none.
        suits: a function of a domain that raises a ``UserError`` for one that the method cannot do; empty if it can do all.
    """

    name: str
    kind: str
    adaptation: str = "ftl_lightning.learning.inversion_module:InversionModule"
    model: str = ""
    pretraining: str = ""
    learner: str = INVERSION
    forms: Sequence[Form] = ()
    configurations: str = ""
    suits: str = ""

    def expect_settings(self, names: Iterable[str]) -> None:
        """Refuse settings of an inversion where concepts are not learned by gradient descent.

        Raises:
            UserError: naming the first.
        """
        if self.learner != INVERSION and (name := next(iter(names), None)) is not None:
            told = f"as {self.name} learns without gradient descent, found {name}"
            raise UserError(f"learn: expected no settings of an inversion, {told}")

    def model_class(self) -> Any:
        """The network's class."""
        return self._named(self.model)

    def pretraining_class(self) -> Any:
        """The LightningModule of ``fit``."""
        return self._named(self.pretraining)

    def adaptation_class(self) -> Any:
        """The LightningModule of ``invert``."""
        return self._named(self.adaptation)

    def learn(self) -> Any:
        """How concepts are learned without a trainer."""
        return self._named(self.learner)

    def expect_domain(self, domain: "Domain") -> None:
        """Refuse a domain that the method cannot do.

        Raises:
            UserError: saying what it lacks.
        """
        if self.suits:
            with about(f"method {self.name}"):
                self._named(self.suits)(domain)

    def form(self, hparams: Mapping[str, Any]) -> str:
        """The form of concepts that are learned with these options; empty for the paper's."""
        return " ".join(form.name for form in self.forms if hparams[form.option] != form.usual)

    def _named(self, reference: str) -> Any:
        module, _, name = reference.partition(":")
        try:
            return getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(
                f"method {self.name}: expected {reference!r}, found no such thing ({error}); mend its package"
            ) from error
