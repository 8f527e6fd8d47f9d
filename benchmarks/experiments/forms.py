"""Accuracy of every parametrisation of a concept and of the automatic choice, learned from five demonstrations.

For every new kind of every family of ``benchmarks/experiments/families.py``, a concept is learned in each form and in the chosen
form. Fifty samples are classified by a rule unknown to the method and compared with fifty fresh samples of the generator: spread
(standard deviation), novelty (distance to the nearest demonstration) and roughness (second differences), relative to those of the
fresh samples. Columns are scaled by their standard deviation in pretraining (relations: in fresh scenes; pictures: unscaled). Then
pairs of learned relations are composed. Models of users' data are pretrained first and saved in ``--folder``.

    python benchmarks/experiments/forms.py --out results/forms.json --figure docs/left_out.png
"""

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from families import FAMILIES, KEPT, RULES, Family
from numpy.typing import NDArray

from ftl_lightning.cli.main import main as ftl_lightning
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.choice import ALL
from ftl_lightning.igm.forms.quality import roughness
from ftl_lightning.igm.settings import ADAPTED, AUTO, MIXED, MODES, ONE
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parents[2]
FEW, SAMPLES, PRETRAINING = 5, 50, 80
SPAN, FRESH = "one set in the span", "fresh behaviour"
PAIRS = (
    ("triangle antidiagonal to square", "circle above square"),
    ("triangle antidiagonal to square", "circle right of triangle"),
    ("square antidiagonal to circle", "triangle above square"),
    ("circle right of square", "triangle above square"),
    ("circle in the corner", "square above triangle"),
    ("mirrored", "triangle above circle"),
    ("triangle midway", "circle right of square"),
)
"""Learned, and composed with weights 1 and 0.8."""

Numbers = dict[str, float]
Kinds = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By kind, seed and form numbers; under ``choice`` what the choice says."""


def pretrained(name: str, family: Family, folder: Path) -> FewShot:
    """The family's model; pretrained with ``conf/own.yaml`` where there is none yet."""
    if family.pretrained:
        return FewShot.from_pretrained(family.pretrained)
    place = folder.absolute() / name
    if not (place / "pretrained" / "config.json").exists():
        place.mkdir(parents=True, exist_ok=True)
        states = np.concatenate([family.draw(kind, PRETRAINING, 1) for kind in family.training])
        np.savez(place / "training.npz", states=states, concepts=np.repeat(list(family.training), PRETRAINING))
        with chdir(place):
            options = ["--data.demonstrations=training.npz", "--model.output=pretrained", "--trainer.accelerator=cpu"]
            if ftl_lightning(["fit", "--config", str(ROOT / "conf" / "own.yaml"), *options]):
                raise SystemExit(f"{name}: fit failed")
    return FewShot.from_pretrained(place / "pretrained")


def scale_of(family: Family, fresh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of each column, which it is measured in."""
    if fresh.shape[1] == 1 and family.training:
        return np.ones(fresh.shape[2], dtype=np.float32)
    seen = [family.draw(kind, PRETRAINING, 1) for kind in family.training]
    scale = np.concatenate(seen or [fresh]).reshape(-1, fresh.shape[2]).std(axis=0)
    return np.where(scale > 0, scale, 1).astype(np.float32)


def compared(
    samples: NDArray[np.float32], known: NDArray[np.float32], fresh: NDArray[np.float32], scale: NDArray[np.float32]
) -> Numbers:
    """Spread, novelty and roughness of samples as shares of those of fresh behaviour, columns in the given units."""
    one, other, base = (torch.from_numpy(np.asarray(some / scale)).float() for some in (samples, fresh, known))

    def novelty(some: torch.Tensor) -> float:
        return float(torch.cdist(some.flatten(1), base.flatten(1)).amin(dim=1).mean())

    found = {"spread": float((one.var(dim=0).sum() / other.var(dim=0).sum()).sqrt()), "novelty": novelty(one) / novelty(other)}
    return found | ({"roughness": float(roughness(one) / roughness(other))} if one.shape[1] > 2 else {})


def reference(
    family: Family, kind: str, known: NDArray[np.float32], fresh: NDArray[np.float32], scale: NDArray[np.float32]
) -> Numbers:
    """The same numbers of behaviour that is drawn once more."""
    again = family.draw(kind, SAMPLES, 3_000_000)
    numbers = {"recognised": float(family.recognised(again, kind).mean()), **compared(again, known, fresh, scale)}
    return {key: round(value, 4) for key, value in numbers.items()}


def forms_of(model: FewShot, states: NDArray[np.float32], name: str, seed: int) -> dict[str, LearnedConcept]:
    """The concept in every form."""
    mixed = model.learn(states, name=name, seed=seed, form=MIXED)
    return {
        ONE: model.learn(states, name=name, seed=seed, form=ONE),
        SPAN: model.learn(states, name=name, seed=seed, form=ONE, off_span=0.0),
        MODES: model.learn(states, name=name, seed=seed, form=MODES),
        ADAPTED: model._learned(replace(mixed.concept, modes=None)),
        MIXED: mixed,
        AUTO: model.learn(states, name=name, seed=seed, form=AUTO),
    }


def run_family(name: str, seeds: Sequence[int], folder: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """By kind, seed and form what samples are like; under ``choice`` what the choice says."""
    family = FAMILIES[name]
    model = pretrained(name, family, folder)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in family.new:
        fresh = family.draw(kind, SAMPLES, 2_000_000)
        scale = scale_of(family, fresh)
        for seed in seeds:
            known = family.draw(kind, FEW, 1_000_000 + seed)
            entry: dict[str, Any] = {FRESH: reference(family, kind, known, fresh, scale)}
            for form, concept in forms_of(model, known, kind, seed).items():
                samples = model.sample(concept, SAMPLES, seed=seed).states.numpy()
                numbers = {"recognised": float(family.recognised(samples, kind).mean()), **compared(samples, known, fresh, scale)}
                entry[form] = {key: round(value, 4) for key, value in numbers.items()}
                if form == AUTO and (choice := concept.concept.choice) is not None:
                    entry["choice"] = {
                        "form": choice.form,
                        **choice.numbers,
                        "composed in span": concept.concept.composing is not None,
                    }
            found.setdefault(kind, {})[str(seed)] = entry
            print(name, kind, seed, entry["choice"], entry[AUTO], flush=True)
    return found


def run_pairs(seeds: Sequence[int]) -> dict[str, dict[str, float]]:
    """Shares of scenes in which both of two learned relations hold, by pair and seed, in the chosen form and in the paper's."""
    model = FewShot.from_pretrained("object_rearrangement")
    source, family = model.domain.source(None), FAMILIES["relations"]
    found: dict[str, dict[str, float]] = {}
    for seed in seeds:
        for form in (AUTO, ONE):
            known = {}
            for text in dict.fromkeys(text for pair in PAIRS for text in pair):
                own = text in RULES
                drawn = family.draw(text, FEW, 500 + seed) if own else source.draw(text, FEW, 500 + seed).states.numpy()
                known[text] = model.learn(drawn, name=text, seed=seed, form=form)
            for first, second in PAIRS:
                plans = model.sample(known[first] + 0.8 * known[second], SAMPLES, seed=seed)
                right = np.ones(SAMPLES, dtype=bool)
                for text in (first, second):
                    if text in RULES:
                        right &= family.recognised(plans.states.numpy(), text)
                    else:
                        right &= model.domain.measure(text, plans.states, None)["accuracy"].numpy() > 0.5
                found.setdefault(f"{first} + 0.8 {second}", {})[f"{form}, seed {seed}"] = round(float(right.mean()), 4)
        print({pair: list(values.values()) for pair, values in found.items()}, flush=True)
    return found


def summary(families: Mapping[str, Kinds]) -> dict[str, dict[str, Numbers]]:
    """Means by family and form, and the least recognised kind."""
    found: dict[str, dict[str, Numbers]] = {}
    for name, kinds in families.items():
        entries = [entry for seeds in kinds.values() for entry in seeds.values()]
        for form in (ONE, SPAN, MODES, ADAPTED, MIXED, AUTO, FRESH):
            rows: list[Numbers] = [entry[form] for entry in entries]
            means = {key: round(float(np.mean([row[key] for row in rows])), 3) for key in rows[0]}
            means |= {"least recognised": min(row["recognised"] for row in rows)}
            means |= {"largest roughness": max(row["roughness"] for row in rows)} if "roughness" in rows[0] else {}
            found.setdefault(name, {})[form] = means | {"least spread": min(row["spread"] for row in rows)}
    return found


LOSSES = ("loss, own", "loss, left out", "loss, left out, in span")
PREDICTED = {ONE: LOSSES[1:2], SPAN: LOSSES[2:], ADAPTED: LOSSES}
"""Losses, shares of the unconditional loss, whose sum is to tell how many samples of a form are right."""


def points(kinds: Kinds) -> dict[str, list[list[float]]]:
    """The sum of losses and the share of samples that are right, by form: a pair for each concept and seed."""
    found: dict[str, list[list[float]]] = {form: [] for form in PREDICTED}
    for seeds in kinds.values():
        for entry in seeds.values():
            for form, losses in PREDICTED.items():
                found[form].append([sum(entry["choice"][name] for name in losses), entry[form]["recognised"]])
    return found


def rank_correlation(pairs: Sequence[Sequence[float]]) -> float:
    """Spearman's, ties at their mean rank."""
    import pandas as pd

    ranks = pd.DataFrame(pairs).rank().to_numpy()
    return round(float(np.corrcoef(ranks.T)[0, 1]), 3)


def draw(found: Mapping[str, list[list[float]]], path: str) -> None:
    """The points, by form."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3), layout="constrained")
    for axes, (form, pairs) in zip(figure.subplots(1, 3, sharey=True), found.items(), strict=True):
        axes.plot(*np.array(pairs).T, "o", alpha=0.6)
        axes.set_title(f"{form}: rank correlation {rank_correlation(pairs):.2f}", fontsize=9)
        axes.set(xlabel=" + ".join(name.removeprefix("loss, ") for name in PREDICTED[form]), ylim=(-0.05, 1.05))
        axes.axvline(1 if len(PREDICTED[form]) == 1 else ALL, color="grey", linewidth=0.8)
    figure.axes[0].set_ylabel("samples that are right")
    figure.supxlabel("loss / unconditional loss", fontsize=9)
    figure.savefig(path, dpi=120)


def page(content: Mapping[str, Any]) -> str:
    """The tables of the documentation, in Markdown."""
    told = ["| family | form | recognised (least) | spread (least) | novelty | roughness (largest) |", "|---|---|---|---|---|---|"]
    for family, forms in content["summary"].items():
        for form, one in forms.items():
            rough = f"{one['roughness']:.2f} ({one['largest roughness']:.2f})" if "roughness" in one else "-"
            told.append(
                f"| {family} | {'chosen' if form == AUTO else form} | {one['recognised']:.2f} ({one['least recognised']:.2f}) "
                f"| {one['spread']:.2f} ({one['least spread']:.2f}) | {one['novelty']:.2f} | {rough} |"
            )
    if relations := content["families"].get("relations"):
        lost = ["", "| relation | own | left out | in span | forms chosen |", "|---|---|---|---|---|"]
        judged = ["", "| relation | right: one set | adapter | modes | chosen | novelty |", "|---|---|---|---|---|---|"]
        for kind, seeds in relations.items():
            entries = list(seeds.values())
            losses = [np.mean([entry["choice"][name] for entry in entries]) for name in LOSSES]
            right = [np.mean([entry[form]["recognised"] for entry in entries]) for form in (ONE, ADAPTED, MODES, AUTO)]
            new = np.mean([entry[AUTO]["novelty"] for entry in entries])
            chosen = ", ".join(entry["choice"]["form"] for entry in entries)
            lost.append(f"| {kind} | {' | '.join(f'{value:.2f}' for value in losses)} | {chosen} |")
            judged.append(f"| {kind} | {' | '.join(f'{value:.2f}' for value in (*right, new))} |")
        told += [*lost, *judged]
        ranks = content["rank correlation, relations"]
        told += ["", "| form | losses whose sum is to tell | rank correlation with the share of right samples |", "|---|---|---|"]
        told += [f"| {form} | {'; '.join(PREDICTED[form])} | {value:.2f} |" for form, value in ranks.items()]
    if "pairs" in content:
        told += ["", "| learned + 0.8 learned | form chosen, mean (least) | one set, mean (least) |", "|---|---|---|"]
        for pair, found in content["pairs"].items():
            rates = [[value for key, value in found.items() if key.startswith(form)] for form in (AUTO, ONE)]
            told.append(f"| {pair} | {' | '.join(f'{np.mean(some):.2f} ({min(some):.2f})' for some in rates)} |")
    return "\n".join(told) + "\n"


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="*", default=[name for name in FAMILIES if name not in KEPT], choices=list(FAMILIES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--pairs", type=int, nargs="*", default=[0, 1, 2], help="seeds of the pairs")
    parser.add_argument("--folder", type=Path, default=Path("logs/forms"), help="of pretrained models")
    parser.add_argument("--out", type=Path, help="a file that is there keeps what this run does not measure")
    parser.add_argument("--figure", type=str)
    options = parser.parse_args()
    content = json.loads(options.out.read_text("utf-8")) if options.out and options.out.exists() else {}
    families = content.get("families", {})
    for name in options.families:
        families[name] = run_family(name, options.seeds, options.folder)
        _write(options.out, content, families)
    if options.pairs:
        content["pairs"] = run_pairs(options.pairs)
    _write(options.out, content, families)
    if options.figure and "relations" in families:
        draw(points(families["relations"]), options.figure)


def _write(out: Path | None, content: dict[str, Any], families: dict[str, Any]) -> None:
    """The numbers, and the documentation's tables of them beside it."""
    content["summary"], content["families"] = summary(families), families
    if "relations" in families:
        found = points(families["relations"])
        content["rank correlation, relations"] = {form: rank_correlation(pairs) for form, pairs in found.items()}
    print(json.dumps(content["summary"], indent=2))
    if out:
        write_text(out, json.dumps(content, indent=2, sort_keys=False) + os.linesep)
        write_text(out.with_suffix(".md"), page(content))


if __name__ == "__main__":
    main()
