"""Columns of states: precision, names and units."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ftl_lightning.data.demonstrations import Demonstrations, in_sequence
from ftl_lightning.data.features import moves
from ftl_lightning.data.kinds import TURNS
from ftl_lightning.services.errors import UserError, note, require, short

LOST = 1e-2
"""The same for float32 files, whose steps are lost beyond; for columns that move smoothly."""
LARGE = 2.0**14
"""Minimum number that float32 holds in steps that are no rounding of a constant."""
LEAST_STEP = 4 * 2.0**-24
"""Minimum median step of a column, as a share of its range, that float32 can hold after scaling."""
UNITS = {
    **{"m": ("length", 1.0), "cm": ("length", 0.01), "mm": ("length", 0.001), "km": ("length", 1000.0)},
    **{"ft": ("length", 0.3048), "in": ("length", 0.0254)},
    **{"s": ("time", 1.0), "ms": ("time", 0.001), "min": ("time", 60.0)},
    **{unit: ("angle", 2 * math.pi / turn) for unit, turn in TURNS.items()},
}
"""Quantity and factor of units that are converted."""


def check_precision(demonstrations: Demonstrations) -> None:
    """Refuse columns whose steps float32 cannot hold, after reading or after scaling.

    Raises:
        UserError: naming the column.
    """
    paths = in_sequence(demonstrations)
    every, within = paths.states.double(), paths.within
    low, high = every.amin(dim=0), every.amax(dim=0)
    valid = torch.arange(demonstrations.states.shape[1]) < demonstrations.lengths[:, None]
    smooth = moves(demonstrations.states.double().numpy(), valid[..., None].numpy())
    for column, name in enumerate(demonstrations.state_names):
        size, width = max(abs(float(low[column])), abs(float(high[column]))), float(high[column] - low[column])
        steps = every[:, column].diff().abs()[within]
        moving, place = steps[steps > 0], f"key 'states': column {short(name, 40)!r}"
        if not len(moving) or not width:
            continue
        if demonstrations.states.dtype == torch.float32:
            spacing = float(np.spacing(np.float32(size)))
            far = size >= LARGE or (spacing < width / 4 and smooth[column])
            if spacing > LOST * width and far:
                found = f"steps of {spacing:.2g} near {size:.3g}; subtract an offset, or store float64"
                raise UserError(f"{place}: expected numbers that float32 can hold, found {found}")
        elif float(moving.median()) < LEAST_STEP * width and smooth[column]:
            found = (
                f"a median step of {float(moving.median()):.2g} in a range of {width:.3g}; leave the column out, or cut the range"
            )
            raise UserError(f"{place}: expected steps that float32 can hold, found {found}")


def aligned(demonstrations: Demonstrations, names: Sequence[str], units: Sequence[str]) -> Demonstrations:
    """Put columns in the order of ``names``, and convert them to ``units``; a note says what was changed.

    Columns that are only numbered have no names, and an empty unit is unknown.

    Raises:
        UserError: for a missing or foreign name, or a unit that cannot be converted.
    """
    given, expected = demonstrations.state_names, tuple(names)
    if given != expected and not _numbered(given) and not _numbered(expected):
        missing = [name for name in expected if name not in given]
        foreign = [name for name in given if name not in expected]
        wanted = f"{short(', '.join(expected), 80)}, the model's"
        found = f"{short(', '.join(given), 80)}; rename or reorder the columns"
        require(not missing and not foreign and len(set(given)) == len(given), "key 'state_names'", wanted, found)
        order = [given.index(name) for name in expected]
        note(f"columns {short(', '.join(given), 80)} are put in the model's order {short(', '.join(expected), 80)}")
        demonstrations = demonstrations.columns(order)
    factors = [_factor(name, *pair) for name, *pair in zip(expected, demonstrations.state_units, units, strict=True)]
    if any(factor != 1 for factor in factors):
        changed = ", ".join(
            f"{name} from {unit} to {wanted}"
            for name, unit, wanted, factor in zip(expected, demonstrations.state_units, units, factors, strict=True)
            if factor != 1
        )
        note(f"columns are converted to the model's units: {short(changed, 120)}")
        states = demonstrations.states.double() * torch.tensor(factors, dtype=torch.double)
        demonstrations = replace(demonstrations, states=states.to(demonstrations.states.dtype))
    return replace(demonstrations, state_names=expected, state_units=tuple(units))


def _numbered(names: Sequence[str]) -> bool:
    return tuple(names) == tuple(map(str, range(len(names))))


def _factor(name: str, unit: str, wanted: str) -> float:
    """Factor from a unit to the wanted unit."""
    if unit == wanted or not unit or not wanted:
        return 1.0
    (quantity, factor), (other, divisor) = (UNITS.get(text.strip().lower(), ("", 1.0)) for text in (unit, wanted))
    known = quantity == other and quantity
    found = f"{short(unit, 30)!r}; convert the column"
    require(known, f"key 'state_units': column {short(name, 40)!r}", f"{wanted!r}, the model's unit", found)
    return factor / divisor
