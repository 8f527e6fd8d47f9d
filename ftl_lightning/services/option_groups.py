"""Grouped options and their flat names in results, checkpoints, models' records and the Python API."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from ftl_lightning.services.errors import UserError, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    S = TypeVar("S", bound=DataclassInstance)
else:
    S = TypeVar("S")


def groups_of(places: Mapping[str, str]) -> list[str]:
    """Unique names of the groups.

    Args:
        places: grouped options ``'group.option'`` by flat name.
    """
    return list(dict.fromkeys(place.partition(".")[0] for place in places.values()))


def flat(groups: Mapping[str, object], places: Mapping[str, str]) -> dict[str, Any]:
    """Flatten groups to options by flat name.

    Args:
        groups: groups by name.
        places: grouped options ``'group.option'`` by flat name.

    Raises:
        UserError: for an object that is not a group.
    """
    options = {}
    for name, place in places.items():
        group, _, option = place.partition(".")
        if not hasattr(groups[group], option):
            raise UserError(f"model.{group}: expected a group of options with {option!r}, found {shown(groups[group])}")
        options[name] = getattr(groups[group], option)
    return options


def replaced(settings: S, options: Mapping[str, Any], places: Mapping[str, str]) -> S:
    """Copy of settings with other options.

    Args:
        settings: dataclass of options or groups of options.
        options: new options by flat name.
        places: grouped options ``'group.option'`` by flat name.
    """
    changes = {name: value for name, value in options.items() if name not in places}
    in_groups: dict[str, dict[str, Any]] = {}
    for name in options.keys() & places.keys():
        group, _, option = places[name].partition(".")
        in_groups.setdefault(group, {})[option] = options[name]
    changed = {group: replace(getattr(settings, group), **values) for group, values in in_groups.items()}
    return replace(settings, **changes, **changed)
