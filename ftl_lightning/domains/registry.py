"""Registry of domains: by entry-point name from installed packages, or by module."""

import copyreg
import functools
import importlib
import sys
from collections.abc import Callable

from ftl_lightning.domains.domain import Domain
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.shipped import TOPICS
from ftl_lightning.services.trust import OPTION, entry_points, is_vouched

GROUP = "ftl_lightning.domains"
"""Entry-point group of domains: ``name = package.module:DOMAIN``."""


def domain_names() -> tuple[str, ...]:
    """Names of domains in installed packages, in alphabetical order."""
    return tuple(sorted(_offered()))


def _offered() -> dict[str, str]:
    """References ``module:ATTRIBUTE`` of domains in installed packages, by name."""
    return {point.name: point.value for point in reversed(entry_points(GROUP))}


@functools.cache
def load_domain(name: str) -> Domain:
    """Import a domain by entry-point name, topic or ``package.module:DOMAIN``; for names in files see :func:`domain_of_file`.

    Raises:
        UserError: if there is no such domain, or the object is not a domain.
    """
    name = TOPICS.get(name, name)
    reference = _offered().get(name, name)
    module, colon, attribute = reference.partition(":")
    if not colon:
        raise _unknown(name)
    try:
        domain: Domain = getattr(importlib.import_module(module), attribute)
    except UserError:
        raise
    except Exception as error:  # any error of the imported module
        known = isinstance(error, ModuleNotFoundError | AttributeError | ValueError)
        message = str(error) if known else f"{type(error).__name__}: {error}"
        mend = "install its package or mend the name" if known else "mend its module"
        raise UserError(f"domain {name!r}: cannot be imported ({message}); {mend}") from error
    require(isinstance(domain, Domain), f"domain {name!r}", "a Domain", type(domain).__name__)
    require(":" in name or domain.name == name, f"domain {name!r}", "a Domain of this name", f"{domain.name!r}; mend its package")
    return domain


def _unknown(name: str) -> UserError:
    expected = f"one of {', '.join(domain_names())}, or package.module:DOMAIN"
    return UserError(f"domain: expected {expected}, found {short(name)!r}")


def is_known(name: str) -> bool:
    """Whether a domain (name or ``module:ATTRIBUTE``) is in an installed package or trusted by the user."""
    offered = _offered()
    return name in offered or name in offered.values() or is_vouched(name)


def domain_of_file(name: str) -> Domain:
    """Load a domain named in a file; one that is neither in an installed package nor trusted raises a ``UserError``, unimported."""
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
    """Name of a domain in files, by which models find it: its entry-point name if registered, else the given name.

    Raises:
        UserError: see :func:`load_domain`.
    """
    domain = load_domain(name)
    offered = (known for known in domain_names() if known == name or (known == domain.name and load_domain(known) is domain))
    return next(offered, name)


def _by_reference(domain: Domain) -> tuple[Callable[[str], Domain], tuple[str]]:
    """Pickle a domain, which holds functions, by the name under which another process imports it."""
    if domain.name in _offered() and load_domain(domain.name) is domain:
        return load_domain, (domain.name,)
    for module in list(sys.modules.values()):
        for name, value in list(getattr(module, "__dict__", {}).items()):
            if value is domain:
                return load_domain, (f"{module.__name__}:{name}",)
    raise UserError(f"pickle: expected a domain of a module, such as my_domain:DOMAIN, found {short(domain.name)!r} of none")


copyreg.pickle(Domain, _by_reference)
