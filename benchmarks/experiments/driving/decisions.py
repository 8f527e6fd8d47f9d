"""Agreement of policies learned from five drives with the decisions of the expert, on its drives from new starts.

    python benchmarks/experiments/driving/decisions.py --task "roundabout third exit" --drives 30
    python benchmarks/experiments/driving/decisions.py --task roundabout --pretrained logs/ablation/driving-steps{0,1,2}/pretrained

The expert drives, and every policy is queried at each of its decisions. The planner and its veto turn the policy's output into a
decision, as in closed loop. Decisions with the same effect on the vehicle (keeping and raising the highest speed) are equal.

- *agreement*: share of decisions that are the expert's, the mean over drives and its standard error;
- *go*, *wait*: the same of those decisions by which the expert speeds up, or drives at its highest speed, and of all others;
- *metres*: how far the distance that a plan drives over the next three decisions is from the expert's, where there are plans;
- *held-out loss*: mean squared error of the clean plan (Eq. 2 with the loss ``clean``) on drives of the expert from new starts, at
  all timesteps alike.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.driving import expert
from ftl_lightning.domains.driving.domain import DOMAIN, POLICIES, Expert
from ftl_lightning.domains.driving.environment import DrivingEnvironment
from ftl_lightning.domains.driving.foresight import VETOES, Beliefs, meaning
from ftl_lightning.domains.driving.scenarios import advance
from ftl_lightning.domains.driving.traffic import MAX_STEPS, STATE, STEP, TRAFFIC, decision_seconds
from ftl_lightning.domains.driving.views import speed
from ftl_lightning.domains.execution import Policy
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.settings import Loss
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.networks.text_encoder import load_encoder
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED, generator
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.concept_model import ConceptModel

SEED = 880
"""Of the drives."""
AHEAD = 3
"""Decisions over which distances are compared."""
SHOWN = ("FASTER", "IDLE", "random", "nearest demonstration", "ridge regression", "MLP regression")


def told_concepts(few: FewShot, name: str, shown: Demonstrations, seed: int, changes: Mapping[str, Any]) -> dict[str, Composition]:
    """A concept that is learned from drives, with changed settings, its text, and the empty concept."""
    model = few.model
    assert isinstance(model, GenerativeModel)
    text = load_encoder("table", DOMAIN.concepts.table, "main")([name])
    return {
        "ours": few.learn(shown, name=name, seed=seed, form="paper", **changes),
        "language": Composition(model.standardise(text)[None], torch.tensor([1.2])),
        "empty concept": Composition(model.empty[None, None], torch.zeros(1)),
    }


@torch.no_grad()
def held_out_loss(model: ConceptModel, concept: Composition, drives: Demonstrations) -> float:
    """Mean squared error of the clean plan, over all decisions of drives."""
    length = drives.lengths - 1  # where a decision is made
    rows = torch.repeat_interleave(torch.arange(len(drives)), length)
    starts = torch.cat([torch.arange(int(count)) for count in length])
    states, observed = drives.windows(rows, starts, model.window)
    draws = model.draws(len(rows), 1.0, generator("cpu", SEED))
    alone = replace(concept, embeddings=concept.embeddings[None], weights=concept.weights[None])
    return float(model.losses(states, observed, alone, draws, Loss(kind="clean")).mean())


def policies(
    few: FewShot, task: str, concepts: Mapping[str, Composition], shown: Demonstrations, starts: InitialStates, seed: int
) -> dict[str, Policy]:
    """What is asked, by name: plans of concepts, and references."""
    model, loop = few.model, DOMAIN.closed_loop
    assert loop is not None
    found: dict[str, Policy] = {}
    for name, concept in concepts.items():
        draws = [generator("cpu", seed, row) for row in range(len(starts))]
        make = sampled_plans(model, [concept] * len(starts), few.tuned.sampling, draws)
        found[name] = PlanFollower(make, planner(model, loop), 1)
    for name in SHOWN:
        policy = POLICIES[name](task, starts, shown, seed)
        assert policy is not None
        found[name] = policy
    return found


Key = tuple[str, int]
"""A policy's name and the seed of its demonstrations."""


def asked(
    task: str, starts: InitialStates, veto: str, told: Mapping[Key, Policy], blind: bool
) -> dict[Key, list[dict[str, float]]]:
    """What each policy would have done at each decision of the expert's drives.

    Returns:
        For each decision the number of its ``drive``, ``go`` (1 or 0), ``agreed``, and ``metres``, the error of the distance.
    """
    count = len(starts)
    environments = [DrivingEnvironment(veto) for _ in range(count)]
    seen = [
        env.reset(options={"scene": scene.numpy()})[0] for env, scene in zip(environments, starts.require_scenes(), strict=True)
    ]
    beliefs = [Beliefs(env.simulation, task) for env in environments]
    draws = [np.random.default_rng([SEED, row]) for row in range(count)]
    found: dict[Key, list[dict[str, float]]] = {name: [] for name in told}
    driven: dict[int, list[float]] = {row: [] for row in range(count)}
    planned: list[tuple[dict[str, float], int, int, float]] = []
    rows, seconds = list(range(count)), decision_seconds(task)
    with bar(f"{count} drives of the expert", MAX_STEPS, lines=False) as moved:
        for step in range(MAX_STEPS):
            moved()
            observed = {name: torch.stack([torch.from_numpy(seen[row][name]) for row in rows]) for name in starts.observed}
            wishes = {name: policy(observed, rows, step) for name, policy in told.items()}
            going = []
            for place, row in enumerate(rows):
                env = environments[row]
                simulation = env.simulation
                if blind:
                    beliefs[row].look()
                    decided = expert.plan_blind(simulation, task, beliefs[row], draws[row])
                else:
                    decided = expert.plan(simulation, task)
                named = simulation.action_type.actions_indexes
                does = meaning(simulation, decided)
                go = does == meaning(simulation, named["FASTER"])
                for name, wish in wishes.items():
                    own = meaning(simulation, env.decide(wish[place].numpy().astype(np.float64)))
                    said = {"drive": row, "go": float(go), "agreed": float(own == does)}
                    found[name].append(said)
                    if isinstance(policy := told[name], PlanFollower):
                        ahead = speed(policy.followed[row][-1][1 : AHEAD + 1])[:, 0]
                        planned.append((said, row, step, float(ahead.sum()) * seconds))
                _, ended = advance(simulation, decided)
                seen[row] = env.observation()
                driven[row].append(float(speed(torch.from_numpy(seen[row][TRAFFIC][:STATE]))[0]) * seconds)
                if not ended:
                    going.append(row)
            rows = going
            if not rows:
                break
    for said, row, step, metres in planned:
        if len(driven[row]) >= step + AHEAD:
            said["metres"] = abs(metres - sum(driven[row][step : step + AHEAD]))
    return found


def summary(said: list[dict[str, float]]) -> dict[str, float]:
    """Agreement, go, wait and metres."""
    drives = sorted({one["drive"] for one in said})
    each = [np.mean([one["agreed"] for one in said if one["drive"] == drive]) for drive in drives]
    kinds = {"go": 1.0, "wait": 0.0}
    shares = {name: [one["agreed"] for one in said if one["go"] == go] for name, go in kinds.items()}
    metres = [one["metres"] for one in said if "metres" in one]
    return {
        "agreement": float(np.mean([one["agreed"] for one in said])),
        "standard error": float(np.std(each, ddof=1) / len(each) ** 0.5),
        **{name: float(np.mean(own)) for name, own in shares.items() if own},
        **({"metres": float(np.mean(metres))} if metres else {}),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", nargs="+", default=["driving"], help="a model for all seeds, or one for each")
    parser.add_argument("--task", default="roundabout third exit")
    parser.add_argument("--concept", help="what the five drives show, if it is another scenario")
    parser.add_argument("--drives", type=int, default=30)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the five demonstrations and of learning")
    parser.add_argument("--veto", choices=tuple(VETOES), default=STEP, help="of the planner")
    parser.add_argument("--blind", action="store_true", help="the expert knows no more than what can be seen")
    parser.add_argument("--learn", type=json.loads, default={}, help="""changed settings of the inversion: '{"off_span": 0.3}'""")
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    if len(options.pretrained) not in (1, len(options.seeds)):
        parser.error(f"--pretrained: expected one model or one for each of {len(options.seeds)} seeds")
    models = [FewShot.from_pretrained(name) for name in options.pretrained]
    of_seed = dict(zip(options.seeds, models if len(models) > 1 else models * len(options.seeds), strict=True))
    learned, expert_drives = options.concept or options.task, Expert(blind=options.blind)
    starts = models[0].starts(options.task, options.drives, SEED)
    others = expert_drives.draw(options.task, options.drives, EVALUATION_SEED + SEED)
    concepts: dict[Key, Composition] = {}
    told: dict[Key, Policy] = {}
    for seed, few in of_seed.items():
        shown = expert_drives.draw(learned, 5, DEMONSTRATION_SEED + seed)
        own = told_concepts(few, learned, shown, seed, options.learn)
        concepts |= {(name, seed): concept for name, concept in own.items()}
        told |= {(name, seed): policy for name, policy in policies(few, options.task, own, shown, starts, seed).items()}
    found: dict[str, list[dict[str, float]]] = {}
    for key, said in asked(options.task, starts, options.veto, told, options.blind).items():
        found.setdefault(key[0], []).append(summary(said))
        if key in concepts:
            found[key[0]][-1]["held-out loss"] = held_out_loss(of_seed[key[1]].model, concepts[key], others)
    content: dict[str, dict[str, object]] = {}
    for name, seeds in found.items():
        means = {key: round(float(np.mean([one[key] for one in seeds])), 3) for key in seeds[0]}
        spread = float(np.std([one["agreement"] for one in seeds], ddof=1)) if len(seeds) > 1 else 0.0
        content[name] = {**means, "spread over seeds": round(spread, 3)}
        if len(models) > 1:
            content[name]["agreement of each model"] = [round(one["agreement"], 3) for one in seeds]
        print(f"{name:24s}", content[name], flush=True)
    if options.out:
        about = {
            "model": ", ".join(few.model.hash for few in models),
            "task": options.task,
            "concept": learned,
            **({"changed": options.learn} if options.learn else {}),
            "drives": options.drives,
            "veto": options.veto,
            "blind expert": options.blind,
            "seeds": options.seeds,
        }
        write_text(options.out, json.dumps(about | {"policies": content}, indent=2) + "\n")


if __name__ == "__main__":
    main()
