"""Arrays of a user as demonstrations and initial states of a domain."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ftl_lightning.demonstrations.check import mended
from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.demonstrations.features import Feature, InitialStates
from ftl_lightning.demonstrations.finding import Finding
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.errors import UserError, short, shown

Start = InitialStates | Mapping[str, ArrayLike] | ArrayLike
"""Where behaviour starts: initial states, observed features by name, or the only feature's values ``(sample, *shape)``."""


def demonstrations_of(
    domain: Domain,
    states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
    observed: Mapping[str, ArrayLike] | ArrayLike | None,
    name: str,
) -> Demonstrations:
    """Demonstrations of one concept.

    Args:
        domain: whose behaviour they show.
        states: ``(demo, time, state)``, or one ``(time, state)`` for each demonstration, of any lengths.
        observed: features by name, or the only one, observed at every time ``(demo, time, *shape)`` or at the first time alone
            ``(demo, *shape)``; for demonstrations of different lengths, a list like the states'.
        name: of the concept.

    Raises:
        UserError: where they do not fit the domain.
    """
    if isinstance(states, Demonstrations):
        expect_of_domain("states", states, domain)
        return states.fitted(domain.observed).named(name)
    found, lengths = _padded("states", states)
    columns = len(domain.plans.columns)
    if found.dim() != 3 or found.shape[2] != columns:
        # Of behaviour without time every row is a demonstration.
        index, what = ("[:, None]", "demonstrations") if domain.plans.horizon == 1 else ("[None]", "a single demonstration")
        told = f"; give {what} as states{index}" if tuple(found.shape[1:]) == (columns,) else ""
        raise UserError(f"states: expected shape (demo, time, {columns}), found {tuple(found.shape)}{told}")
    features, per_step = {}, []
    for key, values in _by_name(observed, domain.observed).items():
        feature = domain.observed[key]
        own = _padded(f"observed {key!r}", values)[0]
        if own.dim() == len(feature.shape) + 2:
            per_step.append(key)
        features[key] = own.float() if feature.kind == "vector" else own
    return Demonstrations(
        states=found.float(),
        lengths=lengths,
        domain=domain.name,
        state_names=domain.plans.columns,
        state_units=domain.plans.units,
        concepts=(name,) * len(found),
        observed=features,
        per_step=tuple(per_step),
    ).fitted(domain.observed)


def of_one_concept(own: Demonstrations) -> Demonstrations:
    """The same, if they are of one concept.

    Raises:
        UserError: naming the concepts, if they are of several.
    """
    if len(found := set(own.concepts)) > 1:
        told = short(", ".join(sorted(found)), 150)
        raise UserError(f"states: expected demonstrations of one concept, found those of {told}; choose with select(name)")
    return own


def mended_states(
    states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
) -> tuple[ArrayLike | Sequence[ArrayLike] | Demonstrations, tuple[Finding, ...]]:
    """States with numbers in place of those that are not finite, and where they were, see :func:`mended`."""
    if isinstance(states, Demonstrations):
        return states, ()
    found, lengths = _padded("states", states)
    if found.dim() != 3:
        return states, ()
    whole, findings = mended(found.float(), lengths)
    return [own[:length].numpy() for own, length in zip(whole, lengths.tolist(), strict=True)], findings


def expect_of_domain(key: str, plans: object, domain: Domain) -> None:
    """Refuse what is no behaviour of a domain.

    Raises:
        UserError: with the names of both domains.
    """
    if not isinstance(plans, Demonstrations):
        raise UserError(f"{key}: expected plans, such as model.sample returns, found {shown(plans)}")
    # A user's own data may go by any name.
    if domain.name != OWN and plans.domain not in ("", domain.name):
        raise UserError(f"{key}: expected behaviour of {domain.name}, the model's domain, found that of {short(plans.domain)}")
    if (found := plans.states.shape[2]) != (expected := len(domain.plans.columns)):
        raise UserError(f"{key}: expected states of {expected} columns ({domain.name}), found {found}")


def starts_of(domain: Domain, given: Start | None) -> InitialStates | None:
    """Where plans start; ``None`` where nothing is given and nothing is observed.

    Raises:
        UserError: if what is observed is not given, for features that the domain does not have, values that are not finite, or
            different numbers of them.
    """
    if given is None and domain.observed:
        told = ", ".join(f"{name} {feature.shape}" for name, feature in domain.observed.items())
        raise UserError(f"observed: expected where plans start ({told}), found nothing; model.starts(goal) draws some")
    if given is None:
        return None
    found = given if isinstance(given, InitialStates) else _starts(domain, given)
    scenes = {} if found.scenes is None else {"scenes": found.scenes}
    for name, values in {**found.observed, **scenes}.items():
        if not values.dim():
            raise UserError(f"observed: expected (sample, ...) of {name!r}, found a single number")
        if values.is_floating_point() and not values.isfinite().all():
            raise UserError(f"observed: expected finite numbers, found others in {name!r}")
    counts = {name: len(values) for name, values in {**found.observed, **scenes}.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{count} of {name!r}" for name, count in counts.items())
        raise UserError(f"observed: expected as many samples of every feature, found {told}")
    return found


def _starts(domain: Domain, given: Any) -> InitialStates:
    features = domain.observed
    found = {name: tensor_of(f"observed {name!r}", values) for name, values in _by_name(given, features).items()}
    return InitialStates({name: own.float() if features[name].kind == "vector" else own for name, own in found.items()})


def scenes_of(given: ArrayLike) -> Tensor:
    """Scenes that episodes start from ``(episode, scene)``.

    Raises:
        UserError: for anything else.
    """
    found = tensor_of("scenes", given)
    if found.dim() != 2 or not len(found) or not found.isfinite().all():
        raise UserError(
            "scenes: expected where episodes start, what model.starts(goal, count) draws or finite numbers (episode, scene), "
            f"found {shown(given)}"
        )
    return found


def tensor_of(key: str, values: Any) -> Tensor:
    """Numbers as a tensor on the processor: bytes as they are, everything else as float32.

    Raises:
        UserError: naming the argument, for anything that holds no numbers, or rows of different lengths.
    """
    found = values
    if not isinstance(values, Tensor):
        try:
            array = np.asarray(values, order="C")
            found = torch.as_tensor(array) if array.dtype.kind in "fiub" else None
        except (TypeError, ValueError, RuntimeError):
            found = None
    if found is None or found.is_complex():
        raise UserError(f"{key}: expected an array of numbers, found {shown(values)}")
    found = found.detach().cpu()
    return found if found.dtype == torch.uint8 else found.float()


def _padded(key: str, values: Any) -> tuple[Tensor, Tensor]:
    """Arrays of maybe different lengths as one, each padded with its last time, and the lengths.

    Raises:
        UserError: for anything else.
    """
    several = isinstance(values, np.ndarray) and values.dtype == object and values.ndim > 0
    if several or not hasattr(values, "__array__"):  # a tensor has it too
        if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
            raise UserError(f"{key}: expected an array or a list of arrays, found {shown(values)}")
        each = [tensor_of(key, one) for one in values]
        if not each:
            raise UserError(f"{key}: expected at least one demonstration, found an empty list")
        if len({one.shape[1:] for one in each}) > 1 or len({one.dim() for one in each}) > 1:
            told = " and ".join(sorted({str(tuple(one.shape)) for one in each})[:2])
            raise UserError(f"{key}: expected arrays of one shape but for their times, found {told}")
        if each[0].dim() and len({len(one) for one in each}) > 1:
            if not min(len(one) for one in each):
                raise UserError(f"{key}: expected at least one time of each demonstration, found none")
            return padded(each)
        found = torch.stack(each)
    else:
        found = tensor_of(key, values)
    if not found.dim():
        raise UserError(f"{key}: expected an array or a list of arrays, found {shown(values)}")
    return found, torch.full((len(found),), found.shape[1] if found.dim() > 1 else 1)


def _by_name(observed: Any, features: Mapping[str, Feature]) -> dict[str, Any]:
    """Observed features by name; a single value is the only one's.

    Raises:
        UserError: for a name that is none, or a value without one where there are several.
    """
    if observed is None:
        return {}
    if isinstance(observed, Mapping):
        if unknown := set(observed) - set(features):
            told = short(", ".join(sorted(map(str, unknown))))
            raise UserError(f"observed: expected {', '.join(features) or 'nothing'}, found {told}")
        return dict(observed)
    if len(features) != 1:
        raise UserError(f"observed: expected features by name ({', '.join(features) or 'none'}), found values without one")
    return {next(iter(features)): observed}
