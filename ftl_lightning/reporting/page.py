"""``report --html``: a self-contained page that shows results and plays films."""

import base64
import gzip
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ftl_lightning.domains.comparison import OURS, Compared
from ftl_lightning.domains.domain import CLOSED, Domain
from ftl_lightning.evaluation.pictures import FORMAT
from ftl_lightning.evaluation.results import COMPARISON, CURVES, METHOD, REFERENCE, label, latest, read_rows, read_study
from ftl_lightning.igm.concept import Concept
from ftl_lightning.reporting.comparison import METHODS, all_methods, compared, methods, reference_lines, shown_lines
from ftl_lightning.reporting.concept_figures import concept_places
from ftl_lightning.reporting.figures import COLOURS, colours
from ftl_lightning.reporting.measurements import read_speed
from ftl_lightning.reporting.table import decisive, domain_of, lookup, of_method, select, settings, summarise
from ftl_lightning.reporting.tables import AXES, points
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.shipped import FILM, shipped
from ftl_lightning.services.tensor_file import visible, write_text
from ftl_lightning.services.text import filled, say
from ftl_lightning.services.validation import read_json
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.version import __version__

HERE = Path(__file__).parent
FILMS, CONCEPTS = "films", "concepts"  # subfolders of the results: files of ``evaluation.films``, and concepts by domain and seed
MOST = 15_000_000  # page size in bytes above which a note is printed


def write_page(results: Path, path: Path) -> int:
    """Write the page of a folder of results, with :data:`FILMS` and :data:`CONCEPTS`, and return its bytes' number. Raise UserError
    if there are no results, or a file of films is invalid.
    """
    rows = read_rows(results)
    compared_rows = all_methods(read_study(results, COMPARISON), read_study(results))
    if compared_rows.empty:
        compared_rows = rows
    shown = [domain_of(name, rows) for name in sorted(set(rows["domain"]))]
    films, shapes = _films(results, shown, rows)
    overview = [_line(*line, compared_rows) for line in shown_lines(compared_rows)]
    learned = select(rows, role=METHOD)
    measured = dict.fromkeys(map(Compared, learned["method"], learned["form"]))
    filmed = {film["domain"] for film in films}
    content = {
        "domains": [{"name": domain.name, "title": _title(domain)} for domain in shown if domain.name in filmed or not filmed],
        "overview": overview,
        "films": films,
        "shapes": shapes,
        "maps": [entry for domain in shown for entry in _map(results, domain)],
        "curves": [*_curves(shown, read_study(results, CURVES)), *_speed(results)],
        "colours": colours((label(*method), method) for method in measured),
        "palette": COLOURS,
        "about": f"Made by ftl-lightning {__version__} from {len(rows)} rows of results.",
    }
    text = _html(content)
    write_text(path, text)
    if (size := len(text.encode())) > MOST:
        say(f"{path}: {size / 1e6:.0f} MB, more than {MOST / 1e6:.0f}; leave out some files of {results / FILMS}", error=True)
    return size


def _title(domain: Domain) -> str:
    return domain.name.replace("_", " ")


def _line(domain: Domain, setting: str, metric: str, results: pd.DataFrame) -> dict[str, Any]:
    """Means of methods and references."""
    rows = compared(domain, results)
    measured, references = (select(table, setting=setting, metric=metric) for table in (rows, reference_lines(domain, results)))
    means = []
    for method in methods(rows):
        if number := summarise(of_method(measured, method)):
            papers = lookup(domain, setting, metric, method=method)
            error = None if number.error is None else round(number.error, 4)
            mean = {"method": label(*method), "mean": round(number.mean, 4), "error": error}
            means.append({**mean, "paper": papers.value if papers else None})
    return {
        "domain": domain.name,
        "name": _title(domain),
        "setting": setting,
        "metric": metric,
        "less": domain.less_is_better(metric),
        "methods": means,
        "references": {str(name): round(float(value), 4) for name, value in references.groupby("method")["value"].mean().items()},
    }


def _films(results: Path, shown: Sequence[Domain], rows: pd.DataFrame) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Films with their subjects, and the shapes of each file of films. Raise UserError for a file without films."""
    of_domain = {domain.name: select(rows, domain=domain.name) for domain in shown}
    measured = {domain.name: decisive(domain, of_domain[domain.name]) for domain in shown}
    decided = {name: select(group, metric=measured[name]) for name, group in of_domain.items()}
    films, shapes = [], {}
    for path in visible(results / FILMS, "*.json"):
        content = read_json(path)
        is_films = isinstance(content, dict) and content.get("format") == FORMAT
        require(is_films, str(path), f"films of format {FORMAT}", "something else; make them with evaluation.films")
        try:
            if (name := str(content["domain"])) in decided:
                shapes[path.stem] = content["shapes"]
                films += [_task(task, path.stem, name, measured[name], decided[name]) for task in content["tasks"]]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            message = f"expected films as evaluation.films writes them, found a file with other keys ({error!r}); make it again"
            raise UserError(f"{path}: {message}") from error
    # Methods have the order of tables, for consistent colours; other names follow in order of appearance.
    names = (*(label(*method) for method in METHODS), *(film["method"] for film in films))
    order = {name: place for place, name in enumerate(dict.fromkeys(names))}
    return sorted(films, key=lambda film: (film["domain"], film["reference"], order[film["method"]])), shapes


def _task(task: Mapping[str, Any], file: str, domain: str, metric: str, rows: pd.DataFrame) -> dict[str, Any]:
    """The films of a method and task, with notes from the rows of the domain's decisive metric."""
    row = task["row"]
    return {
        "domain": domain,
        "setting": row["setting"],
        "task": row["task"],
        "method": label(row["method"], row["form"]),
        "ours": row["method"] == OURS,
        "reference": row["role"] == REFERENCE,
        "told": _notes(row, task["values"], metric, rows),
        "films": [{**film, "file": file, "decisive": metric.removeprefix(f"{CLOSED} ")} for film in task["films"]],
    }


def _notes(row: Mapping[str, Any], values: Mapping[str, float], metric: str, rows: pd.DataFrame) -> list[str]:
    """The row of the films in words, and the mean over its seeds."""
    subject = {key: row[key] for key in ("setting", "task", "method", "form", "variant", "role", "K", "omega", "demonstrations")}
    same = latest(select(rows, **subject))
    if metric not in values:
        return [f"{row['n']} samples of seed {row['seed']}"]
    if same.empty:
        return [f"{metric} {values[metric]:.2f} of {row['n']}, seed {row['seed']}"]
    of_seed = select(same, seed=row["seed"])
    notes = [f"seed {row['seed']}: {of_seed['value'].mean():.2f} of {of_seed['n'].iloc[-1]}"] if not of_seed.empty else []
    return [f"{metric} {same['value'].mean():.2f} over {same['seed'].nunique()} seeds", *notes]


def _map(results: Path, domain: Domain) -> Iterator[dict[str, Any]]:
    """Positions of a domain's concepts: training concepts of its shipped model, and concepts learned with seed 0."""
    files = visible(results / CONCEPTS / domain.name / "seed0", "*.safetensors")
    folder = shipped(f"pretrained/{domain.name}")
    if not files or not folder.is_dir():
        return
    try:
        model = load_model(folder)
        pretrained = model.hash
        learned = [concept for concept in map(Concept.load, files) if concept.origin.pretrained == pretrained]
        places = concept_places(model, learned)
    except UserError as error:  # scikit-learn or the domain's package is missing
        say(f"concepts of {domain.name} are left out: {error}", error=True)
        return
    marks = [
        {
            "x": round(place.x, 2),
            "y": round(place.y, 2),
            "name": place.name,
            "film": place.concept,
            "learned": bool(place.component),
        }
        for place in places
    ]
    yield {"domain": domain.name, "name": _title(domain), "points": marks}


def _curves(shown: Sequence[Domain], results: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for domain in shown:
        for axis in AXES:
            rows = points(domain, results, axis)
            if rows.empty:
                continue
            counts = sorted(set(map(int, rows[axis])))
            lines = []
            for setting in settings(domain, rows):
                numbers = [(count, summarise(select(rows, setting=setting, **{axis: count}))) for count in counts]
                means = [[count, round(value.mean, 4), round(value.error or 0, 4)] for count, value in numbers if value]
                lines.append({"name": setting, "points": means})
            title = f"{_title(domain)}, {' '.join(sorted(set(rows['metric'])))}"
            yield {"domain": domain.name, "title": title, "axis": axis, "log": False, "ticks": counts, "lines": lines}


def _speed(results: Path) -> Iterator[dict[str, Any]]:
    if curves := read_speed(results):
        measured = {name: [[round(row.seconds, 3), row.accuracy, 0] for row in curve] for name, curve in curves.items()}
        lines = [{"name": name, "points": points} for name, points in measured.items()]
        title, axis, ticks = "accuracy over learning time", "seconds of learning", [0.1, 1, 10, 100, 1000]
        yield {"domain": "", "title": title, "axis": axis, "log": True, "ticks": ticks, "lines": lines}


def _html(content: Mapping[str, Any]) -> str:
    raw = json.dumps(content, separators=(",", ":")).encode()
    parts = {
        "STYLE": (HERE / "page.css").read_text(encoding="utf-8"),
        "SCRIPT": FILM.read_text(encoding="utf-8") + (HERE / "page.js").read_text(encoding="utf-8"),
        "DATA": base64.b64encode(gzip.compress(raw, mtime=0)).decode(),  # base64 cannot end the script
    }
    return filled((HERE / "page.html").read_text(encoding="utf-8"), parts)
