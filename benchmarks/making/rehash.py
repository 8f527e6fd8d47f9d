"""Rewrite the hashes of committed results after a change of what a configuration's hash is made of.

Describe the cells of all plans by the code before and after the change, then rewrite the files:

    git worktree add /tmp/before COMMIT
    (cd /tmp/before && PYTHONPATH=. python ~+/benchmarks/making/rehash.py describe --out /tmp/before.json)
    PYTHONPATH=. python benchmarks/making/rehash.py describe --out /tmp/after.json
    python benchmarks/making/rehash.py rewrite --before /tmp/before.json --after /tmp/after.json

A row belongs to a cell if it has the cell's hash before, or else if no other cell of its plan has the row's columns. ``rewrite``
changes no other column, and lists rows that belong to no cell. Nothing is trained or generated; demonstrations are not read.
"""

import argparse
import csv
import functools
import importlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import yaml

PLANS = [
    *(f"conf/ablation/{name}.yaml" for name in ("object_rearrangement", "agent", "driving", "mocap", "tabletop", "tabletop_wide")),
    *(f"conf/ablation/{name}.yaml" for name in ("comparison", "curves", "changes")),
    "benchmarks/experiments/paper_size.yaml",
    "benchmarks/making/films.yaml",
]
HASH = "config_hash"
SAME = ("domain", "method", "form", "variant", "K", "omega", "seed", "model_hash")
"""Columns that a row shares with its cell."""


def module(*names: str) -> ModuleType:
    """The first module that exists: the code before a change may have other names."""
    for name in names[:-1]:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError:
            continue
    return importlib.import_module(names[-1])


class AnyText(str):
    """Identity of a text encoder that equals every other: no texts are embedded."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = str.__hash__


def describe(plans: Sequence[str], out: Path) -> None:
    """Write the columns and hashes of every cell of ``invert``.

    Where the pretrained model is missing, the cell is described with each model in the plan's results.
    """
    runs = module("ftl_lightning.apps.ablation.run", "ftl_lightning.ablation.run")
    stage = module("ftl_lightning.apps.ablation.plan", "ftl_lightning.ablation.plan").Stage
    adaptation = module("ftl_lightning.training.adaptation", "ftl_lightning.learning.adaptation")
    language = module("ftl_lightning.methods.language.adaptation")
    data = module("ftl_lightning.training.data", "ftl_lightning.domains.data")
    cells = []
    with (
        patch.object(data.InversionData, "_drawn", lambda *_: SimpleNamespace(concepts=())),
        patch.object(language, "load_encoder", lambda *_: SimpleNamespace(identity=AnyText())),
        patch.object(adaptation, "load_model", functools.cache(adaptation.load_model)),
    ):
        for plan in plans:
            content = yaml.safe_load(Path(plan).read_text("utf-8"))
            results = Path(content["results"])
            models = {(row["domain"], row["model_hash"]) for row in _rows(results)} if results.is_file() else set()
            planned = runs.planned([stage(**keys) for keys in content["stages"]], content["seeds"])
            for number, cell in ((number, cell) for number, group in planned.items() for cell in group if cell.verb == "invert"):
                for description in _described(cell, models):
                    cells.append({"plan": plan, "results": str(results), "stage": number, "cell": cell.name, **description})
                print(f"{plan}: {cell.name}", flush=True)
            out.write_text(json.dumps(cells, indent=0), "utf-8")


def _described(cell: Any, models: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    """Columns and hashes of a cell, by pretrained model."""
    runs = module("ftl_lightning.apps.ablation.run", "ftl_lightning.ablation.run")
    cli = module("ftl_lightning.apps.lightning_cli", "ftl_lightning.lightning_cli")
    folders = module("ftl_lightning.services.log_folder", "ftl_lightning.log_folder")
    hashing = module("ftl_lightning.evaluation.rows", "ftl_lightning.evaluation.results")
    evaluators = module("ftl_lightning.evaluation.evaluator")
    arguments = list(cell.arguments)
    option = "--model.pretrained="
    missing = [text for text in arguments if text.startswith(option) and not Path(text.removeprefix(option)).is_dir()]
    with folders.run():  # the domain's own model stands in for a missing one
        line = cli.build(cell.verb, [text for text in arguments if text not in missing] + runs._log(cell))
    evaluator = next(callback for callback in line.trainer.callbacks if isinstance(callback, evaluators.Evaluator))
    learner, hparams = line.model, line.model.hparams
    hashes = {_model_hash(learner.model)}
    hashes |= {model for domain, model in models if missing and model and domain == learner.domain.name}
    described = []
    for model in sorted(hashes):
        with patch.object(type(learner.model), "hash", model):
            configured = hashing.configuration(learner, line.datamodule, evaluator.settings(line.datamodule), line.trainer)
        described.append(
            {
                "domain": learner.domain.name,
                "method": learner.method,
                "form": learner.form,
                "variant": learner.variant if evaluator.variant is None else evaluator.variant,
                "K": hparams.get("components", 0),
                "omega": str(hparams.get("omega", hparams.get("guidance", "none"))),
                "seed": hparams["seed"],
                "model_hash": model,
                "samples": configured["evaluation/samples"],
                "suites": configured["evaluation/suites"],
                "demonstrations": configured["data/demonstrations_per_concept"],
                HASH: hashing.config_hash(configured),
                "reference_hash": _reference_hash(hashing, configured),
                "configuration": json.loads(json.dumps(configured, default=str)),
            }
        )
    return described


@functools.cache
def _model_hash(model: Any) -> str:
    return str(model.hash)


def _reference_hash(hashing: ModuleType, configured: Mapping[str, Any]) -> str:
    """Hash of reference lines; before hashes had a version it was made as below."""
    if hasattr(hashing, "reference_hash"):
        return str(hashing.reference_hash(configured))
    shared = [hashing.__version__, configured["evaluation/samples"], configured["evaluation/sample_seed"]]
    return str(hashing.content_hash(shared + ([configured["environment"]] if "environment" in configured else [])))


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


class Cells:
    """New hashes by old hash, and by the columns of a row.

    Args:
        before: cells described by the code before the change.
        after: cells described by the code after the change.
    """

    def __init__(self, before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> None:
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
        tasks = {(row["setting"], row["task"]) for row in rows}
        count, learned = {int(row["n"]) for row in rows}, {int(row["demonstrations"]) for row in rows} - {0}
        return {
            cell[HASH]
            for cell in self.after
            if cell["results"] == file
            and all(str(cell[column]) == rows[0][column] for column in SAME)
            and count == {cell["samples"]}
            and (not learned or min(learned) == cell["demonstrations"])
            and tasks <= _tasks(cell["domain"], cell["suites"])
        }


def _identity(cell: Mapping[str, Any]) -> tuple[Any, ...]:
    return (cell["plan"], cell["stage"], cell["cell"], cell["model_hash"])


@functools.cache
def _tasks(domain: str, suites: str) -> set[tuple[str, str]]:
    """Settings and tasks of suites."""
    known = module("ftl_lightning.domains.registry").load_domain(domain).concepts.suites
    return {(task.setting, task.name) for name in suites.split(", ") if name for task in known[name].tasks}


def rewrite(before: Path, after: Path, files: Sequence[str]) -> None:
    """Rewrite the hashes in results files and films, and print what belongs to no cell."""
    cells = Cells(json.loads(before.read_text("utf-8")), json.loads(after.read_text("utf-8")))
    for name in files:
        path = Path(name)
        text = path.read_bytes().decode()
        if path.suffix == ".json":
            changed = re.sub(r'("config_hash": ")(\w+)"', lambda match: f'{match[1]}{cells.new.get(match[2], match[2])}"', text)
            path.write_bytes(changed.encode())
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
    rewriting.add_argument("--before", type=Path, required=True)
    rewriting.add_argument("--after", type=Path, required=True)
    options = parser.parse_args()
    if options.verb == "describe":
        describe(options.plans, options.out)
    else:
        rewrite(options.before, options.after, options.files)


if __name__ == "__main__":
    main()
