"""Declaration of a method, offered by a package in the entry-point group ``ftl_lightning.methods``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ftl_lightning.services.errors import about, require

if TYPE_CHECKING:  # a declaration needs no torch
    from ftl_lightning.domains.domain import Domain
    from ftl_lightning.training.adaptation import Adaptation
    from ftl_lightning.training.concept_model import ConceptModel
    from ftl_lightning.training.pretraining import Pretraining


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
        configurations: folder of configuration files, one for each domain; empty for none.
        suits: raises a ``UserError`` for an unsupported domain.
    """

    name: str
    kind: str
    model: "Callable[[], type[ConceptModel]] | None" = None
    pretraining: "Callable[[], type[Pretraining[Any]]] | None" = None
    adaptation: "Callable[[], type[Adaptation]] | None" = None
    forms: Sequence[Form] = ()
    configurations: str = ""
    suits: "Callable[[Domain], None]" = lambda domain: None

    def check_domain(self, domain: "Domain") -> None:
        """Refuse an unsupported domain.

        Raises:
            UserError: with what the domain lacks.
        """
        with about(f"method {self.name}"):
            self.suits(domain)

    def adaptation_class(self) -> "type[Adaptation]":
        """The LightningModule of ``invert``."""
        from ftl_lightning.training.adaptation import LearnerAdaptation
        from ftl_lightning.training.inversion_module import InversionModule

        if self.adaptation is not None:
            return self.adaptation()
        return InversionModule if self.model is None or self.model().invertible else LearnerAdaptation

    def form(self, hparams: Mapping[str, Any]) -> str:
        """Form of concepts for these options; empty for the paper's form."""
        return " ".join(form.name for form in self.forms if hparams[form.option] != form.usual)


def check_present(domain: "Domain") -> None:
    """Refuse domains without observations.

    Raises:
        UserError: with the domain.
    """
    reason = f"{domain.name}: there is no present to go on from"
    require(domain.observed, "domain", "one with observed features", reason)


def check_present_or_moment(domain: "Domain") -> None:
    """Refuse domains without observations, unless plans are single states.

    Raises:
        UserError: with the domain.
    """
    if domain.plans.horizon > 1:
        check_present(domain)
