"""Learn the push on the book with a model whose pretraining pushes and picks at the height of the table only, as in the paper.

    python -m ftl_lightning fit --config conf/tabletop.yaml --model.view level --trainer.logger.init_args.name tabletop_level
    python benchmarks/experiments/tabletop_level.py --pretrained logs/tabletop_level/fit/pretrained

The shipped model also sees raised scenes (view ``points``). Closed loop success in the same new scenes: the text of the push on the
table, the concept learned from ten demonstrations in the paper's form, with learned weights or not, and with an adapter.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from ftl_lightning.domains.tabletop.interface import PUSH, PUSH_ON_BOOK, TRAINING_CONCEPTS
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

DEMONSTRATIONS, SCENE_SEED = 10, 5_000_000
FORMS: dict[str, tuple[str, dict[str, Any]]] = {
    "learned": ("conf/tabletop.yaml", {}),
    "learned, one component of weight 1": ("conf/tabletop.yaml", {"components": 1, "omega": 1.0}),
    "learned, with an adapter": ("conf/tabletop_adapter.yaml", {}),
}


def rates(model: FewShot, concept: Composition, goal: str, scenes: int, seed: int) -> dict[str, float]:
    """Share of successful episodes, and of episodes that move the book, in new scenes."""
    done = model.execute(concept, model.starts(goal, scenes, SCENE_SEED + seed), goal, seed=seed)
    return {name: round(value, 4) for name, value in done.outcomes.items()}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="logs/tabletop_level/fit/pretrained")
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--out", type=Path, default=Path("results/tabletop_level.json"))
    chosen = parser.parse_args()
    models = {name: FewShot.from_pretrained(chosen.pretrained, settings=config) for name, (config, _) in FORMS.items()}
    model = models["learned"]
    results: dict[str, object] = {"model": model.model.hash, "scenes": chosen.scenes, "seeds": chosen.seeds}
    with bar("table-top, level", len(chosen.seeds) * (1 + len(models)) + len(TRAINING_CONCEPTS), lines=True) as advance:
        for seed in chosen.seeds:
            measured = {"training text": rates(model, model[PUSH], PUSH_ON_BOOK, chosen.scenes, seed)}
            advance()
            for name, form in models.items():
                demonstrations = form.domain.source(None).draw(PUSH_ON_BOOK, DEMONSTRATIONS, seed)
                concept = form.learn(demonstrations, name=PUSH_ON_BOOK, seed=seed, **FORMS[name][1])
                measured[name] = rates(form, concept, PUSH_ON_BOOK, chosen.scenes, seed)
                advance()
            results[f"seed {seed}"] = measured
        trained = {}
        for task in TRAINING_CONCEPTS:
            trained[task] = rates(model, model[task], task, chosen.scenes, 0)
            advance()
    text = json.dumps(results | {"training concepts": trained}, indent=1) + "\n"
    print(text)
    write_text(chosen.out, text)


if __name__ == "__main__":
    main()
