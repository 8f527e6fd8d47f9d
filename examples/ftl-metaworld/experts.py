"""Success of Meta-World's scripted experts with the goal observed and hidden: ``results/experts.json``.

    python experts.py

Ten episodes a task. With a hidden goal an expert reads zeros in its place, as in Meta-World's partially observed variant.
"""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
from ftl_metaworld.environment import MetaWorld
from ftl_metaworld.source import act, scenes
from ftl_metaworld.tasks import TEXTS

OUT = Path(__file__).resolve().parent / "results" / "experts.json"
EPISODES, SEED = 10, 4_000_000


def succeeds(env: MetaWorld, scene: np.ndarray, hidden: bool) -> bool:
    """Whether the expert succeeds in an episode."""
    env.reset(options={"scene": scene})
    while True:
        if hidden:
            env.seen[36:] = 0
        _, _, success, truncated, _ = env.step(act(env))
        if success or truncated:
            return success


def main() -> None:
    """Measure every task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    out: Path = parser.parse_args().out
    env = MetaWorld()
    rates: dict[str, dict[str, float]] = {}
    for name, text in TEXTS.items():
        drawn = list(itertools.islice(scenes(text, SEED), EPISODES))
        for key in ("observed", "hidden"):
            rates.setdefault(name, {})[key] = sum(succeeds(env, scene, key == "hidden") for scene in drawn) / EPISODES
        print(name, rates[name], flush=True)
        out.write_text(json.dumps(rates, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
