"""Colours of methods, the same in all figures.

The colours are Okabe and Ito's (2008) and Tol's (2021), which are safe for colour-blind readers.
"""

from collections.abc import Iterable, Mapping

from ftl_lightning.domains.comparison import CHOSEN, FINE_TUNED, OURS, PAPERS_METHOD, WITH_ADAPTER, WITH_KNOTS, WITH_MODES, Compared

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
"""Colours of user methods, used before colours of methods that a figure lacks."""
COLOURS = (*dict.fromkeys(OF_METHODS.values()), *SPARE)
"""Colours in order, for lines that are not methods."""
PAPER = "#9a9a9a"


def colours(named: Iterable[tuple[str, Compared]]) -> dict[str, str]:
    """Assign a colour to each name: its method's colour, else the colour of another form, else a spare colour.

    Args:
        named: names in a figure with their methods; user methods have spare colours.
    """
    chosen: dict[str, str] = {}
    waiting: dict[str, Compared] = {}
    for name, method in named:
        colour = OF_METHODS.get(method)
        if colour is None or colour in chosen.values():
            waiting[name] = method
        else:
            chosen[name] = colour
    for name, method in waiting.items():
        forms = [colour for known, colour in OF_METHODS.items() if known.name == method.name]
        left = [colour for colour in (*forms, *SPARE, *reversed(COLOURS)) if colour not in chosen.values()]
        chosen[name] = left[0] if left else COLOURS[len(chosen) % len(COLOURS)]
    return chosen
