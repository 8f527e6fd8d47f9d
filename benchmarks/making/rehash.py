"""Rewrite the hashes of committed results after a change of what a configuration's hash is made of.

Describe the cells of all plans by the code before and after the change, then rewrite the files:

    (cd BEFORE && PYTHONPATH=. python ~+/benchmarks/making/rehash.py describe --out /tmp/before.json)
    PYTHONPATH=. python benchmarks/making/rehash.py describe --out /tmp/after.json
    python benchmarks/making/rehash.py rewrite --before /tmp/before.json --after /tmp/after.json results/*.csv results/films/*.json

Without ``--before`` the hashes before are those of version 1, which :func:`version_1` makes of the same descriptions. A row belongs
to a cell if it has the cell's hash before, or else if no other cell of its plan has its columns. Other columns are kept. Rows
that belong to no cell are listed. Nothing is trained or generated, and no demonstrations are read.
"""

import argparse
import csv
import functools
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import yaml

from ftl_lightning.apps.ablation.plan import Cell, Stage
from ftl_lightning.apps.ablation.run import _log
from ftl_lightning.apps.lightning_cli import build
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.evaluation.generation import OWN
from ftl_lightning.evaluation.results import config_hash, configuration, reference_hash
from ftl_lightning.igm.settings import INVERSION, InversionSettings
from ftl_lightning.methods import adaptation as language
from ftl_lightning.services import log_folder
from ftl_lightning.services.tensor_file import content_hash
from ftl_lightning.training import adaptation, data
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.version import __version__

PLANS = [
    *(f"conf/ablation/{name}.yaml" for name in ("object_rearrangement", "agent", "driving", "mocap", "tabletop", "tabletop_wide")),
    *(f"conf/ablation/{name}.yaml" for name in ("comparison", "curves", "changes")),
    "benchmarks/experiments/paper_size.yaml",
    "benchmarks/making/films.yaml",
]
HASH = "config_hash"
SAME = ("domain", "method", "form", "K", "omega", "seed", "model_hash")
"""Columns that a row shares with its cell, besides the variant."""
TRAITS = {"conf/ablation/agent.yaml": "flat", "conf/ablation/driving.yaml": "map"}
"""Trait of a plan's models that do not ship; the names of their cells contain it."""


class AnyText(str):
    """Identity of a text encoder that equals every other: no texts are embedded."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = str.__hash__


def describe(plans: Sequence[str], out: Path) -> None:
    """Write the columns and the configuration of every cell of ``invert``, for the first of its seeds.

    The domain's own model stands in for a missing pretrained model.
    """
    described = []
    with (
        patch.object(data.InversionData, "_drawn", lambda *_: SimpleNamespace(concepts=())),
        patch.object(language, "load_encoder", lambda *_: SimpleNamespace(identity=AnyText())),
        patch.object(adaptation, "load_model", functools.cache(load_model)),
    ):
        for plan in plans:
            content = yaml.safe_load(Path(plan).read_text("utf-8"))
            for number, stage in enumerate((Stage(**keys) for keys in content["stages"]), 1):
                seeds = list(stage.seeds or content["seeds"])
                for cell in stage.cells(seeds[0]) if stage.verb == "invert" else ():
                    where = {"plan": plan, "results": content["results"], "stage": number, "cell": cell.name, "seeds": seeds}
                    described.append(where | _described(cell))
                    print(f"{plan}: {cell.name}", flush=True)
            out.write_text(json.dumps(described, indent=0), "utf-8")


def _described(cell: Cell) -> dict[str, Any]:
    option = "--model.pretrained="
    missing = [text for text in cell.arguments if text.startswith(option) and not Path(text.removeprefix(option)).is_dir()]
    with log_folder.run():
        line = build(cell.verb, [text for text in cell.arguments if text not in missing] + _log(cell))
    evaluator = next(callback for callback in line.trainer.callbacks if isinstance(callback, Evaluator))  # type: ignore[attr-defined]
    learner, hparams = line.model, line.model.hparams
    with patch.object(type(learner.model), "hash", _model_hash(learner.model)):
        configured = configuration(learner, line.datamodule, evaluator.settings(line.datamodule), line.trainer)
    return {
        "missing": bool(missing),
        "form": learner.form,
        "variant": learner.variant if evaluator.variant is None else evaluator.variant,
        "K": hparams.get("components", 0),
        "omega": str(hparams.get("omega", hparams.get("guidance", "none"))),
        "data/domain": line.datamodule.hparams["domain"],
        "configuration": json.loads(json.dumps(configured, default=str)),
    }


@functools.cache
def _model_hash(model: Any) -> str:
    return str(model.hash)


def version_1(cell: Mapping[str, Any]) -> dict[str, str]:
    """Hashes of version 1, which left out options that had been added later and had neutral values."""
    inversion = InversionSettings()
    neutral = dict.fromkeys(f"model/{name}" for name in INVERSION) | {
        "model/modes": 1,
        "model/mode_samples": 8,
        "model/knots": 1,
        "model/guidance_scale": 1.0,
        "model/adapter": 0,
        "model/adapter_learning_rate": 1e-3,
        "model/adapter_scope": "concept",
        "model/form": "",
        "model/start": inversion.embeddings.start,
        "model/screening": inversion.budget.screening,
        "model/precision": inversion.budget.precision,
        "data/demonstrations": None,
        "evaluation/replan": None,
        "evaluation/environments": [],
        "environment": "",
    }
    known = {key: value for key, value in cell["configuration"].items() if key not in neutral or value != neutral[key]}
    for key in ("domain", "method"):
        del known[key]
    shared = [known[key] for key in ("evaluation/samples", "evaluation/sample_seed", "environment") if key in known]
    return {
        HASH: content_hash([__version__, known | {"data/domain": cell["data/domain"]}]),
        "reference_hash": content_hash([__version__, *shared]),
    }


def version_2(cell: Mapping[str, Any]) -> dict[str, str]:
    """Hashes by the code that described the cell."""
    return {HASH: config_hash(cell["configuration"]), "reference_hash": reference_hash(cell["configuration"])}


def expanded(cells: Iterable[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Cells of all seeds; a cell without its pretrained model with each model in the plan's results."""
    for cell in cells:
        domain, file = cell["configuration"]["domain"], Path(cell["results"])
        models = {cell["configuration"]["model/pretrained"]}
        if cell["missing"] and file.is_file():
            models |= {row["model_hash"] for row in _rows(file) if row["domain"] == domain and row["model_hash"]}
        for seed in cell["seeds"]:
            seeds = dict.fromkeys(("model/seed", "data/seed", "evaluation/sample_seed"), seed)
            for model in sorted(models):
                configured = cell["configuration"] | seeds | {"model/pretrained": model}
                columns = {"domain": domain, "method": configured["method"], "seed": seed, "model_hash": model}
                yield {**cell, **columns, "configuration": configured}


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


class Cells:
    """New hashes by old hash, and by the columns of a row.

    Args:
        before: cells before the change, with their hashes.
        after: the cells after the change, with their hashes.
    """

    def __init__(self, before: Iterable[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> None:
        new = {_identity(cell): cell for cell in after}
        pairs = [(old, new[_identity(old)]) for old in before if _identity(old) in new]
        self.new = {old[HASH]: cell[HASH] for old, cell in pairs}
        self.references = {(old["domain"], old["reference_hash"]): cell["reference_hash"] for old, cell in pairs}
        if conflicts := [old for old, cell in pairs if self.new[old[HASH]] != cell[HASH]]:
            raise SystemExit(f"{len(conflicts)} cells with equal hashes before differ now: {conflicts[0]['cell']}")
        self.after = after

    def of_rows(self, file: str, rows: Sequence[Mapping[str, str]]) -> set[str]:
        """New hashes of the cells that rows with a common unknown hash may belong to.

        Args:
            file: results file.
            rows: rows of the method.
        """
        tasks = {(row["setting"], row["task"]) for row in rows if row["setting"] != OWN}
        samples, learned = max(int(row["n"]) for row in rows), {int(row["demonstrations"]) for row in rows} - {0}
        return {
            cell[HASH]
            for cell in self.after
            if cell["results"] == file
            and all(str(cell[column]) == rows[0][column] for column in SAME)
            and _variant(cell, rows[0]["variant"])
            and samples == cell["configuration"]["evaluation/samples"]
            and (not learned or min(learned) == cell["configuration"]["data/demonstrations_per_concept"])
            and tasks <= _tasks(cell["domain"], cell["configuration"]["evaluation/suites"])
        }


def _variant(cell: Mapping[str, Any], variant: str) -> bool:
    """Whether a row's variant is that of a cell, whose own model has other traits than the model that stands in for it."""
    trait = TRAITS.get(cell["plan"])
    if trait not in cell["cell"].split(", "):
        return bool(variant == cell["variant"])
    first, *_, last = variant.split(", ")
    return first == trait and cell["variant"].endswith(last)


def _identity(cell: Mapping[str, Any]) -> tuple[Any, ...]:
    return (cell["plan"], cell["stage"], cell["cell"], cell["seed"], cell["model_hash"])


@functools.cache
def _tasks(domain: str, suites: str) -> set[tuple[str, str]]:
    """Settings and tasks of suites."""
    known = load_domain(domain).concepts.suites
    return {(task.setting, task.name) for name in suites.split(", ") if name for task in known[name].tasks}


def rewrite(after: Sequence[Path], files: Sequence[str], before: Path | None = None) -> None:
    """Rewrite the hashes in results files and films, and print what belongs to no cell."""
    new = [cell | version_2(cell) for path in after for cell in expanded(json.loads(path.read_text("utf-8")))]
    known = [cell | version_1(cell) for cell in new]
    if before is not None:
        known = [cell | version_2(cell) for cell in expanded(json.loads(before.read_text("utf-8")))]
    cells = Cells(known, new)
    for name in files:
        path = Path(name)
        text = path.read_bytes().decode()
        if path.suffix == ".json":
            path.write_bytes(_films(cells, text).encode())
            continue
        rows = _rows(path)
        hashes = _new_hashes(cells, name, rows)
        lines = text.splitlines(keepends=True)
        assert len(lines) == len(rows) + 1
        for number, row in enumerate(rows, 1):
            head, old, tail = lines[number].rsplit(",", 2)
            assert old == row[HASH], "the hash is in the last column but one"
            lines[number] = ",".join((head, hashes.get((row["domain"], row["role"], old), old), tail))
        path.write_bytes("".join(lines).encode())


def _films(cells: Cells, text: str) -> str:
    """Content of a file of films with new hashes."""
    film_domain = json.loads(text)["domain"]
    known = cells.new | {old: new for (domain, old), new in cells.references.items() if domain == film_domain}
    return re.sub(r'("config_hash": ")([\w:]+)"', lambda match: f'{match[1]}{known.get(match[2], match[2])}"', text)


def _new_hashes(cells: Cells, name: str, rows: Sequence[Mapping[str, str]]) -> dict[tuple[str, str, str], str]:
    """New hashes of a file's rows by domain, role and old hash; prints how they were found."""
    groups: dict[tuple[str, str, str], list[Mapping[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["domain"], row["role"], row[HASH]), []).append(row)
    hashes: dict[tuple[str, str, str], str] = {}
    counts: Counter[str] = Counter()
    for (domain, role, old), group in groups.items():
        how = "same hash before"
        new = cells.references.get((domain, old)) if role == "reference" else cells.new.get(old)
        if new is None and role != "reference":
            found = cells.of_rows(name, group)
            how, new = ("same columns", next(iter(found))) if len(found) == 1 else (f"{len(found)} cells", None)
        elif new is None:
            how = "unknown reference"
        counts[how] += len(group)
        if new is not None:
            hashes[domain, role, old] = new
        if how != "same hash before":
            first = group[0]
            print(
                f"  {old} ({len(group)} rows, {how}): {', '.join(first[key] for key in (*SAME, 'setting', 'n', 'demonstrations'))}"
            )
    print(f"{name}: {len(rows)} rows: {', '.join(f'{count} {how}' for how, count in counts.items())}", flush=True)
    return hashes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    describing = verbs.add_parser("describe")
    describing.add_argument("plans", nargs="*", default=PLANS)
    describing.add_argument("--out", type=Path, required=True)
    rewriting = verbs.add_parser("rewrite")
    rewriting.add_argument("files", nargs="+")
    rewriting.add_argument("--before", type=Path)
    rewriting.add_argument("--after", type=Path, nargs="+", required=True)
    options = parser.parse_args()
    if options.verb == "describe":
        describe(options.plans, options.out)
    else:
        rewrite(options.after, options.files, options.before)


if __name__ == "__main__":
    main()
