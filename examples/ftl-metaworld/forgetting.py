"""Success on ML10's training tasks after a test task was learned: ``results/forgetting.json``.

    python forgetting.py

After each of the five test tasks, 10 episodes of each training task. Ours adds a concept and leaves the network as it is; LoRA and
full fine-tuning change the network for all concepts.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch

from ftl_lightning import FewShot
from ftl_lightning.services.randomness import DEMONSTRATION_SEED

OUT = Path(__file__).resolve().parent / "results" / "forgetting.json"
EPISODES = 10
OURS, BC = "pretrained/ml10", "logs/table/bc-ml10/pretrained"
METHODS: dict[str, tuple[str, str, dict[str, Any] | None]] = {
    "before": (OURS, "conf/metaworld.yaml", None),
    "ours": (OURS, "conf/metaworld.yaml", {}),
    "LoRA fine-tuning": (OURS, "conf/metaworld.yaml", {"form": "paper", "adapter_scope": "all"}),
    "full fine-tuning": (OURS, "conf/metaworld.yaml", {"form": "paper", "adapter_scope": "all", "adapter": 256}),
    "BC before": (BC, "conf/bc.yaml", None),
    "BC, LoRA fine-tuning": (BC, "conf/bc.yaml", {"form": "paper", "adapter_scope": "all", "adapter": 8}),
    "BC, full fine-tuning": (BC, "conf/bc.yaml", {"form": "paper", "adapter_scope": "all", "adapter": 256}),
}
"""Model, its settings, and how a task is learned (``None`` for not at all), by method."""


def main() -> None:
    """Measure every method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    out: Path = parser.parse_args().out
    torch.set_num_threads(1)
    rates: dict[str, list[float]] = {}
    for method, (folder, settings, changes) in METHODS.items():
        model = FewShot.from_pretrained(folder, settings=settings)
        source = model.domain.source(None)
        for task in model.domain.concepts.suites["paper"].goals if changes is not None else ("",):
            learned = None if changes is None else model.learn(source.draw(task, 5, DEMONSTRATION_SEED), name=task, **changes)
            for text in model.training_concepts:
                concept = model[text] if learned is None else model[text] + 0.0 * learned
                done = model.execute(concept, model.starts(text, EPISODES, seed=1), text)
                rates.setdefault(method, []).append(round(done.outcomes["success"], 4))
            print(method, task, sum(rates[method]) / len(rates[method]), flush=True)
            out.write_text(json.dumps(rates, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
