"""Options in groups, and the flat names under which results, checkpoints, models' records and the Python API know them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from ftl_lightning.errors import UserError, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    S = TypeVar("S", bound=DataclassInstance)
else:
    S = TypeVar("S")


def groups_of(places: Mapping[str, str]) -> list[str]:
    """Names of the groups, each once.

    Args:
        places: of each flat name where its option is, ``'group.option'``.
    """
    return list(dict.fromkeys(place.partition(".")[0] for place in places.values()))


def flat(groups: Mapping[str, object], places: Mapping[str, str]) -> dict[str, Any]:
    """The options of some groups by their flat names.

    Args:
        groups: by name.
        places: of each flat name where its option is, ``'group.option'``.

    Raises:
        UserError: for what is no group.
    """
    options = {}
    for name, place in places.items():
        group, _, option = place.partition(".")
        if not hasattr(groups[group], option):
            raise UserError(f"model.{group}: expected a group of options with {option!r}, found {shown(groups[group])}")
        options[name] = getattr(groups[group], option)
    return options


def replaced(settings: S, options: Mapping[str, Any], places: Mapping[str, str]) -> S:
    """Settings of which some options are others.

    Args:
        settings: whose fields are options or groups of such.
        options: by flat names.
        places: of each flat name of an option in a group where it is, ``'group.option'``.
    """
    changes = {name: value for name, value in options.items() if name not in places}
    in_groups: dict[str, dict[str, Any]] = {}
    for name in options.keys() & places.keys():
        group, _, option = places[name].partition(".")
        in_groups.setdefault(group, {})[option] = options[name]
    changed = {group: replace(getattr(settings, group), **values) for group, values in in_groups.items()}
    return replace(settings, **changes, **changed)
