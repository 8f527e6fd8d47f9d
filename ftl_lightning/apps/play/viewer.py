"""Content of ``view``: films of demonstrations by concept with the findings of a check, or of the samples of a concept."""

import tempfile
from pathlib import Path
from typing import Any

from ftl_lightning.apps.play.films import Json, plan_film
from ftl_lightning.apps.play.mixing import sampling_of, starts_of
from ftl_lightning.data.check import check
from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.mended_file import read_mended
from ftl_lightning.domains.domain import Domain, Plans, Show, line_drawings
from ftl_lightning.domains.from_file import OWN, read_own
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.igm.concept import KIND, Concept
from ftl_lightning.services.errors import UserError, about
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.tensor_file import kind_of, visible

MOST_SHOWN, MOST_CONCEPTS = 60, 100
"""Maximum number of films per concept, and of concepts; the first are shown."""
SAMPLES = 16
"""Number of samples of a learned concept."""
HEADER = 16 * 2**20
"""Maximum bytes read to determine the kind of a file."""


def holds_results(file: str) -> bool:
    """Whether a file or folder contains results."""
    path = Path(file)
    return path.suffix == ".csv" or (path.is_dir() and bool(visible(path, "**/*.csv")))


def results_page(file: str) -> str:
    """The page of ``report --html`` of some results.

    Raises:
        UserError: if there are no results.
    """
    from ftl_lightning.reporting.html.page import write_page

    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        write_page(Path(file), page)
        return page.read_text(encoding="utf-8")


def viewed(file: str, model: str = "") -> dict[str, Any]:
    """State of the page for a file.

    Args:
        file: demonstrations, samples or a learned concept; the name or folder of a data set.
        model: model of a learned concept; empty to search for it.

    Raises:
        UserError: naming the file, if it is none of these.
    """
    path = Path(file)
    if path.suffix == ".safetensors":
        check_readable(path, "demonstrations or concept")
        with path.open("rb") as opened:
            if kind_of(opened.read(HEADER)) == KIND:
                return _state(path.name, *_of_concept(file, model))
    return _state(path.name, *_of_demonstrations(file))


def _state(title: str, notes: list[str], groups: list[Json]) -> dict[str, Any]:
    shown = {"title": title, "told": notes, "groups": groups}
    return {"title": title, "model": {"name": "", "title": "", "hash": ""}, "models": [], "viewer": shown, "offline": None}


def _of_demonstrations(file: str) -> tuple[list[str], list[Json]]:
    data, broken = read_mended(file) if Path(file).is_file() else (read_own(file), ())
    domain = _domain_of(data)
    with about(file):
        data = data.fitted(domain.observed) if domain is not None else data
    show = line_drawings(Plans(data.states.shape[1], data.state_names, data.state_units)) if domain is None else domain.show
    names = list(dict.fromkeys(data.concepts))
    notes = [str(data)]
    if len(names) > MOST_CONCEPTS:
        notes.append(f"the first {MOST_CONCEPTS} of {len(names)} concepts are shown")
    groups = []
    for name in names[:MOST_CONCEPTS]:
        rows = [row for row, text in enumerate(data.concepts) if text == name]
        subset = data.rows(rows)
        findings = [*(item.within(rows) for item in broken if set(item.rows) <= set(rows)), *check(subset)]
        notes += [f"{name}: {item.text}" for item in findings if not item.rows and item.severity != "note"]
        notes += [f"{name}: the first {MOST_SHOWN} of {len(rows)} are shown"] if len(rows) > MOST_SHOWN else []
        flags = [[item.text for item in findings if row in item.rows and item.severity != "note"] for row in range(len(rows))]
        groups.append({"concept": name, "films": _films(show, subset, domain is not None and bool(domain.observed), flags)})
    return notes, groups


def _domain_of(demonstrations: Demonstrations) -> Domain | None:
    """Domain named by a file, if an installed package offers it and the states fit."""
    if demonstrations.domain in ("", OWN) or demonstrations.domain not in domain_names():
        return None
    domain = load_domain(demonstrations.domain)
    return domain if len(domain.plans.columns) == demonstrations.states.shape[2] else None


def _films(show: Show, demonstrations: Demonstrations, observed: bool, flags: list[list[str]]) -> list[Json]:
    lengths, starts = demonstrations.lengths.tolist(), demonstrations.initial_states
    return [
        {
            "film": plan_film(show, demonstrations.states[row, : lengths[row]], starts.take([row]) if observed else None),
            "label": str(row + 1),
            "flags": flags[row],
        }
        for row in range(min(len(demonstrations), MOST_SHOWN))
    ]


def _of_concept(file: str, model: str) -> tuple[list[str], list[Json]]:
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.services.shipped import MODELS
    from ftl_lightning.training.pretrained import find_model

    concept = Concept.load(file)
    places = (Path("pretrained"), Path("logs"), MODELS)
    few = FewShot.from_pretrained(model or find_model(concept.origin.pretrained, places))
    learned = few.load(file)
    name = concept.origin.name
    task, starts = starts_of(few, (name,), SAMPLES, 0)
    plans = few.sample(learned, SAMPLES, starts, seed=0, **sampling_of(few))
    notes = [str(concept), *str(learned.explain()).splitlines(), *([f"samples start from scenes of {task!r}"] if task else [])]
    if not plans.states.isfinite().all():
        raise UserError(f"{file}: expected a concept whose samples are finite, found another")
    return notes, [{"concept": name, "films": _films(few.domain.show, plans, bool(few.domain.observed), [[]] * SAMPLES)}]
