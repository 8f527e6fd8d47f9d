"""Domains by name: those that installed packages offer, and any that can be imported."""

import functools
import importlib
from importlib.metadata import entry_points

from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError

GROUP = "ftl_lightning.domains"
"""Entry-point group in which a package offers domains: ``name = package.module:DOMAIN``."""


def domain_names() -> tuple[str, ...]:
    """Names of the domains that installed packages offer, in alphabetical order."""
    return tuple(sorted({point.name for point in entry_points(group=GROUP)}))


@functools.cache
def load_domain(name: str) -> Domain:
    """A domain by the name under which a package offers it, or as ``package.module:DOMAIN``.

    Raises:
        UserError: if there is none of that name, or it is something else.
    """
    reference = next((point.value for point in entry_points(group=GROUP) if point.name == name), name)
    module, colon, attribute = reference.partition(":")
    if not colon:
        raise UserError(f"domain: expected one of {', '.join(domain_names())}, or package.module:DOMAIN, found {name!r}")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except UserError:
        raise
    except Exception as error:  # whatever a module raises that is imported
        known = isinstance(error, ModuleNotFoundError | AttributeError | ValueError)
        told = str(error) if known else f"{type(error).__name__}: {error}"
        mend = "install its package or mend the name" if known else "mend its module"
        raise UserError(f"domain {name!r}: cannot be imported ({told}); {mend}") from error
    if not isinstance(found, Domain):
        raise UserError(f"domain {name!r}: expected a Domain, found {type(found).__name__}")
    return found


def recorded_name(name: str) -> str:
    """The name by which files know a domain: the one under which a package offers it or, where none does, the one given.

    So a model finds the domain again, and where a package offers the domain both ways of naming it mean the same.

    Args:
        name: as of :func:`load_domain`.

    Raises:
        UserError: as of :func:`load_domain`.
    """
    domain = load_domain(name)
    offered = (other for other in domain_names() if other == name or (other == domain.name and load_domain(other) is domain))
    return next(offered, name)
