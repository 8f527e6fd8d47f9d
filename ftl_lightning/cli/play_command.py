"""The verbs ``play`` and ``view``. Imports are local, so that the program starts at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ftl_lightning.services.ranges import check_range

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
        from ftl_lightning.services.errors import UserError

        check_range("port", self.port, 0, LARGEST_PORT)
        if self.pairs and not self.static:
            raise UserError("pairs: expected --static FOLDER beside it, found none")
        if bad := [pair for pair in self.pairs if len(pair.split(" + ")) != 2]:
            raise UserError(f"pairs: expected two concepts each, such as 'walk + run', found {bad[0]!r}")


def play(options: PlayOptions) -> None:
    """Serve the page until Ctrl-C."""
    from ftl_lightning.services.extras import check_extra
    from ftl_lightning.services.shipped import shipped_models

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
    from ftl_lightning.services.printing import say
    from ftl_lightning.services.progress import bar

    if workspace.work()["demonstrations"]:
        workspace.learn(Learn(workspace.suggestion), lambda progress: None, lambda: False)
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
    """Serve the page until Ctrl-C."""
    from ftl_lightning.services.extras import check_extra

    check_extra("play", "view: its server")
    from ftl_lightning.apps.play.application import reading, viewing
    from ftl_lightning.apps.play.page import holds_results, results_page, viewed
    from ftl_lightning.apps.play.server import Place, serve

    results = holds_results(options.file)
    routes = reading(results_page(options.file)) if results else viewing(viewed(options.file, options.pretrained))
    serve(routes, Place(options.host, options.port, options.browser))
