"""Roughness of fresh demonstrations relative to five others of their concept, on the data sets of own data.

    python benchmarks/experiments/roughness.py [--out results/roughness.json]

Four sets of five demonstrations of each training concept, compared with 40 others; the limits of
:mod:`ftl_lightning.igm.forms.quality` lie outside these values.
"""

import argparse
import json

import numpy as np
from real_data import NAMES, MissingData, one_set

from ftl_lightning.data.places import first_windows
from ftl_lightning.igm.forms.quality import Quality
from ftl_lightning.services.tensor_file import write_text

SETS, FIVE, DRAWN, SEED = 4, 5, 60, 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/roughness.json")
    options = parser.parse_args()
    rows = {}
    for name in NAMES:
        try:
            data = one_set(name)
        except MissingData as error:
            print(f"{name}: {error}")
            continue
        values = []
        for kind in data.training:
            real = data.demonstrations(kind, DRAWN, SEED)
            if len(real) <= SETS * FIVE:
                continue
            windows = first_windows(real, int(real.lengths.max()))
            windows = (windows - windows.mean(dim=(0, 1))) / windows.std(dim=(0, 1)).clamp(min=1e-9)
            for first in range(0, SETS * FIVE, FIVE):
                values.append(Quality.of(windows[SETS * FIVE :], windows[first : first + FIVE]).roughness)
        rows[name] = {"sets": len(values), "least": min(values), "median": float(np.median(values)), "most": max(values)}
        print(name, rows[name], flush=True)
    content = {"command": "python benchmarks/experiments/roughness.py", "sets": rows}
    write_text(options.out, json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
