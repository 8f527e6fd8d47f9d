"""Detection rate and false alarms of ``check`` for faulty demonstrations among five.

Sets of five demonstrations of a concept are drawn from pools. The last demonstration has a single fault, which is detected if a
warning names the demonstration. With models, the last demonstration shows another concept, and concepts are learned from all but
one demonstration (leave-one-out); the outlier is detected if it is named.

    python benchmarks/experiments/check.py --out results/check.json
"""

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from families import FAMILIES
from forms import pretrained

from ftl_lightning.apps.benchmark.strokes import NEW, TRAINING, strokes
from ftl_lightning.data.check import check
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

FEW, POOL = 5, 12
"""Demonstrations of a set, and of each kind that sets are taken from."""
Draw = Callable[[str, int, int], Demonstrations]
"""``(kind, count, seed)``."""


def _strokes(kind: str, count: int, seed: int) -> Demonstrations:
    states = torch.from_numpy(strokes(kind, count, seed)).float()
    return Demonstrations(states, torch.full((count,), states.shape[1]), "", ("x", "y"), ("", ""), (kind,) * count)


def _spoilt(good: Demonstrations, other: Demonstrations) -> dict[str, Demonstrations]:
    """The last demonstration in each wrong way that its length allows; the kind ``'good'`` is as it was."""
    last, length = len(good) - 1, int(good.lengths[-1])
    span = good.states[:-1].flatten(0, 1).amax(dim=0) - good.states[:-1].flatten(0, 1).amin(dim=0)

    def changed(values: torch.Tensor) -> Demonstrations:
        states = good.states.clone()
        states[last] = values
        return replace(good, states=states)

    own = good.states[last]
    found = {"good": good, "units 100 times as large": changed(100 * own)}
    found["copied from the first"] = good.rows([*range(last), 0])
    found["of another concept"] = concatenate([good.rows(range(last)), replace(other, concepts=good.concepts[-1:])])
    if length >= 8:
        half, still, cut, third = own.clone(), own.clone(), own.clone(), 2 * length // 3
        half[length // 2 :] += 0.5 * span
        still[length // 3 : third] = own[length // 3]
        cut[third:] = own[third - 1]
        lengths = good.lengths.clone()
        lengths[last] = third
        found |= {"a jump of half the range": changed(half), "still for a third": changed(still)}
        found["last third missing"] = replace(changed(cut), lengths=lengths)
    return found


def faults(draw: Draw, kinds: tuple[str, ...], sets: int) -> dict[str, float]:
    """Shares of sets in which a warning names the last demonstration, by what is wrong with it; of good sets, any warning."""
    counts: dict[str, list[bool]] = {}
    pools = {kind: draw(kind, POOL, 0) for kind in kinds}
    with bar("checking", sets) as advance:
        for number in range(sets):
            kind, another = kinds[number % len(kinds)], kinds[(number + 1) % len(kinds)]
            chosen = torch.randperm(POOL, generator=torch.Generator().manual_seed(number))
            good, other = pools[kind].rows(chosen[:FEW].tolist()), pools[another].rows(chosen[-1:].tolist())
            for name, spoilt in _spoilt(good, other).items():
                warned = [finding for finding in check(spoilt) if finding.severity != "note"]
                named = warned if name == "good" else [finding for finding in warned if FEW - 1 in finding.rows]
                counts.setdefault(name, []).append(bool(named))
            advance(1)
    return {name: round(sum(values) / len(values), 4) for name, values in counts.items()}


def outlier(model: FewShot, draw: Draw, kinds: tuple[str, ...], sets: int) -> dict[str, float]:
    """Shares of sets in which the demonstration of another concept is named, another one is, and any one of a good set is."""
    found, wrong, blamed = 0, 0, 0
    for number in range(sets):
        kind, another = kinds[number % len(kinds)], kinds[(number + 1) % len(kinds)]
        good = draw(kind, FEW, number)
        mixed = concatenate([good.rows(range(FEW - 1)), replace(draw(another, 1, 10_000 + number), concepts=(kind,))])
        for demonstrations, expected in ((mixed, FEW - 1), (good, None)):
            left = model.check(demonstrations, name=kind, learn=True).left_out
            named = left.outlier if left is not None else None
            found += expected is not None and named == expected
            wrong += expected is not None and named not in (None, expected)
            blamed += expected is None and named is not None
    return {name: round(count / sets, 4) for name, count in (("found", found), ("another named", wrong), ("good set", blamed))}


def _arrays(draw: Callable[[str, int, int], object], model: FewShot) -> Draw:
    return lambda kind, count, seed: model.demonstrations(draw(kind, count, seed), name=kind)  # type: ignore[arg-type]


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument("--learned", type=int, default=12, help="sets of which a concept is learned")
    parser.add_argument("--domains", nargs="*", default=["object_rearrangement", "agent", "driving", "tabletop"])
    parser.add_argument("--root", type=Path, help="recordings of human motion, to check those, too")
    parser.add_argument(
        "--folder", type=Path, default=Path("logs/forms"), help="of models that benchmarks/experiments/forms.py pretrained"
    )
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result: dict[str, Mapping[str, Mapping[str, float]]] = {}
    found = {"strokes": faults(_strokes, (*TRAINING, *NEW), options.sets)}
    print(found, flush=True)
    for name in options.domains + (["mocap"] if options.root else []):
        domain = load_domain(name)
        source = domain.source(options.root if name == "mocap" else None)
        found[name] = faults(source.draw, domain.concepts.training, options.sets)
        print(name, found[name], flush=True)
    result["faults"] = found
    if options.learned:
        learned = {}
        for name in ("relations", "paths"):
            family = FAMILIES[name]
            model = pretrained(name, family, options.folder)
            learned[name] = outlier(model, _arrays(family.draw, model), tuple(family.new), options.learned)
        result["outlier, after learning"] = learned
    text = json.dumps(result, indent=2)
    print(text)
    if options.out:
        write_text(options.out, text + "\n")


if __name__ == "__main__":
    main()
