"""Distance of generated motion to recordings of people in the features of the judge, beside recordings of other people.

    python benchmarks/experiments/mocap_distances.py --root FOLDER --concepts results/concepts/mocap/seed0 \
        --out results/mocap_distances.json

FOLDER contains recordings prepared by ``prepare mocap``. Each row compares equally many windows with recordings of a concept by
people who did not demonstrate it, and with the distance between the recordings of two people. Walking generated from its text is
compared with recordings of walking, and each person's recordings with those of all others. ``variation`` is the distance between
two samples with the same start, beside that between two recordings of a single person and of two people. The last row is the
accuracy on recordings of a classifier trained on generated motion alone.
"""

import argparse
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance

from ftl_lightning.domains.mocap.domain import begun_elsewhere
from ftl_lightning.domains.mocap.features import extremes
from ftl_lightning.domains.mocap.judge import PARTS, WHOLE, Judge, shipped_judge
from ftl_lightning.domains.mocap.measures import SETTLED
from ftl_lightning.domains.mocap.skeleton import HORIZON, POSE
from ftl_lightning.domains.mocap.source import Recorded, at_rest, pieces
from ftl_lightning.domains.mocap.tasks import DEMONSTRATORS, TESTED, action
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import require
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.checks import check_concept
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

ENOUGH = MOST = 500
"""Windows on each side, where there are as many: above, distances depend more on motion than on the number of windows."""
SAMPLING = Sampling("dpm_solver", 10, 1.0)
"""As conf/sampling/diverse.yaml."""
STARTS, EACH = 20, 10
"""Starts from which variation is measured, and samples from each."""
FEWEST = 50
"""Windows of a person who walks, at least."""
GUIDANCE = 1.2
"""Of training concepts."""


def distances(generated: Tensor, real: Tensor, seed: int, judge: Judge | None = None) -> dict[str, float]:
    """Frechet and kernel distance of two sets of windows ``(sample, 32, 42)`` in the features of the judge, by default the shipped.

    The Frechet distance falls with the number of windows even for equal distributions: compare only rows of equal number. A random
    subset of the larger set, by ``seed``, is compared. A ``UserError`` for a side of fewer than two windows.

    Returns:
        ``fid``, ``kid`` (times 1,000), and ``number`` of windows per side; below :data:`ENOUGH` the Frechet distance means little.
    """
    judge = judge or shipped_judge()
    number = min(len(generated), len(real))
    require(number > 1, "distances of motion", "two windows or more on each side", f"{len(generated)} and {len(real)}")
    draw = torch.Generator().manual_seed(seed)
    sides = {True: real, False: generated}
    chosen = {is_real: windows[torch.randperm(len(windows), generator=draw)[:number]] for is_real, windows in sides.items()}
    values = {}
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore")  # about the memory of features, which are few
        torch.manual_seed(seed)
        frechet = FrechetInceptionDistance(feature=judge)
        kernel = KernelInceptionDistance(feature=judge, subsets=50, subset_size=min(number, ENOUGH))
        for name, metric in (("fid", frechet), ("kid", kernel)):
            for is_real, windows in chosen.items():
                metric.update(windows, real=is_real)
            value = metric.compute()
            values[name] = float(value[0] * 1000 if isinstance(value, tuple) else value)
    return values | {"number": float(number)}


def _mean_distance(features: Tensor, pairs: int, draw: torch.Generator) -> Tensor:
    """Mean distance of random pairs of different rows."""
    first = torch.randint(len(features), (pairs,), generator=draw)
    second = (first + torch.randint(1, len(features), (pairs,), generator=draw)) % len(features)
    return torch.linalg.vector_norm(features[first] - features[second], dim=-1).mean()


def diversity(states: Tensor, seed: int, pairs: int = 200, judge: Judge | None = None) -> float:
    """Mean distance of random pairs of windows ``(sample, 32, 42)`` in the judge's features; a ``UserError`` for fewer than two."""
    require(len(states) > 1, "diversity of motion", "two windows or more", len(states))
    return float(_mean_distance((judge or shipped_judge())(states), pairs, torch.Generator().manual_seed(seed)))


def multimodality(states: Mapping[str, Tensor], seed: int, pairs: int = 20, judge: Judge | None = None) -> float:
    """Mean over goals of :func:`diversity` within a goal, for goals of two windows or more; a ``UserError`` if there is none."""
    draw, judge = torch.Generator().manual_seed(seed), judge or shipped_judge()
    means = [_mean_distance(judge(windows), pairs, draw) for windows in states.values() if len(windows) > 1]
    require(means, "multimodality of motion", "two windows or more of some goal", "none")
    return float(torch.stack(means).mean())


def learned_elsewhere(generated: Mapping[str, Tensor], real: Mapping[str, Tensor]) -> float:
    """Balanced accuracy on real windows of a linear classifier trained on generated windows ``(sample, 32, 42)`` by class.

    A ``UserError`` for different classes, or fewer than two; without scikit-learn.
    """
    check_extra("mocap", "learned_elsewhere")
    from sklearn.linear_model import LogisticRegression  # a second to import

    names = sorted(generated)
    same = names == sorted(real) and len(names) > 1
    both = f"{', '.join(names)} and {', '.join(sorted(real))}"
    require(same, "train on generated, test on real", "the same two classes or more", both)

    def numbers(windows: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        labels = torch.arange(len(names)).repeat_interleave(torch.tensor([len(windows[name]) for name in names]))
        return extremes(torch.cat([windows[name] for name in names]), PARTS[WHOLE][0]), labels

    (inputs, labels), (tested, right) = numbers(generated), numbers(real)
    mean, std = inputs.mean(dim=0), inputs.std(dim=0).clamp_min(0.02)
    classifier = LogisticRegression(C=0.01, max_iter=500).fit(((inputs - mean) / std).clamp(-5, 5).numpy(), labels.numpy())
    predicted = torch.from_numpy(classifier.predict(((tested - mean) / std).clamp(-5, 5).numpy()))
    return float(torch.stack([(predicted[right == index] == index).float().mean() for index in range(len(names))]).mean())


def windows(states: Tensor, stride: int) -> list[Tensor]:
    """All windows as long as a plan of ``(frame, 42)``."""
    return [states[start : start + HORIZON] for start in range(0, len(states) - HORIZON + 1, stride)]


def stretches(source: Recorded, concept: str) -> list[tuple[str, Tensor]]:
    """Who shows a new concept, and a stretch ``(frame, 42)`` in which it is shown."""
    every, found = source.recordings, list[tuple[str, Tensor]]()
    for segment in source.segments:
        if segment.label == concept and segment.trial_id in every.trial_id:
            trial = every.trial_id.index(segment.trial_id)
            states = every.trial(trial)[segment.start : segment.stop]
            found += [(every.subject[trial], piece) for piece in pieces(states, longest=None)]
    return found


def shown_by(source: Recorded, concept: str, demonstrators: bool) -> list[Tensor]:
    """Those of people who demonstrate it, or of others."""
    return [states for subject, states in stretches(source, concept) if (subject in DEMONSTRATORS) == demonstrators]


def recorded(source: Recorded, concept: str, demonstrators: bool) -> Tensor:
    """Windows ``(window, 32, 42)`` of a new concept by those who demonstrate it, or by others."""
    found = [window for states in shown_by(source, concept, demonstrators) for window in windows(states, 1)]
    return torch.stack(found) if found else torch.zeros(0, HORIZON, 42)


def beginnings(source: Recorded, concept: str, demonstrators: bool) -> Tensor:
    """Of these, those that start nearest to rest, as demonstrations do."""
    parts = shown_by(source, concept, demonstrators)
    return torch.stack([states[start : start + HORIZON] for states in parts for start in at_rest(states)])


def actions(source: Recorded, stride: int) -> dict[str, Tensor]:
    """Windows of the training concepts' trials by the judge's action, of those that are tested."""
    found: dict[str, list[Tensor]] = {}
    training = source.split("train", 0, 0)
    half = len(training) // 2  # the others are mirror images
    for states, length, text in zip(training.states[:half], training.lengths[:half].tolist(), training.concepts, strict=False):
        if (name := action(text)) in TESTED:
            found.setdefault(name, []).extend(windows(states[:length], stride))
    return {name: torch.stack(own) for name, own in found.items()}


def generated(model: ConceptModel, composition: Composition, starts: Tensor, seed: int) -> Tensor:
    """A window from each start."""
    return model.sample([composition], len(starts), SAMPLING, [generator("cpu", seed)], {POSE: starts})[0]


def said(model: ConceptModel, *texts: str) -> Composition:
    """Training concepts; of none, whatever the model generates."""
    embeddings = torch.stack([model.concept(text) for text in texts])[:, None] if texts else model.empty[None, None]
    return Composition(embeddings, torch.full((len(embeddings),), GUIDANCE if texts else 0.0))


def variation(model: ConceptModel, composition: Composition, starts: Tensor, seed: int) -> float:
    """How far samples from one start are from their mean: metres, root mean square over samples, joints and frames.

    Of frames that no longer come from the start, see :data:`~ftl_lightning.domains.mocap.measures.SETTLED`.
    """
    each = starts[:STARTS].repeat_interleave(EACH, dim=0)
    return spread(generated(model, composition, each, seed).unflatten(0, (-1, EACH)))


def spread(windows: Tensor) -> float:
    """The same of windows ``(..., sample, 32, 42)``."""
    far = windows[..., SETTLED:, :] - windows[..., SETTLED:, :].mean(dim=-3, keepdim=True)
    share = windows.shape[-3] / (windows.shape[-3] - 1)
    return float((3 * share * far.square().mean()).sqrt())  # three coordinates of a joint


def walking(source: Recorded, model: ConceptModel, seed: int) -> dict[str, object]:
    """Distances of walking by its text to recordings of people who walk, and of each person's recordings to all others'."""
    training = source.split("train", 0, 0)
    half = len(training) // 2
    subjects = [str(trial).split("_")[0] for trial in training.provenance["trials"][:half]]
    by_subject: dict[str, list[Tensor]] = {}
    for row, subject in enumerate(subjects):
        if training.concepts[row] == "walk":
            by_subject.setdefault(subject, []).extend(windows(training.states[row, : int(training.lengths[row])], 4))
    every = {subject: torch.stack(own) for subject, own in by_subject.items() if len(own) >= FEWEST}
    starts = source.starts("walk", MOST, seed).observed[POSE]
    made = generated(model, said(model, "walk"), starts, seed)
    rows: dict[str, object] = {"text: walk": distances(made, torch.cat(list(every.values())), seed)}
    for subject, own in every.items():
        others = torch.cat([windows for other, windows in every.items() if other != subject])
        rows[f"recordings of {subject}, against all others"] = distances(own, others, seed)
    return rows


def table(
    source: Recorded, model: ConceptModel, folders: Mapping[str, Sequence[Path]], concept: str, seed: int
) -> tuple[dict[str, object], dict[str, float]]:
    """Each row's distances to recordings of people who did not demonstrate a concept; each row's variation in metres."""
    real, shown = recorded(source, concept, False), recorded(source, concept, True)
    number = min(MOST, len(real), len(shown))
    starts = source.starts(concept, number, seed).observed[POSE]
    turns = torch.arange(number)
    demonstrations = source.draw(concept, 5, seed).states
    many = demonstrations[torch.arange(4 * number) % len(demonstrations)]
    begun, _ = begun_elsewhere(many, {POSE: many[:, 0]}, generator("cpu", seed))
    rows = {
        "recordings of the demonstrators": shown,
        "demonstrations replayed": demonstrations[turns % len(demonstrations)],
        "demonstrations begun in other poses": begun[(begun[:, 0] != many[:, 0]).any(dim=1)][:number],
        "frozen frame": starts[:, None].repeat(1, HORIZON, 1),
        "unconditional": generated(model, said(model), starts, seed),
        "text: walk": generated(model, said(model, "walk"), starts, seed),
    }
    own, others = (beginnings(source, concept, demonstrators) for demonstrators in (True, False))
    varied = {"recordings of the demonstrators": spread(own), "recordings of both": spread(torch.cat([own, others]))}
    varied["text: walk"] = variation(model, said(model, "walk"), starts, seed)
    for name, places in folders.items():
        for place in places:
            path = place / f"{concept.replace(' ', '_')}.safetensors"
            learned = Concept.load(path)
            check_concept(model, learned, path)
            row = name if len(places) == 1 else f"{name}, {place.name}"
            rows[row] = generated(model, learned.composition, starts, seed)
            varied[row] = variation(model, learned.composition, starts, seed)
    halves = {**distances(real[::2], real[1::2], seed), "diversity": diversity(real, seed)}
    found: dict[str, dict[str, float]] = {
        name: {**distances(own, real, seed), "diversity": diversity(own, seed)} for name, own in rows.items()
    }
    between = found["recordings of the demonstrators"]["kid"]
    over = {name: {**row, "kid over that between people": row["kid"] / between} for name, row in found.items()}
    return {"recordings of the others, half against half": halves, **over}, varied


def second_opinion(source: Recorded, model: ConceptModel, seed: int, number: int = 100) -> dict[str, object]:
    """Balanced accuracy on recordings of a classifier that has learned from generated motion of training concepts."""
    real = actions(source, 8)
    texts = {name: [text for text in model.config.training_concepts if action(text) == name] for name in real}
    starts = source.starts("walk", number, seed).observed[POSE]
    made = {}
    for index, (name, own) in enumerate(texts.items()):
        parts = [generated(model, said(model, text), starts[row :: len(own)], seed + index) for row, text in enumerate(own)]
        made[name] = torch.cat(parts)
    return {
        "actions": sorted(real),
        "learned from generated, tested on recordings": learned_elsewhere(made, real),
        "multimodality": multimodality(made, seed),
        "multimodality of recordings": multimodality(real, seed),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="recordings, as `prepare mocap` leaves them")
    parser.add_argument("--pretrained", default="pretrained/mocap")
    parser.add_argument("--concepts", type=Path, nargs="*", default=[], help="folders of learned concepts")
    parser.add_argument("--adapters", type=Path, nargs="*", default=[], help="folders of concepts with an adapter")
    parser.add_argument("--tasks", nargs="*", default=["jumping jacks", "arm circle"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None)
    chosen = parser.parse_args(arguments)
    source, model = Recorded(chosen.root), load_model(chosen.pretrained)
    folders = {"ours": chosen.concepts, "ours with adapter": chosen.adapters}
    found: dict[str, object] = {"model": model.hash, "seed": chosen.seed}
    variations: dict[str, dict[str, float]] = {}
    with bar("concepts", len(chosen.tasks) + 1) as advance:
        for concept in chosen.tasks:
            found[concept], variations[concept] = table(source, model, folders, concept, chosen.seed)
            advance()
        found["variation"] = variations
        found["walk"] = walking(source, model, chosen.seed)
        found["second opinion"] = second_opinion(source, model, chosen.seed)
        advance()
    text = json.dumps(found, indent=1) + "\n"
    print(text)
    if chosen.out is not None:
        write_text(chosen.out, text)


if __name__ == "__main__":
    main()
