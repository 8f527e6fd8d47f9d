"""Verbs for concepts: ``invert`` without a trainer, ``sample``, ``concepts``, ``explain``. Imports are local, for a fast start."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ftl_lightning.services.errors import about, note, require
from ftl_lightning.services.progress import waiting
from ftl_lightning.services.text import line, say
from ftl_lightning.services.validation import LARGEST_STEP, check_count, check_range

if TYPE_CHECKING:
    from ftl_lightning.data.features import InitialStates
    from ftl_lightning.domains.domain import Domain

MOST_SAMPLES, MOST_DRAWN = 10_000, 1000
"""Maximum number of samples of a command, which are one batch, and of samples in a figure."""
MOST_PARTS = 16  # maximum number of embeddings that are explained


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
    from ftl_lightning.training.model_folder import sampling_command

    model = FewShot.from_pretrained(options.pretrained, options.settings or None)
    demos = read_own(options.demonstrations)
    with about(options.demonstrations):
        demos = model.demonstrations(demos)
    files = concept_files(demos.concepts, Path(options.out), "out")
    for path in filter(Path.exists, files.values()):
        note(f"{path}: is replaced")
    changes = {"form": options.form} if options.form else {}
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", UserWarning)
        learned = model.learn_all(demos, steps=options.steps or None, seed=options.seed, progress=True, **changes)
    for warning in notes:
        say("note:", line(str(warning.message)), error=True)
    for name, path in files.items():
        with waiting(f"{name}: quality of samples"):
            quality = learned[name].inspection
        write_concept(learned[name].concept, path, quality)
    say(f"to sample: {sampling_command(options.pretrained, *next(iter(files.items())), model.domain)}")


@dataclass(frozen=True)
class SampleOptions:
    """Generate behaviour from a learned concept, composed with training concepts.

    Attributes:
        pretrained: folder of the pretrained model, or the name of a shipped model.
        concept: file of a learned concept; empty for training concepts alone.
        compose: concepts to compose with it, with guidance weights: "circle right of square:1.2 + other.safetensors:0.9".
            Training concepts, or learned concepts, whose weights are multiplied, by file or by name in the list of the verb
            concepts. The default weight is 1. "walk@legs:1" restricts a concept to groups of a state's columns, in domains with
            groups.
        count: number of samples.
        seed: seed of the samples.
        sampler: see ftl_lightning.igm.samplers; empty for that of the settings.
        steps: sampler steps; 0 for those of the settings.
        temperature: the paper's alpha; lower is less diverse and more accurate; null for that of the settings.
        goal: judge the samples by this task and print their accuracy. In domains with initial states, new ones of this task are
            drawn from the seed; without a goal, those of the concept's task, or of the first composed text.
        initial: demonstrations file with initial states to use instead; one sample for each.
        out: demonstrations file to write, as for generate.
        figure: picture to write, .png or .svg.
        demonstrations: file of demonstrations to draw above the samples in this picture.
        execute: also execute the concept in closed loop from the same initial states, in domains with an environment, and print
            outcomes.
        replan: steps between plans; 1 in the paper; 0 for that of the settings.
        settings: configuration file of invert with settings of sampling and replanning; empty for that of the domain.
        animation: .gif to write of the first executed episode, or of the first plan, if plans are motion.
        export: file to write each sample to for other programs, in domains with exports: .bvh of human motion, for Blender. Files
            of several samples are numbered: "walk.bvh" becomes walk_0.bvh, walk_1.bvh and so on.
    """

    pretrained: str
    concept: str = ""
    compose: str = ""
    count: int = 50
    seed: int = 0
    sampler: Literal["", "ddpm", "ddim", "dpm_solver"] = ""
    steps: int = 0
    temperature: float | None = None
    goal: str = ""
    initial: str = ""
    out: str = "states.safetensors"
    figure: str = ""
    demonstrations: str = ""
    execute: bool = False
    replan: int = 0
    animation: str = ""
    export: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        for name, path, endings in (("animation", self.animation, (".gif",)), ("figure", self.figure, (".png", ".svg", ".pdf"))):
            valid = not path or Path(path).suffix in endings
            require(valid, name, f"a name that ends in {' or '.join(endings)}", repr(path))
        other = Path(self.concept).suffix not in ("", ".safetensors") and Path(self.concept).is_file()
        advice = f"{self.concept!r}; to learn from demonstrations: python -m ftl_lightning invert MODEL FILE"
        require(not other, "concept", "the file of a learned concept, .safetensors", advice)
        check_range("seed", self.seed, 0)
        check_count("count", self.count, 1, MOST_DRAWN if self.figure else MOST_SAMPLES)
        check_count("steps", self.steps, 0)
        check_count("replan", self.replan, 0)


def sample(options: SampleOptions) -> None:
    """Generate behaviour as in ``options``; write, judge, draw and execute it."""
    with waiting("loading"):
        from ftl_lightning.data.demonstrations import writer
        from ftl_lightning.domains.from_file import read_own
        from ftl_lightning.evaluation.pictures import captioned, gif
        from ftl_lightning.few_shot.learner import FewShot
        from ftl_lightning.services.tensor_file import atomic, write_text
        from ftl_lightning.training.quality import calibration_of

        writer(options.out)  # refuses a format before the work
        model = FewShot.from_pretrained(options.pretrained, options.settings or None)
    compared = model.demonstrations(read_own(options.demonstrations)) if options.demonstrations else None
    text = " + ".join(part for part in (options.compose, options.concept) if part)
    known = model.compose(text) if text else None  # unknown concepts are reported before missing ones
    _check_sample(options, model.domain)
    composition = model.compose(text) if known is None else known
    goal, film = options.goal, model.domain.show.film
    with waiting("sampling"):
        starts = _sample_starts(options, model.domain)
        exported = _export_files(options.export, options.count if starts is None else len(starts))
        count = options.count if starts is None else None
        plans = model.sample(composition, count, starts, seed=options.seed, **_sampling(options))
    provenance = {**plans.provenance, "concept": options.concept, "compose": options.compose}
    plans = replace(plans, concepts=(goal or _named(options),) * len(plans), provenance=provenance)
    plans.save(options.out)
    # Without a configuration of the domain, the settings of invert must be given again.
    say(f"{options.out}: {len(plans)} samples; settings of {model.settings}")
    if (maker := composition.uncomposed.made) is not None:
        say(f"{composition.uncomposed.share:.0%} of the samples are {maker.name}, made without the model")
    for name, value in (model.evaluate(plans, goal) if goal and model.domain.metrics else {}).items():
        calibration = calibration_of(model.judging, goal, name)
        say(f"{name} on '{goal}': {value:.2f}{f' ({calibration})' if calibration else ''}")
    if options.figure:
        with atomic(options.figure) as temporary:
            model.render(plans, goal, compared).savefig(temporary, dpi=110)
        say(options.figure)
    for path, states in zip(exported, plans.states, strict=False):
        write_text(path, model.domain.show.exports[path.suffix](states))
    if exported:
        say(exported[0] if len(exported) == 1 else f"{exported[0]} to {exported[-1].name}")
    if options.execute and starts is not None:
        done = model.execute(composition, starts, goal, replan=options.replan or None, seed=options.seed, **_sampling(options))
        for name, value in done.outcomes.items():
            say(f"closed loop, {name}: {value:.2f}, mean of {len(starts)} episodes")
        if options.animation:
            done.save(options.animation)
    elif options.animation and film:
        with atomic(options.animation) as temporary:
            temporary.write_bytes(gif(captioned(film(plans.states[0]), plans.concepts[0])))
    if options.animation:
        say(options.animation)


def _named(options: SampleOptions) -> str:
    """Text of the samples: the composed texts and the name of the learned concept."""
    from ftl_lightning.igm.concept import Concept

    learned = Concept.load(options.concept).origin.name if options.concept else ""
    return " + ".join(filter(None, (options.compose, learned)))


def _sampling(options: SampleOptions) -> dict[str, Any]:
    """Changes to the configured sampling."""
    changes: dict[str, Any] = {"sampler": options.sampler} if options.sampler else {}
    changes |= {"steps": options.steps} if options.steps else {}
    return changes | ({} if options.temperature is None else {"temperature": options.temperature})


def _check_sample(options: SampleOptions, domain: "Domain") -> None:
    """Refuse options that the domain does not support, before sampling."""
    if options.goal:
        domain.check_goal(options.goal)
    if options.animation and options.execute and domain.closed_loop:
        advice = f"{domain.name}; give its ClosedLoop a film, or draw --figure"
        require(domain.closed_loop.film, "animation", "a domain that films episodes", advice)
    if options.export:
        known = " or ".join(domain.show.exports)
        expected = f"a name that ends in {known}" if known else f"none, as nothing else reads plans of {domain.name}"
        require(Path(options.export).suffix in domain.show.exports, "export", expected, repr(options.export))
    if options.execute:
        require(domain.closed_loop, "execute", "a domain with an environment", f"{domain.name}, which has none")
    if options.execute and domain.closed_loop is not None:
        domain.closed_loop.expect()
    if options.animation and not options.execute:
        expected = f"--execute true (plans of {domain.name} are not filmed)"
        require(domain.show.film, "animation", expected, repr(options.animation))
    expected = f"no file, as models of {domain.name} observe no initial state"
    require(domain.observed or not options.initial, "initial", expected, repr(options.initial))
    if domain.observed:
        expected = f"a task or a demonstrations file to start from (domain {domain.name})"
        require(options.initial or _start_task(options, domain), "goal, initial", expected, "neither")


def _export_files(export: str, count: int) -> list[Path]:
    """A file for each sample, numbered if there are several. Raise UserError before sampling, if an existing path is not a file."""
    from ftl_lightning.services.files import check_file

    if not export:
        return []
    path, digits = Path(export), len(str(count - 1))
    files = [path.with_stem(f"{path.stem}_{number:0{digits}}") for number in range(count)] if count > 1 else [path]
    for file in files:
        check_file(file, "export")
    return files


def _sample_starts(options: SampleOptions, domain: "Domain") -> "InitialStates | None":
    """Initial states of a file's demonstrations or of the goal; ``None`` without observations."""
    if options.initial:
        from ftl_lightning.domains.from_file import read_demonstrations

        return read_demonstrations(options.initial, domain).initial_states
    task = _start_task(options, domain)
    return domain.source(None).starts(task, options.count, options.seed) if domain.observed else None


def _start_task(options: SampleOptions, domain: "Domain") -> str:
    """Task of the initial states; empty without a task that the domain can read."""
    from ftl_lightning.igm.composition import parse_composition
    from ftl_lightning.igm.concept import Concept

    learned = (Concept.load(options.concept).origin.name,) if options.concept and not options.goal else ()
    named = (options.goal, *learned, *(part.concept for part in parse_composition(options.compose)))
    return next((text for text in named if text and domain.concepts.reads(text)), "")


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
    for text in known.notes:
        say(line(text), error=True)


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
    for name, embedding in parts[:MOST_PARTS]:
        say(f"{name}: {explained(embedding, names, model.training_embeddings, nearest)}")
    if rest := parts[MOST_PARTS:]:
        say(f"{len(rest)} more embeddings, of other knots, modes and components")
