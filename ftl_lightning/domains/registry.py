"""Domains by name: those that installed packages offer, and any that a person names by its module."""

import functools
import importlib

from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short
from ftl_lightning.trust import OPTION, entry_points, is_vouched

GROUP = "ftl_lightning.domains"
"""Entry-point group in which a package offers domains: ``name = package.module:DOMAIN``."""


def domain_names() -> tuple[str, ...]:
    """Names of the domains that installed packages offer, in alphabetical order."""
    return tuple(sorted(_offered()))


def _offered() -> dict[str, str]:
    """Where the domains are that installed packages offer, ``module:ATTRIBUTE`` by name."""
    return {point.name: point.value for point in reversed(entry_points(GROUP))}


@functools.cache
def load_domain(name: str) -> Domain:
    """A domain by the name under which a package offers it, or as ``package.module:DOMAIN``.

    The module is imported. For a name that stands in a file, :func:`domain_of_file` is to be asked.

    Raises:
        UserError: if there is none of that name, or it is something else.
    """
    reference = _offered().get(name, name)
    module, colon, attribute = reference.partition(":")
    if not colon:
        raise _unknown(name)
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


def _unknown(name: str) -> UserError:
    expected = f"one of {', '.join(domain_names())}, or package.module:DOMAIN"
    return UserError(f"domain: expected {expected}, found {short(name)!r}")


def is_known(name: str) -> bool:
    """Whether an installed package offers a domain, by its name or as ``module:ATTRIBUTE``, or a person vouches for it."""
    offered = _offered()
    return name in offered or name in offered.values() or is_vouched(name)


def domain_of_file(name: str) -> Domain:
    """The domain that a file asks for: one that an installed package offers, or that a person names beside the file.

    Raises:
        UserError: for another one; nothing is imported.
    """
    if is_known(name):
        return load_domain(name)
    module, colon, _ = name.partition(":")
    if not colon:
        raise _unknown(name)
    raise UserError(
        f"key 'domain': asks for code, {short(name)!r}, that no installed package offers: it was not imported; if you trust it, "
        f"give {OPTION} {short(module)} (in Python domain={short(name)!r})"
    )


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
