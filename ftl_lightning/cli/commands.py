"""Verbs without a trainer: typed functions with local imports, for a fast start."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.services.printing import line, say
from ftl_lightning.services.ranges import check_count, check_range

MOST_DEMONSTRATIONS, MOST_WORKERS = 1_000_000, 1000
"""Maximum number of demonstrations drawn by a command, and of worker processes."""


def generate(
    domain: str,
    task: str = "",
    count: int = 100,
    seed: int = 0,
    workers: int = 1,
    out: str = "demonstrations.safetensors",
    root: str = "",
) -> None:
    """Draw demonstrations of a task into a file.

    Args:
        domain: name of a domain.
        task: in words, for example "circle right of square and triangle above square"; empty for every training concept.
        count: number of demonstrations of the task, or of each training concept.
        seed: the same seed gives the same bytes.
        workers: number of processes, in domains with a slow expert; a stopped run is resumed.
        out: file to write (.safetensors or .npz), or "minari:NAME" for a Minari data set (the extra "minari"), such as
            "minari:strokes/test-v0", or "lerobot:FOLDER" for a LeRobot data set (the extra "lerobot").
        root: folder of your copy of the data, for domains whose demonstrations do not ship.
    """
    from ftl_lightning.domains.registry import load_domain

    check_count("count", count, 1, MOST_DEMONSTRATIONS)
    check_range("seed", seed, 0)
    check_count("workers", workers, 1, MOST_WORKERS)
    loaded = load_domain(domain)
    source = loaded.source(Path(root) if root else None)
    try:
        demonstrations = source.draw(task, count, seed, workers) if task else source.split("train", count, seed)
    except (KeyError, ValueError, IndexError):  # a source that does not check the text itself
        if task:
            loaded.check_goal(task, "task")
        raise
    demonstrations.save(out)
    say(f"{out}: {len(demonstrations)} demonstrations of {task or f'{len(loaded.concepts.training)} training concepts'}")


def encode(domain: str, encoder: str = "minilm", revision: str = "main", out: str = "") -> None:
    """Make a domain's table of concept embeddings with a language model.

    Args:
        domain: name of a domain.
        encoder: "minilm" (the extra), or the name or path of a T5 or BERT-like model.
        revision: revision of a Hugging Face model.
        out: file to write; empty for the table that ships with the domain.

    Raises:
        UserError: without a file, for a domain without a table.
    """
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.networks.text_encoder import load_encoder, write_table
    from ftl_lightning.services.errors import UserError

    concepts = load_domain(domain).concepts
    if not out and concepts.table is None:
        raise UserError(f"out: expected a file to write, found none: domain {domain} names no table of its own")
    path = Path(out) if out else Path(str(concepts.table))
    write_table(path, load_encoder(encoder, concepts.table, revision), concepts.descriptions)
    say(path)


def prepare(domain: str, root: str = "", out: str = "") -> None:
    """Convert your copy of a domain's recordings, which do not ship, to the file of the domain.

    Args:
        domain: name of a domain.
        root: folder of your copy; nothing is downloaded.
        out: folder to write; empty for the same folder.

    Raises:
        UserError: for a domain whose demonstrations need no preparation.
    """
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.services.errors import UserError

    loaded = load_domain(domain)
    if loaded.recordings.prepare is None:
        raise UserError(f"domain: expected one whose recordings are prepared, found {domain!r}, which needs nothing of the kind")
    say(loaded.recordings.prepare(Path(root) if root else None, Path(out) if out else None))


def concepts(pretrained: str, folder: list[str] = [], plain: bool = False) -> None:  # noqa: B006 (never changed)
    """List the concepts of a model: training concepts, one a line, then after an empty line a table of learned concepts.

    The table lists the model's concepts in its folder and in your library, ~/.local/share/ftl-lightning/concepts. Unlisted files
    are reported on standard error.

    Args:
        pretrained: folder of the pretrained model, or the name of a shipped model.
        folder: more folders with learned concepts; may be given several times.
        plain: list the training concepts alone.
    """
    from ftl_lightning.services.errors import about
    from ftl_lightning.services.schema import check_type
    from ftl_lightning.services.shipped import pretrained_folder
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
    from ftl_lightning.services.shipped import MODELS
    from ftl_lightning.training.checks import check_concept
    from ftl_lightning.training.model_folder import find_model, load_model

    check_count("nearest", nearest, 1)
    learned = Concept.load(concept)
    model = load_model(pretrained or find_model(learned.origin.pretrained, (Path("pretrained"), Path("logs"), MODELS)))
    check_concept(model, learned, concept)
    names = model.config.training_concepts
    say(f"{learned.origin.name}: learned from {learned.origin.count} demonstrations of {learned.origin.domain}")
    if learned.modes is not None:
        how = "a random mixture of them" if learned.modes.mixed else "one of them"
        composed = "composed too" if learned.knots > 1 else "composed, from the components that have no mode"
        say(f"alone it generates from {how}: {len(learned.modes)} modes; {composed}")
    if learned.choice is not None:
        say(f"form: {learned.choice}")
    if learned.composing is not None:
        say("composed it is another set of embeddings, in the span of the training concepts")
    parts = [(f"{name}, weight {part.weight:.2f}", part.embedding) for name, part in learned.parts().items()]
    if len(learned.weights) > 1:
        whole = learned.at_knots(learned.weighted_sum)
        parts += [(f"weighted sum{knot}", embedding) for knot, embedding in whole.items()]
    for name, embedding in parts:
        say(f"{name}: {explained(embedding, names, model.training_embeddings, nearest)}")


def report(results: str = "results", out: str = "results/report", readme: str = "", html: str = "") -> None:
    """Make tables and figures from results, with the paper's numbers; or an HTML page.

    Args:
        results: a results file, or a folder of results files.
        out: folder for Markdown, LaTeX and figures.
        readme: a Markdown file to update between its marks.
        html: HTML file to write instead: overview, films, concepts and curves, without a network.
    """
    if html:
        from ftl_lightning.reporting.page import write_page

        say(f"{html}: {write_page(Path(results), Path(html)) / 1e6:.1f} MB")
        return
    from ftl_lightning.reporting.report import write_report

    say(write_report(Path(results), Path(out), Path(readme) if readme else None))
    say(f"written to {out}")


@dataclass(frozen=True)
class StudyOptions:
    """Make a web page in which people rate films of generated behaviour.

    Attributes:
        domain: name of a domain with filmed plans.
        films: folder with files METHOD/CONCEPT.safetensors of "sample --out", or with films.json, a list of
            {"concept", "method", "file"} and optionally "scenario", "setting" and "row".
        out: folder for study.html, for the raters, and key.json, which stays with you.
        scenarios: number of scenarios for each concept, drawn from the samples in all methods' files.
        repeats: attention checks: number of questions that are asked twice.
        still: attention checks: number of films without motion.
        seed: seed of the films' numbers and of the shown and repeated films.
        title: title of the page; empty for a neutral title.
        consent: text file that raters agree to, in place of the default text.
    """

    domain: str
    films: str = "films"
    out: str = "study"
    scenarios: int = 1
    repeats: int = 2
    still: int = 1
    seed: int = 0
    title: str = ""
    consent: str = ""

    def __post_init__(self) -> None:
        check_range("seed", self.seed, 0)
        for name, least in (("scenarios", 1), ("repeats", 0), ("still", 0)):
            check_count(name, getattr(self, name), least)


def study(options: StudyOptions) -> None:
    """Make the page and its key from ``options``."""
    from ftl_lightning.apps.study.page import make_study
    from ftl_lightning.apps.study.questions import ask, read_films
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.services.limits import read_text

    words = read_text(options.consent, "text") if options.consent else ""
    domain = load_domain(options.domain)
    films = read_films(Path(options.films), domain, options.scenarios, options.seed)
    made = make_study(domain, ask(films, options.repeats, options.still, options.seed), Path(options.out), options.title, words)
    say(f"{made.page}: {made.films} films, {made.questions} questions, {made.size / 1000:.0f} kB; it goes to the raters")
    say(f"{made.key}: says which film is whose; it stays with you")


def study_report(answers: list[str] = [], key: str = "", all_raters: bool = False) -> None:  # noqa: B006 (never changed)
    """Print the table of a study's answers: study-report study/answers*.json.

    Args:
        answers: files saved by raters, or folders of files answers*.json.
        key: the study's key; empty for key.json beside the first file.
        all_raters: also count raters who failed attention checks.

    Raises:
        UserError: without files, or for a file that is not a rater's.
    """
    from ftl_lightning.apps.study.report import NOTES, study_table
    from ftl_lightning.evaluation.summary import show
    from ftl_lightning.services.errors import UserError

    if not answers:
        raise UserError("answers: expected files that raters saved, found none; run: study-report study/answers*.json")
    first = Path(answers[0])
    beside = (first if first.is_dir() else first.parent) / "key.json"
    result = study_table([Path(name) for name in answers], Path(key) if key else beside, all_raters)
    for refusal in (*(f"refused: {refusal}" for refusal in result.refused), *result.dropped):
        say(refusal, error=True)
    show(result.table())
    say("\n".join(NOTES))
