"""Success on ML10's training tasks after a test task was learned: ``results/forgetting.json``.

    python forgetting.py

Methods that the file has are not measured again.

Concepts are those of ``conf/table.yaml``, seed 0. After each of the five test tasks, five episodes of each training task,
with the learned concept at weight 0. Ours leaves the network as it is. LoRA and full fine-tuning change it for all concepts.
"""

import argparse
import json
from pathlib import Path

import torch

from ftl_lightning import FewShot

HERE = Path(__file__).resolve().parent
EPISODES = 5
OURS, BC = ("pretrained/ml10", "conf/metaworld.yaml"), ("logs/table/bc-ml10/pretrained", "conf/bc.yaml")
METHODS: dict[str, tuple[tuple[str, str], str]] = {
    "ours": (OURS, "invert_metaworld_ml10_ours_seed_0"),
    "LoRA fine-tuning of our model": (OURS, "invert_metaworld_lora_ml10_LoRA_seed_0"),
    "full fine-tuning of our model": (OURS, "invert_metaworld_full_ml10_full_seed_0"),
    "BC, same network, LoRA": (BC, "invert_bc_lora_ml10_BC_LoRA_seed_0"),
    "BC, same network, full fine-tuning": (BC, "invert_bc_full_ml10_BC_full_seed_0"),
}
"""Model, its settings and the folder of its learned concepts, by method."""


def main() -> None:
    """Measure every method, before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "forgetting.json")
    out: Path = parser.parse_args().out
    torch.set_num_threads(1)
    rates: dict[str, dict[str, float]] = json.loads(out.read_text("utf-8")) if out.is_file() else {}
    before: dict[str, float] = {}
    for method, ((folder, settings), cell) in METHODS.items():
        if method in rates:
            continue
        model = FewShot.from_pretrained(HERE / folder, settings=HERE / settings)
        starts = {text: model.starts(text, EPISODES, seed=1) for text in model.training_concepts}

        def success(text: str, concept: object, model: FewShot = model, starts: object = starts) -> float:
            return model.execute(concept, starts[text], text).outcomes["success"]  # type: ignore[arg-type, index]

        if folder not in before:
            before[folder] = sum(success(text, model[text]) for text in starts) / len(starts)
        after = []
        for path in sorted((HERE / "logs" / "table" / cell / "concepts").glob("*.safetensors")):
            learned = model.load(path)
            for text in starts:
                after.append(success(text, model[text] + 0.0 * learned))
        rates[method] = {"before": before[folder], "after": sum(after) / len(after), "pairs": len(after)}
        print(method, rates[method], flush=True)
        out.write_text(json.dumps(rates, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
