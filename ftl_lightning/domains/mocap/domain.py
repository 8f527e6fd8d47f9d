"""The domain object: what the rest of the package knows of human motion."""

from pathlib import Path

from ftl_lightning.domains.domain import Concepts, Domain, Plans, Show, deferred
from ftl_lightning.domains.mocap.skeleton import COLUMNS, GROUPS, HORIZON
from ftl_lightning.domains.mocap.source import NAME, OBSERVED, Recorded
from ftl_lightning.domains.mocap.tasks import SUITES, TRAINING_CONCEPTS, reads

_DRAWING = "ftl_lightning.domains.mocap.rendering"

DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, COLUMNS, ("m",) * len(COLUMNS), resolution=1e-3, at_rest=False, groups=GROUPS),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        reads=reads,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=Recorded,
    observed=OBSERVED,
    # metrics: of the judge.
    show=Show(*(deferred(f"{_DRAWING}:{name}") for name in ("picture", "film", "wireframe"))),
    prepare=deferred("ftl_lightning.domains.mocap.prepare:prepare"),
    fresh=False,  # there is no more behaviour than what was recorded
)
