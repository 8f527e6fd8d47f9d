"""Files of strangers, changed at random: each is read, or refused in one line."""

import re

import pytest

from tests.conftest import ROOT, python


@pytest.mark.fuzz
@pytest.mark.parametrize("kind", ["lerobot", "lerobot v2.1", "minari", "bvh", "npy", "json", "mat", "h5", "pt", "csv", "parquet"])
def test_changed_files_are_read_or_refused(kind: str) -> None:
    for name in ("minari", "h5py", "pyarrow"):
        pytest.importorskip(name)
    done = python(ROOT / "benchmarks" / "stress" / "fuzz.py", f"--kind={kind}", "--count=60")
    assert done.returncode == 0, done.stderr
    (outcomes,) = re.findall(rf"^{re.escape(kind)}: (.*); \d+ s$", done.stdout, re.M)
    assert set(re.sub(r" \d+", "", outcomes).split(", ")) <= {"ok", "UserError"}, done.stdout
