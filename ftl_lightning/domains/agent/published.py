"""The paper's numbers for navigation."""

from ftl_lightning.domains.comparison import Published

NEW = "new initial state"


def _concept_count() -> list[Published]:
    """Table 'Ablation on the number of learned concepts' (learned weights)."""
    rows = (("training composition", (0.52, 0.08), (0.68, 0.13)), (NEW, (0.54, 0.07), (0.67, 0.05)))
    return [
        Published(setting, value, error, components=components)
        for setting, *both in rows
        for components, (value, error) in enumerate(both, start=1)
    ]


def _omega() -> list[Published]:
    """Table 'Classifier-free guidance weight choice effect'; learned weights are in the table above."""
    rows = (("1.2", 0.64, 0.08), ("1.4", 0.66, 0.05), ("1.6", 0.73, 0.07), ("1.8", 0.63, 0.06))
    return [Published(NEW, value, error, omega=omega) for omega, value, error in rows]


def _learned_components() -> list[Published]:
    """Table 'Analysis of learned concepts': generation with each component alone."""
    rows = (
        ("red", 0.42, 0.48, "bowl", 0.66, 0.56),
        ("yellow", 0.72, 0.44, "bowl", 0.58, 0.74),
        ("red", 0.42, 0.76, "cube", 0.44, 0.96),
        ("yellow", 0.40, 0.32, "cube", 0.82, 0.78),
        ("purple", 0.48, 0.42, "cone", 0.56, 0.36),
    )
    return [
        Published(f"component {component}", value, task=f"{goal} (learned from: go to {colour} {shape})")
        for colour, a, b, shape, c, d in rows
        for goal, values in ((f"go to {colour} object", (a, b)), (f"go to {shape}", (c, d)))
        for component, value in enumerate(values, start=1)
    ]


def _baselines() -> list[Published]:
    """Baselines in the table of guidance weights."""
    rows = (("BC", 0.46, 0.05), ("CVAE", 0.60, 0.06), ("in-context", 0.57, 0.03), ("language", 0.63, 0.07))
    return [Published(NEW, value, error, method=method) for method, value, error in rows]


PUBLISHED = tuple(_concept_count() + _omega() + _learned_components() + _baselines())
