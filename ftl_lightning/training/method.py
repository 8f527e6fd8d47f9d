"""Declaration of a method, registered in the entry-point group ``ftl_lightning.methods``."""

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ftl_lightning.services.errors import UserError, about

if TYPE_CHECKING:  # declarations do not need torch
    from ftl_lightning.domains.domain import Domain

INVERSION = "ftl_lightning.training.forms:learn"
"""Learner by gradient descent."""


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

    ``model``, ``pretraining``, ``adaptation``, ``learner`` and ``suits`` are ``'package.module:NAME'``, imported on demand.

    Attributes:
        name: name in tables and results.
        kind: kind of the pretrained models, as in ``config.json``. A method that adapts another method's models has their kind.
        adaptation: the LightningModule of ``invert``, an :class:`~ftl_lightning.training.adaptation.Adaptation`.
        model: the network, a :class:`~ftl_lightning.training.concept_model.ConceptModel`; empty for another method's network.
        pretraining: the LightningModule of ``fit``, a :class:`~ftl_lightning.training.pretraining.Pretraining`; empty for another
            method's network.
        learner: learner without a trainer, a :class:`~ftl_lightning.training.learner.Learner`; by default gradient descent on
            the model's losses.
        forms: forms of its concepts, in the order in which their names are joined.
        configurations: folder of configuration files, one for each domain; empty for none.
        suits: a function of a domain that raises a ``UserError`` for an unsupported domain; empty if all are supported.
    """

    name: str
    kind: str
    adaptation: str = "ftl_lightning.training.inversion_module:InversionModule"
    model: str = ""
    pretraining: str = ""
    learner: str = INVERSION
    forms: Sequence[Form] = ()
    configurations: str = ""
    suits: str = ""

    def check_settings(self, names: Iterable[str]) -> None:
        """Refuse inversion settings for a method without gradient descent.

        Raises:
            UserError: with the first setting.
        """
        if self.learner != INVERSION and (name := next(iter(names), None)) is not None:
            reason = f"as {self.name} learns without gradient descent, found {name}"
            raise UserError(f"learn: expected no settings of an inversion, {reason}")

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
        """The learner without a trainer."""
        return self._named(self.learner)

    def check_domain(self, domain: "Domain") -> None:
        """Refuse an unsupported domain.

        Raises:
            UserError: with what the domain lacks.
        """
        if self.suits:
            with about(f"method {self.name}"):
                self._named(self.suits)(domain)

    def form(self, hparams: Mapping[str, Any]) -> str:
        """Form of concepts for these options; empty for the paper's form."""
        return " ".join(form.name for form in self.forms if hparams[form.option] != form.usual)

    def _named(self, reference: str) -> Any:
        module, _, name = reference.partition(":")
        try:
            return getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(
                f"method {self.name}: expected {reference!r}, found no such thing ({error}); mend its package"
            ) from error
