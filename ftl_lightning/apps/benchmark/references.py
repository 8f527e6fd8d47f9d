"""Reference lines of the leaderboard: committed scores that this package computed; no submission changes them."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.apps.benchmark.submission import Score, Submission, score
from ftl_lightning.apps.benchmark.suite import load_suite
from ftl_lightning.services.errors import about
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.validation import from_mapping, read_json

FILE = Path(__file__).parent / "references.json"


@dataclass(frozen=True, kw_only=True)
class References:
    """Scores of reference policies.

    Attributes:
        version, machine: version of ftl-lightning and machine on which they were computed.
        suites: hashes of the suites' definitions by name.
        scores: scores by suite, reference policy and measure; without measures that a policy lacks.
    """

    version: str
    machine: Mapping[str, str]
    suites: Mapping[str, str]
    scores: Mapping[str, Mapping[str, Mapping[str, Score]]]

    @classmethod
    def load(cls) -> "References":
        """Read the committed file."""
        with about(FILE):
            return from_mapping(cls, read_json(FILE, "references"), "")

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        write_text(path, json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False) + "\n")

    @classmethod
    def of(cls, run: Submission) -> "References":
        """References that a run of this package measured beside its method."""
        scores: dict[str, dict[str, dict[str, Score]]] = {}
        for name in sorted(run.suites):
            suite, runs = load_suite(name), [entry for entry in run.runs if entry.suite == name]
            for line in sorted(set.intersection(*(set(entry.references) for entry in runs))):
                rows = [entry.references[line] for entry in runs]
                measured = set.intersection(*({*row.measures} for seed_rows in rows for row in seed_rows))
                scores.setdefault(name, {})[line] = {
                    measure: score(suite, rows, measure) for measure in suite.measures if measure in measured
                }
        suites = {name: run.suites[name] for name in scores}
        return cls(version=run.version, machine=run.machine, suites=suites, scores=scores)
