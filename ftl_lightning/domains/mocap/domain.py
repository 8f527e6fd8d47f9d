"""Domain object of human motion."""

from pathlib import Path

from torch import Tensor

from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.domains.comparison import OURS, WITH_KNOTS, WITH_MODES, Compared, Comparison
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Metric, Plans, Recordings, deferred
from ftl_lightning.domains.mocap.actions import TESTED, action, judged
from ftl_lightning.domains.mocap.judge import identity
from ftl_lightning.domains.mocap.skeleton import COLUMNS, GROUPS, HORIZON
from ftl_lightning.domains.mocap.source import NAME, OBSERVED, POSE, Recorded
from ftl_lightning.domains.mocap.tasks import NEW_CONCEPTS, SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.mocap.views import VIEWS
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.tasks import training_suite

_DRAWING, _MEASURES = "ftl_lightning.domains.mocap.rendering", "ftl_lightning.domains.mocap.measures"

_KINEMATIC = ("rule", "level", "strides", "rise", "feet in time", "amplitude of hands", "amplitude of feet", "degrees turned")
"""Metrics of :mod:`~ftl_lightning.domains.mocap.measures` without the judge, by name."""


def _frozen(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    """Plans without motion."""
    return check_starts(starts).observed[POSE][:, None].repeat(1, HORIZON, 1)


DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, COLUMNS, ("m",) * len(COLUMNS), resolution=1e-3, at_rest=False, groups=GROUPS),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES | {"training": training_suite(tuple(text for text in TRAINING_CONCEPTS if action(text) in TESTED))},
        descriptions=(*TRAINING_CONCEPTS, *NEW_CONCEPTS),
        reads=judged,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=Recorded,
    observed=OBSERVED,
    metrics={
        ACCURACY: Metric(deferred(f"{_MEASURES}:recognised"), identity=identity()),
        **{name: Metric(deferred(f"{_MEASURES}:{name.replace(' ', '_')}")) for name in _KINEMATIC},
        "bone error": Metric(deferred(f"{_MEASURES}:bone_error"), less_is_better=True),
        "jerk": Metric(deferred(f"{_MEASURES}:jerk"), less_is_better=True),
    },
    views=VIEWS,
    show=Show(
        deferred(f"{_DRAWING}:picture"),
        deferred(f"{_DRAWING}:film"),
        deferred(f"{_DRAWING}:wireframe"),
        exports={".bvh": deferred("ftl_lightning.domains.mocap.export:bvh")},
    ),
    comparison=Comparison(
        ours=Compared(OURS, f"{WITH_MODES} {WITH_KNOTS}"),
        headline="rule",
        references={"frozen frame": _frozen},
        fresh=False,  # recordings are finite
    ),
    recordings=Recordings(
        prepare=deferred("ftl_lightning.domains.mocap.prepare:prepare"),
        imports={".bvh": deferred("ftl_lightning.domains.mocap.bvh:demonstrated")},
    ),
)
