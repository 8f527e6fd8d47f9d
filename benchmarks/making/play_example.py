"""Write the example that the page of play begins with: five drawn strokes, and samples of the concept learned from them.

    python benchmarks/making/play_example.py

Places are in thousandths of the canvas, from its lower left corner.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.apps.benchmark.strokes import drawn
from ftl_lightning.apps.play import page
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.tensor_file import write_text

KIND, SEED, SHOWN, SAMPLES = "heart", 0, 5, 3
STEP = 2  # Every second state is enough for a line
HALF = 4.0  # Centimetres from the centre of the canvas to its edge


def lines(states: NDArray[np.float32]) -> list[list[list[int]]]:
    """Strokes ``(stroke, time, 2)`` in centimetres as places on the canvas."""
    inside = np.clip((states / HALF + 1) / 2, 0, 1) * 1000
    kept = np.concatenate((inside[:, :-1:STEP], inside[:, -1:]), axis=1)
    return [[[round(float(x)), round(float(y))] for x, y in stroke] for stroke in kept]


def main() -> None:
    """See the module."""
    model = FewShot.from_pretrained("strokes")
    shown = drawn(KIND, SHOWN, SEED)
    samples = model.sample(model.learn(shown, name=KIND, form="paper", seed=SEED), count=SAMPLES, seed=SEED).states.numpy()
    content = {"shown": lines(shown), "samples": lines(samples)}
    write_text(Path(page.__file__).with_name("example.json"), json.dumps(content, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()
