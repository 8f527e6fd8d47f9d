"""Verbs for learned concepts: ``invert`` without a trainer, ``concepts``, ``explain``. Imports are local, for a fast start."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.services.errors import about
from ftl_lightning.services.text import line, say
from ftl_lightning.services.validation import LARGEST_STEP, check_count, check_range


@dataclass(frozen=True)
class InvertOptions:
    """Learn the concepts of a file of demonstrations through a pretrained model, without a trainer.

    Concepts and printed quality equal those of "invert --config" for the same file, with the settings of the model's domain.
    Nothing is logged.

    Attributes:
        pretrained: folder of the pretrained model, or the name of a shipped model.
        demonstrations: file of demonstrations (.npz or .safetensors), folder of a LeRobot data set, or name of a Minari data set;
            each of its concepts is learned; demonstrations without a text are one concept named after the file.
        out: folder to write, a file for each concept.
        steps: gradient steps; 0 for those of the settings.
        seed: seed of starts, noise and timesteps.
        form: form of the concepts, such as "paper" or "modes"; empty to select it by leave-one-out error.
        settings: configuration file of invert with settings of learning; empty for that of the domain.
    """

    pretrained: str
    demonstrations: str
    out: str = "concepts"
    steps: int = 0
    seed: int = 0
    form: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        check_count("steps", self.steps, 0, LARGEST_STEP)
        check_range("seed", self.seed, 0)


def invert(options: InvertOptions) -> None:
    """Learn the concepts of the file in ``options`` together, and write each."""
    from ftl_lightning.domains.from_file import read_own
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.igm.library import concept_files, write_concept

    model = FewShot.from_pretrained(options.pretrained, options.settings or None)
    demos = read_own(options.demonstrations)
    with about(options.demonstrations):
        demos = model.demonstrations(demos)
    files = concept_files(demos.concepts, Path(options.out), "out")
    changes = {"form": options.form} if options.form else {}
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", UserWarning)
        learned = model.learn_all(demos, steps=options.steps or None, seed=options.seed, progress=True, **changes)
    for note in notes:
        say("note:", line(str(note.message)), error=True)
    for name, path in files.items():
        write_concept(learned[name].concept, path, learned[name].inspection)


def concepts(pretrained: str, folder: list[str] = [], plain: bool = False) -> None:  # noqa: B006 (never changed)
    """List the concepts of a model: training concepts, one a line, then after an empty line a table of learned concepts.

    The table lists the model's concepts in its folder and in your library, ~/.local/share/ftl-lightning/concepts. Unlisted files
    are reported on standard error.

    Args:
        pretrained: folder of the pretrained model, or the name of a shipped model.
        folder: more folders with learned concepts; may be given several times.
        plain: list the training concepts alone.
    """
    from ftl_lightning.services.shipped import pretrained_folder
    from ftl_lightning.services.validation import check_type
    from ftl_lightning.training.model_config import CONFIG, read_config

    place = pretrained_folder(pretrained)
    content = read_config(place)
    with about(place / CONFIG):
        texts = check_type(content.get("training_concepts"), Sequence[str], "training_concepts")
    if not plain:
        from ftl_lightning.igm.library import library, table

        known = library(content["hash"], texts, place, folder)
    for text in texts:
        say(line(text))
    if plain:
        return
    if known.learned:
        say(f"\n{table(known.learned)}")
    for note in known.notes:
        say(line(note), error=True)


def explain(concept: str, pretrained: str = "", nearest: int = 3) -> None:
    """Explain a learned concept in words: its nearest training concepts and their best non-negative combination.

    Args:
        concept: file of a learned concept.
        pretrained: folder of the concept's model; empty to search pretrained and logs.
        nearest: number of nearest training concepts.
    """
    from ftl_lightning.igm.concept import Concept
    from ftl_lightning.igm.explanation import explain as explained
    from ftl_lightning.igm.explanation import formula
    from ftl_lightning.services.shipped import MODELS
    from ftl_lightning.training.checks import check_concept
    from ftl_lightning.training.model_folder import find_model, load_model

    check_count("nearest", nearest, 1)
    learned = Concept.load(concept)
    model = load_model(pretrained or find_model(learned.origin.pretrained, (Path("pretrained"), Path("logs"), MODELS)))
    check_concept(model, learned, concept)
    names = model.config.training_concepts
    say(f"{learned.origin.name}: learned from {learned.origin.count} demonstrations of {learned.origin.domain}")
    alone, training = (learned.embeddings, learned.weights), model.training_embeddings
    combination = formula(*alone, names, training)
    if learned.composing is not None or combination:
        say(f"combination of training concepts: {combination or formula(*(learned.composing or alone), names, training)}")
    if learned.frames is not None:
        for name, (first, *_, last) in zip(model.config.places, learned.frames.tolist(), strict=True):
            say(f"plans follow {name!r} by {first:.2f} at the beginning and by {last:.2f} at the end")
    if learned.reference is not None:
        say(f"alone, {learned.share:.0%} of its samples are made without the model ({learned.reference.name}); composed, none are")
    if learned.modes is not None:
        how = "a random mixture of them" if learned.modes.mixed else "one of them"
        composed = "composed too" if learned.knots > 1 else "composed, from the components that have no mode"
        say(f"alone it generates from {how}: {len(learned.modes)} modes; {composed}")
    if learned.choice is not None:
        say(f"form: {learned.choice}")
    if learned.composing is not None:
        say("composed it is another set of embeddings, in the span of the training concepts")
    if combination:
        return
    parts = [(f"{name}, weight {part.weight:.2f}", part.embedding) for name, part in learned.parts().items()]
    if len(learned.weights) > 1:
        whole = learned.at_knots(learned.weighted_sum)
        parts += [(f"weighted sum{knot}", embedding) for knot, embedding in whole.items()]
    for name, embedding in parts:
        say(f"{name}: {explained(embedding, names, model.training_embeddings, nearest)}")
