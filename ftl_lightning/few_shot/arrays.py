"""Convert a user's arrays to demonstrations and initial states of a domain."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ftl_lightning.data.check import Finding, mended
from ftl_lightning.data.demonstrations import Demonstrations, padded
from ftl_lightning.data.features import Feature, InitialStates, check_single, check_whole, precise
from ftl_lightning.domains.domain import OWN, Domain
from ftl_lightning.services.errors import UserError, require, short, shown

Start = InitialStates | Mapping[str, ArrayLike] | ArrayLike
"""Initial states, observed features by name, or values ``(sample, *shape)`` of the only feature."""


def demonstrations_of(
    domain: Domain,
    states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
    observed: Mapping[str, ArrayLike] | ArrayLike | None,
    name: str,
) -> Demonstrations:
    """Convert arrays to demonstrations of a single concept; ``UserError`` for arrays that do not fit the domain.

    Args:
        states: ``(demo, time, state)``, or a list of ``(time, state)`` of any lengths.
        observed: features by name, or the only feature: ``(demo, time, *shape)`` if observed at every time, ``(demo, *shape)`` if
            only at the first; for different lengths, a list as for the states.
    """
    if isinstance(states, Demonstrations):
        return domain.fitted(states.named(name))
    whole, lengths = _padded("states", states)
    columns = len(domain.plans.columns)
    if whole.dim() != 3 or whole.shape[2] != columns:
        # Without time, every row is a demonstration.
        index, what = ("[:, None]", "demonstrations") if domain.plans.horizon == 1 else ("[None]", "a single demonstration")
        advice = f"; give {what} as states{index}" if tuple(whole.shape[1:]) == (columns,) else ""
        advice = "; exchange axes 1 and 2" if whole.dim() == 3 and whole.shape[1] == columns else advice
        raise UserError(f"states: expected shape (demo, time, {columns}), found {tuple(whole.shape)}{advice}")
    features, per_step = {}, []
    for key, values in _by_name(observed, domain.observed).items():
        feature = domain.observed[key]
        part = _padded(f"observed {key!r}", values)[0]
        if part.dim() == len(feature.shape) + 2:
            per_step.append(key)
        if feature.kind == "vector":
            check_single(f"observed/{key}", part.numpy())
        features[key] = part.float() if feature.kind == "vector" else part
    return domain.fitted(
        Demonstrations(
            states=torch.from_numpy(precise(whole.numpy())),
            lengths=lengths,
            domain=domain.name,
            state_names=_names(states) or domain.plans.columns,
            state_units=domain.plans.units,
            concepts=(name,) * len(whole),
            observed=features,
            per_step=tuple(per_step),
        )
    )


def of_one_concept(own: Demonstrations) -> Demonstrations:
    """Return demonstrations of a single concept unchanged; ``UserError`` naming the concepts, if there are several."""
    if len(concepts := set(own.concepts)) > 1:
        names = short(", ".join(sorted(concepts)), 150)
        raise UserError(f"states: expected demonstrations of one concept, found those of {names}; choose with select(name)")
    return own


def mended_states(
    states: ArrayLike | Sequence[ArrayLike] | Demonstrations,
) -> tuple[ArrayLike | Sequence[ArrayLike] | Demonstrations, tuple[Finding, ...]]:
    """Replace states that are not finite, with findings, see :func:`mended`."""
    if isinstance(states, Demonstrations):
        return states, ()
    given, lengths = _padded("states", states)
    if given.dim() != 3:
        return states, ()
    whole, findings = mended(torch.from_numpy(precise(given.numpy(), lengths.tolist())), lengths)
    return [path[:length].numpy() for path, length in zip(whole, lengths.tolist(), strict=True)], findings


def check_of_domain(key: str, plans: object, domain: Domain) -> None:
    """Refuse behaviour of another domain; ``UserError`` naming both domains."""
    if not isinstance(plans, Demonstrations):
        raise UserError(f"{key}: expected plans, such as model.sample returns, found {shown(plans)}")
    # Data of a user may have any domain name.
    if domain.name != OWN and plans.domain not in ("", domain.name):
        raise UserError(f"{key}: expected behaviour of {domain.name}, the model's domain, found that of {short(plans.domain)}")
    if (columns := plans.states.shape[2]) != (expected := len(domain.plans.columns)):
        raise UserError(f"{key}: expected states of {expected} columns ({domain.name}), found {columns}")


def starts_of(domain: Domain, given: Start | None) -> InitialStates | None:
    """Convert to initial states; ``None`` if nothing is given and the domain has no observed features.

    Raises:
        UserError: for missing observations, unknown features, values that are not finite, or different numbers of samples.
    """
    if given is None and domain.observed:
        message = ", ".join(f"{name} {feature.shape}" for name, feature in domain.observed.items())
        raise UserError(f"observed: expected where plans start ({message}), found nothing; model.starts(goal) draws some")
    if given is None:
        return None
    starts = given if isinstance(given, InitialStates) else _starts(domain, given)
    scenes = {} if starts.scenes is None else {"scenes": starts.scenes}
    for name, values in {**starts.observed, **scenes}.items():
        if not values.dim():
            raise UserError(f"observed: expected (sample, ...) of {name!r}, found a single number")
        if values.is_floating_point() and not values.isfinite().all():
            raise UserError(f"observed: expected finite numbers, found others in {name!r}")
    counts = {name: len(values) for name, values in {**starts.observed, **scenes}.items()}
    if len(set(counts.values())) > 1:
        message = ", ".join(f"{count} of {name!r}" for name, count in counts.items())
        raise UserError(f"observed: expected as many samples of every feature, found {message}")
    return starts


def _starts(domain: Domain, given: Any) -> InitialStates:
    features = domain.observed
    tensors = {name: tensor_of(f"observed {name!r}", values) for name, values in _by_name(given, features).items()}
    return InitialStates({name: tensor.float() if features[name].kind == "vector" else tensor for name, tensor in tensors.items()})


def scenes_of(given: ArrayLike) -> Tensor:
    """Convert scenes of initial states to ``(episode, scene)``; ``UserError`` for anything else."""
    scenes = tensor_of("scenes", given).float()
    if scenes.dim() != 2 or not len(scenes) or not scenes.isfinite().all():
        raise UserError(
            "scenes: expected where episodes start, what model.starts(goal, count) draws or finite numbers (episode, scene), "
            f"found {shown(given)}"
        )
    return scenes


def _names(states: Any) -> tuple[str, ...]:
    """Names of the columns of data frames; empty for other arrays."""
    frames = [states] if hasattr(states, "columns") else states if isinstance(states, list | tuple) else []
    names = {tuple(map(str, frame.columns)) for frame in frames if hasattr(frame, "columns")}
    require(len(names) < 2, "states", "data frames with the same columns", f"{len(names)} different lists")
    return next(iter(names), ())


def tensor_of(key: str, values: Any) -> Tensor:
    """Convert numbers to a tensor on the CPU: uint8 and float64 are kept, whole numbers become float64, all else float32.

    Raises:
        UserError: naming the argument, for anything but numbers, masked values, or rows of different lengths.
    """
    tensor = values
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        where = tuple(int(part[0]) for part in np.ma.getmaskarray(values).nonzero())
        raise UserError(f"{key}: expected every value, found a masked one at index {where}; fill it or leave its time out")
    if not isinstance(values, Tensor):
        try:
            array = np.asarray(values)
            kind = np.float64 if array.dtype == np.longdouble else array.dtype.newbyteorder("=")
            tensor = torch.from_numpy(np.array(array, dtype=kind, order="C")) if array.dtype.kind in "fiub" else None
        except (TypeError, ValueError, RuntimeError):
            tensor = None
    if tensor is None or tensor.is_complex():
        raise UserError(f"{key}: expected an array of numbers, found {shown(values)}")
    tensor = tensor.detach().cpu()
    if tensor.dtype in (torch.uint8, torch.float64):
        return tensor
    if not tensor.is_floating_point() and tensor.dtype != torch.bool:
        check_whole(key, tensor.numpy())
    return tensor.float() if tensor.is_floating_point() or tensor.dtype == torch.bool else tensor.double()


def _padded(key: str, values: Any) -> tuple[Tensor, Tensor]:
    """Stack arrays, padded with their last time, and return their lengths."""
    several = isinstance(values, np.ndarray) and values.dtype == object and values.ndim > 0
    if several or not hasattr(values, "__array__"):  # a tensor has it too
        if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
            raise UserError(f"{key}: expected an array or a list of arrays, found {shown(values)}")
        each = [tensor_of(key, part) for part in values]
        if not each:
            raise UserError(f"{key}: expected at least one demonstration, found an empty list")
        if len({part.shape[1:] for part in each}) > 1 or len({part.dim() for part in each}) > 1:
            shapes = " and ".join(sorted({str(tuple(part.shape)) for part in each})[:2])
            raise UserError(f"{key}: expected arrays of one shape but for their times, found {shapes}")
        if each[0].dim() and len({len(part) for part in each}) > 1:
            if not min(len(part) for part in each):
                raise UserError(f"{key}: expected at least one time of each demonstration, found none")
            return padded(each)
        whole = torch.stack(each)
    else:
        whole = tensor_of(key, values)
    if not whole.dim():
        raise UserError(f"{key}: expected an array or a list of arrays, found {shown(values)}")
    return whole, torch.full((len(whole),), whole.shape[1] if whole.dim() > 1 else 1)


def _by_name(observed: Any, features: Mapping[str, Feature]) -> dict[str, Any]:
    """Observed features by name; a single value is that of the only feature."""
    if observed is None:
        return {}
    if isinstance(observed, Mapping):
        if unknown := set(observed) - set(features):
            names = short(", ".join(sorted(map(str, unknown))))
            raise UserError(f"observed: expected {', '.join(features) or 'nothing'}, found {names}")
        return dict(observed)
    if len(features) != 1:
        raise UserError(f"observed: expected features by name ({', '.join(features) or 'none'}), found values without one")
    return {next(iter(features)): observed}


def pinned_states(pin: Mapping[int, ArrayLike], count: int, horizon: int, columns: Sequence[str]) -> Tensor:
    """Known states ``(count, horizon, state)`` by time, NaN elsewhere; ``UserError`` for a time or shape that does not fit.

    Args:
        pin: states ``(state,)`` or ``(count, state)`` by time, negative from the end.
        columns: names of the columns of a state.
    """
    known = torch.full((count, horizon, len(columns)), torch.nan)
    for time, state in pin.items():
        whole = isinstance(time, int | np.integer) and not isinstance(time, bool) and -horizon <= time < horizon
        require(whole, "pin", f"times from {-horizon} to {horizon - 1}", shown(time))
        values = torch.as_tensor(np.array(state, dtype=np.float32))
        fits = values.shape in ((len(columns),), (count, len(columns)))
        wanted = f"a state of {len(columns)} columns, or {count} of them"
        require(fits, f"pin, time {time}", wanted, f"an array of shape {tuple(values.shape)}")
        require(not values.isinf().any(), f"pin, time {time}", "finite numbers, NaN for a free column", "infinity")
        known[:, int(time)] = values
    return known
