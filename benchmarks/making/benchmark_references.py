"""Write the references of the benchmark's leaderboard from a run of one of this package's methods.

python benchmarks/making/benchmark_references.py results/submissions/ftl_igm.json
"""

import argparse
from pathlib import Path

from ftl_lightning.apps.benchmark.check import check_submission
from ftl_lightning.apps.benchmark.leaderboard import FILE, References


def main() -> None:
    """Read and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="file that benchmark METHOD --out wrote, with a method of this package")
    run, _ = check_submission(parser.parse_args().run)
    if run.code:
        raise SystemExit(f"{run.name}: expected a method of this package, found one of another")
    References.of(run).save(FILE)
    print(FILE)


if __name__ == "__main__":
    main()
