"""The page as a single HTML document, served or with precomputed answers (``play --static``), and the content of ``view``."""

import base64
import gzip
import itertools
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.mixing import Json, plan_film, sampling_of, starts_of
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.data.check import check, read_mended
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import OWN, Domain
from ftl_lightning.domains.from_file import read_own
from ftl_lightning.domains.pictures import Show, line_drawings
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.concept import KIND, Concept
from ftl_lightning.services.errors import about, require, short
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.shipped import FILM, MODELS
from ftl_lightning.services.tensor_file import bytes_hash, kind_of, visible, write_text
from ftl_lightning.services.text import filled
from ftl_lightning.training.model_folder import find_model

HERE = Path(__file__).parent
SCRIPTS = (
    FILM,
    *(HERE / f"{name}.js" for name in ("space", "films", "ask", "record", "example", "learn", "mix", "viewer", "page")),
)
"""Scripts of the page in order; ``page`` starts the program."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of every page: run its scripts, and load nothing."""
WEIGHTS = (0.0, 0.5, 1.0, 1.5)  # weights of each concept of a pair
PAIRS, OTHERS = 4, 3  # maximum number of pairs of concepts, and of training concepts mixed with a learned concept
COUNT = 8  # number of samples of each mixture
MOST_SHOWN, MOST_CONCEPTS = 60, 100  # maximum number of films per concept, and of concepts; the first are shown
SAMPLES = 16  # number of samples of a learned concept
HEADER = 16 * 2**20  # maximum bytes read to determine the kind of a file


def page(nonce: str, offline: bytes | None = None) -> str:
    """The page as HTML. The server sends a content security policy with the page for style and scripts with the ``nonce``. A page
    without a server contains its :data:`POLICY`, and gzip of JSON answers by :func:`request_key`: ``/api/state``, thumbnails,
    samples.
    """
    meta = f'<meta http-equiv="Content-Security-Policy" content="{POLICY.format(nonce=nonce)}">\n'
    parts = {
        "STYLE": (HERE / "page.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join(path.read_text(encoding="utf-8") for path in SCRIPTS),
        "NONCE": nonce,
        "EXAMPLE": (HERE / "example.json").read_text(encoding="utf-8") if offline is None else "",
        "CSP": "" if offline is None else meta,
        "OFFLINE": "" if offline is None else base64.b64encode(offline).decode(),
    }
    return filled((HERE / "page.html").read_text(encoding="utf-8"), parts)


def request_key(path: str, body: Any = None) -> str:
    """Key of a request to a precomputed answer, equal to the page's: path and query, then the JSON body of a POST, formatted as by
    JavaScript.
    """
    if body is None:
        return path
    return f"{path} {json.dumps(_whole(body), separators=(',', ':'), ensure_ascii=False)}"


def _whole(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _whole(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def pairs_of(concepts: Sequence[dict[str, Any]], named: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Pairs of concepts to mix, by identifier. By default, learned concepts are mixed with training concepts and each other, or
    training concepts alone.
    """
    if named:
        by_name = {concept["name"]: concept["id"] for concept in concepts}
        for name in itertools.chain(*named):
            require(name in by_name, "pairs", "concepts of the model", f"{short(name)!r}; the verb concepts lists them")
        return [(by_name[first], by_name[second]) for first, second in named]
    learned = [concept["id"] for concept in concepts if concept["kind"] != "training"]
    training = [concept["id"] for concept in concepts if concept["kind"] == "training"]
    if not learned:
        return list(itertools.combinations(training[: OTHERS + 1], 2))[:PAIRS]
    mixed = itertools.chain(zip(itertools.repeat(learned[0]), training[:OTHERS]), itertools.combinations(learned, 2))
    return list(mixed)[:PAIRS]


def answers_of(
    workspace: Workspace, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Answers to all requests of the page by request key, see :func:`pairs_of`; ``tell`` is called after each mixture."""
    state = workspace.state()
    mixes = pairs_of(state["concepts"], pairs)
    identifiers = set(itertools.chain(*mixes))
    concepts = [concept | {"seconds": 0} for concept in state["concepts"] if concept["id"] in identifiers]
    offline = {"weights": list(WEIGHTS), "pairs": [list(pair) for pair in mixes]}
    answers: dict[str, Any] = {"/api/state": state | {"concepts": concepts, "models": [], "offline": offline}}
    answers["/api/state"]["work"] |= {"concepts": concepts}
    for concept in concepts:
        answers[request_key(f"/api/thumbnail?id={concept['id']}")] = workspace.thumbnail(concept["id"])
    for pair in mixes:
        for weights in itertools.product(WEIGHTS, repeat=2):
            mixed = tuple(requests.Mixed(key, weight) for key, weight in zip(pair, weights, strict=True))
            parts = [{"id": part.id, "weight": part.weight, "groups": []} for part in mixed]
            body = {"parts": parts, "count": COUNT, "seed": 0, "temperature": state["temperature"], "execute": False, "task": ""}
            answers[request_key("/api/sample", body)] = workspace.sample(requests.Sample(mixed, COUNT)) | {"seconds": 0}
            tell()
    return answers


def write_offline(
    workspace: Workspace, path: Path, pairs: Sequence[tuple[str, str]] = (), tell: Callable[[], None] = lambda: None
) -> int:
    """Write the HTML file with :func:`answers_of`, and return its size in bytes; the same samples give the same bytes."""
    content = json.dumps(answers_of(workspace, pairs, tell), separators=(",", ":")).encode()
    text = page(bytes_hash(content), gzip.compress(content, mtime=0))
    write_text(path, text)
    return len(text.encode())


def holds_results(file: str) -> bool:
    """Whether a file or folder contains results."""
    path = Path(file)
    return path.suffix == ".csv" or (path.is_dir() and bool(visible(path, "**/*.csv")))


def results_page(file: str) -> str:
    """The page of ``report --html`` of some results. Raise UserError if there are no results."""
    from ftl_lightning.reporting.page import write_page

    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        write_page(Path(file), page)
        return page.read_text(encoding="utf-8")


def viewed(file: str, model: str = "") -> dict[str, Any]:
    """State of the page for demonstrations, samples, or a concept with its ``model`` (empty to search). Raise UserError for other
    files.
    """
    path = Path(file)
    if path.suffix == ".safetensors":
        check_readable(path, "demonstrations or concept")
        with path.open("rb") as opened:
            if kind_of(opened.read(HEADER)) == KIND:
                return _state(path.name, *_of_concept(file, model))
    return _state(path.name, *_of_demonstrations(file))


def _state(title: str, notes: list[str], groups: list[Json]) -> dict[str, Any]:
    viewer = {"title": title, "told": notes, "groups": groups}
    return {"title": title, "model": {"name": "", "title": "", "hash": ""}, "models": [], "viewer": viewer, "offline": None}


def _of_demonstrations(file: str) -> tuple[list[str], list[Json]]:
    data, broken = read_mended(file) if Path(file).is_file() else (read_own(file), ())
    domain = _domain_of(data)
    with about(file):
        data = data.fitted(domain.observed) if domain is not None else data
    show = line_drawings(data.state_names, data.state_units) if domain is None else domain.show
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
    concept = Concept.load(file)
    places = (Path("pretrained"), Path("logs"), MODELS)
    few = FewShot.from_pretrained(model or find_model(concept.origin.pretrained, places))
    learned = few.load(file)
    name = concept.origin.name
    task, starts = starts_of(few, (name,), SAMPLES, 0)
    plans = few.sample(learned, SAMPLES, starts, seed=0, **sampling_of(few))
    notes = [str(concept), *str(learned.explain()).splitlines(), *([f"samples start from scenes of {task!r}"] if task else [])]
    require(plans.states.isfinite().all(), file, "a concept whose samples are finite", "another")
    return notes, [{"concept": name, "films": _films(few.domain.show, plans, bool(few.domain.observed), [[]] * SAMPLES)}]
