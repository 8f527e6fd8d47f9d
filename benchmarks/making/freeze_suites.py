"""Freeze the suites of the benchmark: draw their data and write its hashes into the suites' files.

A published suite is never frozen again; a changed generator needs a new suite.

    python benchmarks/making/freeze_suites.py --suites beats pictures reaches strokes
    python benchmarks/making/freeze_suites.py --suites agent --parts demonstrations starts
"""

import argparse
import dataclasses
import json
from pathlib import Path

from ftl_lightning.apps.benchmark.suite import DEMONSTRATIONS, FOLDER, SEEDS, STARTS, TRAINING, VALIDATION, load_suite, suite_names
from ftl_lightning.services.tensor_file import write_text

PARTS = (TRAINING, VALIDATION, DEMONSTRATIONS, STARTS)


def main() -> None:
    """Draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", nargs="+", choices=suite_names(), required=True)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--root", type=Path, help="folder of your copy of the recordings")
    options = parser.parse_args()
    for name in options.suites:
        for seed in options.seeds:
            found = {
                part: dataclasses.asdict(one)
                for part, one in load_suite(name).fingerprints(seed, options.root, options.parts).items()
            }
            path = FOLDER / f"{name}.json"
            content = json.loads(path.read_text("utf-8"))
            known = content["data"].setdefault(str(seed), {})
            if changed := [part for part in found if part in known and known[part]["hash"] != found[part]["hash"]]:
                raise SystemExit(
                    f"{path}: seed {seed}: {', '.join(changed)}: frozen with other data; a changed generator is a new suite"
                )
            known |= found
            write_text(path, json.dumps(content, indent=1) + "\n")
            print(name, seed, *(f"{part} {one['hash']}" for part, one in found.items()))


if __name__ == "__main__":
    main()
