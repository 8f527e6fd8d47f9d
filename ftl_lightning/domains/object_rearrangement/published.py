"""The paper's numbers for object rearrangement."""

from ftl_lightning.domains.comparison import Published


def _bars() -> list[Published]:
    """Figure 'accuracy' and the text of sections 4.1 and 4.2; K = 2, fixed omega 1.2."""
    return [
        Published("training composition", 0.90, 0.04, omega="1.2"),
        Published("new concept", 0.82, 0.09, omega="1.2"),
        Published("new + training", 0.80, 0.02, omega="1.2"),
        Published("new concept", 0.44, omega="1.2", task="circle, triangle and square in a circle of radius 1.67"),
    ]


def _concept_count() -> list[Published]:
    """Table 'Ablation on the number of learned concepts'."""
    rows = (
        ("training composition", (0.28, 0.11), (0.75, 0.11)),
        ("new concept", (0.49, 0.11), (0.77, 0.09)),
        ("new + training", (0.38, 0.04), (0.73, 0.04)),
    )
    return [
        Published(setting, value, error, components=count, omega="learned")
        for setting, *values in rows
        for count, (value, error) in enumerate(values, start=1)
    ]


def _omega() -> list[Published]:
    """Table 'Classifier-free guidance weight choice effect'; 1.2 and learned are in the tables above."""
    rows = (("1.4", 0.80, 0.10), ("1.6", 0.66, 0.08), ("1.8", 0.61, 0.06))
    return [Published("new concept", value, error, omega=omega) for omega, value, error in rows]


def _learned_components() -> list[Published]:
    """Table 'Analysis of learned concepts': generation with each component alone."""
    rows = (
        ("triangle right of square", 0.42, 0.62, "circle above square", 0.88, 0.36),
        ("square right of triangle", 0.16, 0.64, "circle above triangle", 0.08, 0.08),
        ("circle right of square", 0.10, 0.48, "triangle above square", 0.86, 0.40),
        ("square right of circle", 0.14, 0.90, "triangle above circle", 0.02, 0.60),
        ("circle right of triangle", 0.00, 0.92, "triangle right of square", 0.64, 0.14),
    )
    return [
        Published(f"component {component}", value, task=f"{goal} (learned from: {first} and {second})")
        for first, a, b, second, c, d in rows
        for goal, values in ((first, (a, b)), (second, (c, d)))
        for component, value in enumerate(values, start=1)
    ]


def _baselines() -> list[Published]:
    """Baselines in the table of guidance weights; language from the text."""
    rows = (
        ("BC", "new concept", 0.67, 0.15),
        ("CVAE", "new concept", 0.08, 0.05),
        ("language", "training composition", 0.20, 0.07),
        ("language", "new concept", 0.20, 0.05),
        ("language", "new + training", 0.13, 0.04),
    )
    return [Published(setting, value, error, method=method) for method, setting, value, error in rows]


PUBLISHED = tuple(_bars() + _concept_count() + _omega() + _learned_components() + _baselines())
