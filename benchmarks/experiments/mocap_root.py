"""Judge human motion with the path of the root: accuracy, rules, and how far standing feet slide, beside recordings.

    python benchmarks/experiments/mocap_root.py --root FOLDER [--pretrained mocap_root] [--out results/mocap_root.json]

New concepts are learned from five recordings, with an adapter and as embeddings alone, for each seed, and sampled from new initial
poses, as in the tables of human motion; training concepts are sampled once. ``recordings`` are windows of held-out trials. Sliding
is the mean over samples in which a foot stands, in metres a frame; *still* is the share of samples below :data:`STILL`.
"""

import argparse
import json
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap.skeleton import HORIZON
from ftl_lightning.domains.mocap.tasks import TEST_CONCEPTS, VALIDATION_CONCEPTS
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

STILL = 0.02  # Metres a frame
DEMONSTRATIONS, SHOWN = 5, ("walk", "run", "jump")
FORMS: dict[str, dict[str, Any]] = {
    "with an adapter": {},
    "embeddings alone": {"adapter": 0, "guidance_scale": 1.5, "steps": 100},  # as in conf/mocap.yaml
}
METRICS = ("accuracy", "rule", "jerk")


def numbers(model: FewShot, goal: str, states: Tensor, starts: InitialStates | None) -> dict[str, float]:
    """Means of the metrics, and of sliding, of states ``(sample, 32, 46)``."""
    measured = model.domain.measure(goal, states, starts)
    sliding = measured["skating"][measured["skating"].isfinite()]
    means = {name: float(measured[name].float().mean()) for name in METRICS if not measured[name].isnan().all()}
    means |= {"skating": float(sliding.mean()), "still": float((sliding < STILL).float().mean())}
    return {name: round(value, 4) for name, value in means.items()}


def recorded(model: FewShot, root: Path) -> dict[str, float]:
    """The same of all windows of held-out trials, one after the other."""
    held_out = model.domain.source(root).split("validation", 0, 0)
    pairs = zip(held_out.states, held_out.lengths.tolist(), strict=True)
    windows = [states[first : first + HORIZON] for states, length in pairs for first in range(0, length - HORIZON + 1, HORIZON)]
    return numbers(model, "walk", torch.stack(windows), None) | {"windows": len(windows)}


def table(results: Mapping[str, Any]) -> str:
    """Markdown: mean over seeds and, in brackets, their spread."""
    lines = ["| motion | rule | judge | sliding, cm a frame | still | jerk |", "|---|---|---|---|---|---|"]
    for text, found in results.items():
        rows = found.get("seeds", [found])
        cells = [text]
        for name, scale, digits in (("rule", 1, 2), ("accuracy", 1, 2), ("skating", 100, 2), ("still", 1, 2), ("jerk", 1, 0)):
            values = [scale * row[name] for row in rows if name in row]
            spread = f" ({stdev(values):.{digits}f})" if len(values) > 1 else ""
            cells.append(f"{mean(values):.{digits}f}{spread}" if values else "-")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--pretrained", default="mocap_root")
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--out", type=Path, default=Path("results/mocap_root.json"))
    chosen = parser.parse_args()
    model = FewShot.from_pretrained(chosen.pretrained, settings="conf/mocap_root.yaml")
    source = model.domain.source(chosen.root)
    kinematic = {name: value for name, value in recorded(model, chosen.root).items() if name not in ("accuracy", "rule")}
    results: dict[str, Any] = {"recordings": kinematic}
    concepts = (*TEST_CONCEPTS, *VALIDATION_CONCEPTS)
    with bar("human motion with root", len(SHOWN) + len(FORMS) * len(concepts) * len(chosen.seeds), lines=True) as advance:
        for text in SHOWN:
            starts = source.starts(text, chosen.samples, 0)
            results[text] = numbers(model, text, model.sample(model[text], None, starts).states, starts)
            advance()
        for (form, settings), text in product(FORMS.items(), concepts):
            rows = []
            for seed in chosen.seeds:
                learned = model.learn(source.draw(text, DEMONSTRATIONS, seed), name=text, seed=seed, **settings)
                starts = source.starts(text, chosen.samples, seed)
                rows.append(numbers(model, text, model.sample(learned, None, starts, seed=seed).states, starts))
                advance()
            results[f"{text}, {form}"] = {"seeds": rows}
    content = {"model": model.model.hash, "samples": chosen.samples, "motions": results}
    write_text(chosen.out, json.dumps(content, indent=1) + "\n")
    write_text(chosen.out.with_suffix(".md"), table(results))


if __name__ == "__main__":
    main()
