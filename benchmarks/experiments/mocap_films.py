"""Make films of human motion for raters and the study page: ours, with an adapter, by text, demonstrations, other people.

    python benchmarks/experiments/mocap_films.py --root FOLDER --out FOLDER2

FOLDER holds recordings, FOLDER2 is the user's: windows of recordings are written there, and so it may not be within the project.
Films are files ``films/CONDITION/CONCEPT.safetensors`` of as many rows each; the page is ``study/study.html``, see docs/study.md.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from mocap_distances import GUIDANCE, recorded
from torch import Tensor

from ftl_lightning.cli.pages import StudyOptions, study
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap.domain import DOMAIN
from ftl_lightning.domains.mocap.skeleton import COLUMNS, NAME
from ftl_lightning.domains.mocap.source import Recorded
from ftl_lightning.domains.mocap.tasks import TEST_CONCEPTS
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.networks.text_encoder import TableEncoder
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.validation import check_count
from ftl_lightning.training.concept_model import TextConceptModel

PROJECT = Path(__file__).resolve().parents[2]
CONCEPTS = PROJECT / "results" / "concepts"
OURS, ADAPTED, TEXT, DEMONSTRATED, PEOPLE = "ours", "ours with adapter", "text", "demonstrations", "people"
"""Conditions: names of folders, of methods in the key and in the table of answers."""
NEAREST = "nearest"


def nearest_text(model: FewShot, concept: str) -> str:
    """The training concept whose embedding is nearest to that of a new concept's words."""
    assert isinstance(model.model, TextConceptModel)
    assert DOMAIN.concepts.table is not None
    words = model.model.standardise(TableEncoder(DOMAIN.concepts.table)([concept]))
    alike = torch.nn.functional.cosine_similarity(model.model.training_embeddings, words)
    return model.training_concepts[int(alike.argmax())]


def spread(windows: Tensor, count: int) -> Tensor:
    """So many of windows ``(window, 32, 42)``, at even distances; some twice where there are too few."""
    return windows[torch.linspace(0, len(windows) - 1, count).round().long()]


def filmed(states: Tensor, concept: str, condition: str) -> Demonstrations:
    """Behaviour ``(row, 32, 42)`` as a file that ``study`` reads."""
    count, frames, _ = states.shape
    units, told = ("m",) * len(COLUMNS), {"generator": condition}
    return Demonstrations(states, torch.full((count,), frames), NAME, COLUMNS, units, (concept,) * count, provenance=told)


def films(options: argparse.Namespace, concept: str, model: FewShot, source: Recorded) -> dict[str, Tensor]:
    """States ``(count, 32, 42)`` of each condition; none of :data:`PEOPLE` where only demonstrators show the concept.

    All that is generated starts from the same new poses.
    """
    count, name = options.count, f"{concept.replace(' ', '_')}.safetensors"
    starts = source.starts(concept, count, EVALUATION_SEED + options.seed)
    ours, adapted = (model.load(folder / name) for folder in (options.concepts, options.adapters))
    text = nearest_text(model, concept) if options.text == NEAREST else options.text
    told, origin = GUIDANCE * model[text], ours.concept.origin
    demonstrations = source.draw(concept, origin.count, DEMONSTRATION_SEED + options.seed)
    if demonstrations.hash != origin.demonstrations:
        print(f"{concept}: drawn demonstrations are not those that {options.concepts / name} was learned from; see --seed")
    print(f"{concept}: text is {text!r}")
    made = {OURS: ours, ADAPTED: adapted, TEXT: told}
    others = recorded(source, concept, demonstrators=False)
    return {
        **{condition: model.sample(one, observed=starts, seed=options.seed).states for condition, one in made.items()},
        DEMONSTRATED: demonstrations.states[torch.arange(count) % len(demonstrations)],
        PEOPLE: spread(others, count) if len(others) else others,
    }


def write(options: argparse.Namespace) -> None:
    """Films of all conditions, and the page.

    Raises:
        UserError: for a target within the project, and for what cannot be read or made.
    """
    check_count("count", options.count, 1)
    check_count("scenarios", options.scenarios, 1, options.count)
    if options.out.resolve().is_relative_to(PROJECT):
        raise UserError(f"out: expected a folder outside the project, as recordings are written to it, found {options.out}")
    if (options.out / "films").exists():
        raise UserError(f"out: expected a folder without films, which may be those of another page, found some in {options.out}")
    model, source = FewShot.from_pretrained(options.pretrained), Recorded(options.root)
    made = {concept: films(options, concept, model, source) for concept in TEST_CONCEPTS}
    if alone := [concept for concept in made if not len(made[concept][PEOPLE])]:
        print(f"no condition {PEOPLE!r}: nobody but the demonstrators shows {', '.join(alone)} in {options.root}")
    for concept, conditions in made.items():
        name = f"{concept.replace(' ', '_')}.safetensors"
        for condition in conditions.keys() - ({PEOPLE} if alone else set()):
            filmed(conditions[condition], concept, condition).save(options.out / "films" / condition / name)
    study(StudyOptions(NAME, str(options.out / "films"), str(options.out / "study"), options.scenarios, seed=options.seed))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder outside the project for films and page")
    parser.add_argument("--count", type=int, default=10, help="films of each condition and concept")
    parser.add_argument("--scenarios", type=int, default=3, help="of these, how many of each the page shows")
    parser.add_argument("--pretrained", default=NAME, help="model")
    parser.add_argument("--concepts", type=Path, default=CONCEPTS / "mocap" / "seed0", help="folder of learned concepts")
    parser.add_argument("--adapters", type=Path, default=CONCEPTS / "mocap_adapter" / "seed0", help="the same with adapters")
    parser.add_argument("--text", default=NEAREST, help="training concept such as walk; by default the nearest to each new one")
    parser.add_argument("--seed", type=int, default=0)
    try:
        write(parser.parse_args(arguments))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
