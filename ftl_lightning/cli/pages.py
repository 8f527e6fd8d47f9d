"""Verbs for pages: ``play``, ``view``, ``study``, ``study-report``. Imports are local, for a fast start."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ftl_lightning.services.errors import require
from ftl_lightning.services.text import say
from ftl_lightning.services.validation import check_count, check_range

if TYPE_CHECKING:
    from ftl_lightning.apps.play.workspace import Workspace


LARGEST_PORT = 65_535


@dataclass(frozen=True)
class PlayOptions:
    """Show behaviour five times on a page, see it learned, and mix it with other concepts.

    Attributes:
        pretrained: model to open first: the name of a shipped model, or a folder.
        demonstrations: file of initial demonstrations.
        root: folder of your copy of recordings, for domains whose demonstrations do not ship.
        static: folder for a page that needs no program, in place of serving a page: the demonstrations, the concept learned from
            them, and samples for a grid of weights.
        pairs: pairs of concepts mixed on such a page, such as ["walk + jumping_jacks", "walk + run"]; empty for a default choice.
        host: address to listen on. With "0.0.0.0" a phone in the same network can open the page, and so can everybody there who
            knows the address.
        port: port of the address; 0 for 8765, or any free port if that is in use.
        browser: open the page in a browser.
    """

    pretrained: str = "strokes"
    demonstrations: str = ""
    root: str = ""
    static: str = ""
    pairs: list[str] = field(default_factory=list)
    host: str = "127.0.0.1"
    port: int = 0
    browser: bool = True

    def __post_init__(self) -> None:
        check_range("port", self.port, 0, LARGEST_PORT)
        require(self.static or not self.pairs, "pairs", "--static FOLDER beside it", "none")
        for pair in self.pairs:
            require(pair.count(" + ") == 1, "pairs", "two concepts each, such as 'walk + run'", repr(pair))


def play(options: PlayOptions) -> None:
    """Serve the page of ``options`` until Ctrl-C, or write it to a file."""
    from ftl_lightning.services.shipped import check_extra, shipped_models

    check_extra("play", "play: its server")
    from ftl_lightning.apps.play.application import Desk, playing
    from ftl_lightning.apps.play.server import Place, serve

    def workspace(model: str) -> "Workspace":
        from ftl_lightning.apps.play.workspace import Workspace

        initial = model == options.pretrained
        opened = Workspace(model, Path(options.root) if options.root and initial else None)
        if options.demonstrations and initial:
            opened.upload(options.demonstrations, Path(options.demonstrations).read_bytes())
        return opened

    if options.static:
        path = Path(options.static) / f"{Path(options.pretrained).name}.html"
        pairs = [(first, second) for first, second in (pair.split(" + ") for pair in options.pairs)]
        _write_static(workspace(options.pretrained), path, pairs)
        return
    desk = Desk(list(dict.fromkeys((options.pretrained, *shipped_models()))), workspace)
    place = Place(options.host, options.port, options.browser)
    serve(playing(desk), place, lambda: desk.work(desk.state), desk.ended.set)


def _write_static(workspace: "Workspace", path: Path, pairs: "list[tuple[str, str]]") -> None:
    from ftl_lightning.apps.play.page import PAIRS, WEIGHTS, write_offline
    from ftl_lightning.apps.play.requests import Learn
    from ftl_lightning.services.progress import bar

    if workspace.work()["demonstrations"]:
        told: list[Any] = []
        workspace.learn(Learn(workspace.suggestion), told.append, lambda: False)
        if told[-1]["more"]:
            workspace.learn(Learn(again=told[-1]["concept"]["id"]), told.append, lambda: False)
    with bar(f"{path.name}: mixes", (len(pairs) or PAIRS) * len(WEIGHTS) ** 2) as advance:
        size = write_offline(workspace, path, pairs, lambda: advance(1, ""))
    say(f"{path}: {size / 1e6:.1f} MB")


@dataclass(frozen=True)
class ViewOptions:
    """Watch a file on a page: demonstrations, samples, a learned concept, or results.

    Attributes:
        file: demonstrations or samples (.npz, .safetensors, a Minari or LeRobot data set), a learned concept, or results (.csv, or
            a folder of such files).
        pretrained: model of a learned concept; empty to search for it in pretrained and logs.
        host: address to listen on, see play.
        port: port of the address, see play.
        browser: open the page in a browser.
    """

    file: str
    pretrained: str = ""
    host: str = "127.0.0.1"
    port: int = 0
    browser: bool = True

    def __post_init__(self) -> None:
        check_range("port", self.port, 0, LARGEST_PORT)


def view(options: ViewOptions) -> None:
    """Serve the page of ``options`` until Ctrl-C."""
    from ftl_lightning.services.shipped import check_extra

    check_extra("play", "view: its server")
    from ftl_lightning.apps.play.application import reading, viewing
    from ftl_lightning.apps.play.page import holds_results, results_page, viewed
    from ftl_lightning.apps.play.server import Place, serve

    results = holds_results(options.file)
    routes = reading(results_page(options.file)) if results else viewing(viewed(options.file, options.pretrained))
    serve(routes, Place(options.host, options.port, options.browser))


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
    from ftl_lightning.services.files import read_text

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

    require(answers, "answers", "files that raters saved", "none; run: study-report study/answers*.json")
    first = Path(answers[0])
    beside = (first if first.is_dir() else first.parent) / "key.json"
    result = study_table([Path(name) for name in answers], Path(key) if key else beside, all_raters)
    for refusal in (*(f"refused: {refusal}" for refusal in result.refused), *result.dropped):
        say(refusal, error=True)
    show(result.table())
    say("\n".join(NOTES))
