"""Each method's colour, the same in all figures.

The colours are Okabe and Ito's (2008) and Tol's (2021), which colour-blind people tell apart.
"""

from collections.abc import Iterable, Mapping

from ftl_lightning.domains.paper import CHOSEN, FINE_TUNED, OURS, PAPERS_METHOD, WITH_ADAPTER, WITH_KNOTS, WITH_MODES, Compared

_MODES_OVER_TIME = f"{WITH_MODES} {WITH_KNOTS}"
OF_METHODS: Mapping[Compared, str] = {
    PAPERS_METHOD: "#0072b2",
    Compared(OURS, CHOSEN): "#56b4e9",
    Compared(OURS, f"{WITH_KNOTS} {CHOSEN}"): "#56b4e9",
    Compared(OURS, WITH_MODES): "#44aa99",
    Compared(OURS, WITH_KNOTS): "#999933",
    Compared(OURS, _MODES_OVER_TIME): "#332288",
    Compared(OURS, WITH_ADAPTER): "#aa4499",
    Compared(OURS, f"{_MODES_OVER_TIME} {WITH_ADAPTER}"): "#661100",
    Compared("BC"): "#e69f00",
    Compared("CVAE"): "#d55e00",
    Compared("in-context"): "#009e73",
    Compared("language"): "#cc79a7",
    Compared(FINE_TUNED): "#882255",
}
SPARE = ("#117733", "#ddcc77", "#88ccee", "#555555")
"""Of methods of one's own, before those of methods that a figure does not show."""
COLOURS = (*dict.fromkeys(OF_METHODS.values()), *SPARE)
"""In this order where lines are no methods."""
PAPER = "#9a9a9a"


def colours(named: Iterable[tuple[str, Compared]]) -> dict[str, str]:
    """A colour for each name: its method's own; of several names of one method the others have one of its other forms'.

    Args:
        named: what a figure shows, with the method that it is of; a method of one's own has a spare colour.
    """
    found: dict[str, str] = {}
    waiting: dict[str, Compared] = {}
    for name, method in named:
        own = OF_METHODS.get(method)
        if own is None or own in found.values():
            waiting[name] = method
        else:
            found[name] = own
    for name, method in waiting.items():
        forms = [colour for known, colour in OF_METHODS.items() if known.name == method.name]
        left = [colour for colour in (*forms, *SPARE, *reversed(COLOURS)) if colour not in found.values()]
        found[name] = left[0] if left else COLOURS[len(found) % len(COLOURS)]
    return found
