"""Plot the accuracy of training concepts over the steps of pretraining, for several runs, from their logs.

    python -m ftl_lightning fit --config conf/agent.yaml
    python -m ftl_lightning ablate --config conf/ablation/changes.yaml
    python benchmarks/experiments/training_curves.py --run ours logs/agent/fit --run "the paper's form" logs/changes/agent-paper0

A resumed run is a single curve.
"""

import argparse
import json
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import atomic, write_text

TAG = "accuracy/training concept"


def curve(folder: str, tag: str) -> list[tuple[int, float]]:
    """Steps of training and what was measured after them, of a run that may have been resumed.

    Raises:
        UserError: naming the folder, if nothing was logged there.
    """
    if not Path(folder).is_dir():
        raise UserError(f"{folder}: expected the log folder of a fit, found none")
    events = EventAccumulator(folder, size_guidance={"scalars": 0}).Reload()
    if tag not in events.Tags()["scalars"]:
        raise UserError(f"{folder}: expected {tag!r} among what was logged, found {', '.join(events.Tags()['scalars'])}")
    found = {event.step + 1: round(event.value, 4) for event in events.Scalars(tag)}
    return sorted(found.items())


def drawn(curves: dict[str, list[tuple[int, float]]], tag: str, chance: float) -> Figure:
    """Curves over the number of steps, on a logarithmic scale."""
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, label=name)
    axes.axhline(chance, color="grey", linestyle=":", label="nearest object")
    axes.set(xscale="log", xlabel="steps of pretraining", ylabel=tag, ylim=(0, 1.03))
    axes.legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs=2, action="append", required=True, metavar=("NAME", "FOLDER"), help="log folder of a fit")
    parser.add_argument("--tag", default=TAG, help="what is shown")
    parser.add_argument("--chance", type=float, default=0.53, help="of the dotted line")
    parser.add_argument("--out", help="JSON file")
    parser.add_argument("--figure", help="PNG file")
    options = parser.parse_args()
    curves = {name: curve(folder, options.tag) for name, folder in options.run}
    for name, points in curves.items():
        print(f"{name:40s}", " ".join(f"{step}: {value:.2f}" for step, value in points))
    if options.out:
        write_text(options.out, json.dumps({"tag": options.tag, "steps and values": curves}) + "\n")
    if options.figure:
        matplotlib.use("Agg")
        with atomic(Path(options.figure)) as temporary:
            drawn(curves, options.tag, options.chance).savefig(temporary, dpi=110, format="png")


if __name__ == "__main__":
    main()
