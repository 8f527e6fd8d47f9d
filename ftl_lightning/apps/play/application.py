"""Routes of the page's server, and the handlers of its requests."""

import asyncio
import json
import secrets
import threading
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Any, TypeVar
from urllib.parse import quote, unquote

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.page import POLICY, page
from ftl_lightning.apps.play.server import body_of, message_of
from ftl_lightning.apps.play.workspace import Stopped, Workspace, title_of
from ftl_lightning.domains.recorder import MOST_STEPS
from ftl_lightning.services.errors import require, short
from ftl_lightning.services.validation import from_mapping, parse_json

MOST_BODY, MOST_RECORDED, MOST_FILE = 2**16, 2 * 2**20, 64 * 2**20
"""Maximum bytes of a request, of a recorded demonstration, and of an uploaded file."""
MOST_VALUES, MOST_LISTS = 5 * MOST_STEPS, 3 * MOST_STEPS  # maximum numbers of commas and of lists in a request
MOST_LARGE = 2  # maximum number of recorded demonstrations and files that are received and parsed at a time
MODEL = "x-model"  # header with the name of the model, percent-encoded, in every request but those without an opened model
MOST_WAITING = 32  # maximum number of pending requests; further requests are refused
WAIT = 0.5  # seconds between checks whether the client still waits for learning
SERVED = "; connect-src 'self'; frame-ancestors 'none'"
"""Addition to the policy of every page: a served page may send requests to this server."""

T = TypeVar("T")
Handler = tuple[type, Callable[[Workspace, Any], Any]]
ANSWERS: Mapping[str, Handler] = {
    "scene": (requests.Pose, Workspace.scene),
    "record": (requests.Recorded, Workspace.record),
    "draw": (requests.Drawn, Workspace.draw),
    "remove": (requests.One, Workspace.remove),
    "undo": (requests.Nothing, Workspace.undo),
    "clear": (requests.Nothing, Workspace.clear),
    "restore": (requests.Named, Workspace.restore),
    "sample": (requests.Sample, Workspace.sample),
}
"""Type of the JSON body and handler of requests that are answered by the handler's result."""
CHANGES: Mapping[str, Handler] = {"forget": (requests.Named, Workspace.forget), "rename": (requests.Renamed, Workspace.rename)}
"""The same of requests that are answered by the whole state of the page."""


class Desk:
    """Workspaces of the opened models. Requests are handled in the workspace of the model that they name, one at a time.

    Args:
        models, make: names of models that can be opened, the initial model first; and creates the workspace of a model, in a
            thread.
    """

    def __init__(self, models: Sequence[str], make: Callable[[str], Workspace]) -> None:
        self._models, self._make = tuple(models), make
        self._opened: dict[str, Workspace] = {}
        self._current = self._models[0]
        self._lock, self._waiting = asyncio.Lock(), 0
        self.large = asyncio.Semaphore(MOST_LARGE)
        self.ended = threading.Event()

    async def work(self, do: Callable[[Workspace], Any], model: str = "") -> Any:
        """Call a function with the workspace of an opened model, by default the one opened last, in a thread. Raise UserError for a
        model that is not open, and HTTPException if too many requests are pending.
        """
        if self._waiting >= MOST_WAITING:
            raise HTTPException(429, "too many questions at a time; wait for an answer")
        self._waiting += 1
        try:
            async with self._lock:
                return await asyncio.to_thread(lambda: do(self._named(model)))
        finally:
            self._waiting -= 1

    @property
    def asked(self) -> bool:
        """Whether further requests wait for the present one."""
        return self._waiting > 1

    async def others(self) -> None:
        """Handle the requests that wait, in the middle of the present one."""
        self._lock.release()
        await self._lock.acquire()

    def _named(self, model: str) -> Workspace:
        if not model:
            return self._workspace(self._current)
        found = f"{short(model)!r}; open it first, or reload the page"
        require(model in self._opened, "model", f"one that is open ({short(', '.join(self._opened), 120) or 'none'})", found)
        return self._opened[model]

    def _workspace(self, model: str) -> Workspace:
        if model not in self._opened:
            self._opened[model] = self._make(model)
        return self._opened[model]

    def open(self, model: str) -> dict[str, Any]:
        """Open a model, and keep the workspaces of the others. Raise UserError for a model that cannot be opened."""
        require(model in self._models, "model", f"one of {', '.join(self._models)}", short(model))
        workspace = self._workspace(model)
        self._current = model
        return self.state(workspace)

    def state(self, workspace: Workspace) -> dict[str, Any]:
        """Initial state of the page."""
        return workspace.state() | {"models": [{"name": name, "title": title_of(name)} for name in self._models]}


async def first_page(request: Request) -> Response:
    """The page itself, which requests its content afterwards."""
    nonce = secrets.token_urlsafe(16)
    return HTMLResponse(page(nonce), headers={"content-security-policy": POLICY.format(nonce=nonce) + SERVED})


def viewing(shown: Mapping[str, Any]) -> list[Route]:
    """Routes of a page with a fixed state, the answer to ``/api/state``."""

    async def state(request: Request) -> Response:
        return JSONResponse(shown)

    return [Route("/", first_page), Route("/api/state", state)]


def reading(text: str) -> list[Route]:
    """Routes of a complete page without requests."""

    async def whole(request: Request) -> Response:
        return HTMLResponse(text)  # contains its policy

    return [Route("/", whole)]


def playing(desk: Desk) -> list[Route]:
    """Routes of the page for demonstrating, learning and mixing."""

    async def state(request: Request) -> Response:
        # The first request of a page names no model.
        return JSONResponse(await desk.work(desk.state, _model(request) if MODEL in request.headers else ""))

    async def opened(request: Request) -> Response:
        body = await _body(desk, request, requests.Open)
        return JSONResponse(await desk.work(lambda _: desk.open(body.model)))

    async def thumbnail(request: Request) -> Response:
        key = request.query_params.get("id", "")
        return JSONResponse(await desk.work(lambda workspace: workspace.thumbnail(key), _model(request)))

    def downloading(name: str, do: Callable[[Workspace, str], tuple[str, bytes]]) -> Route:
        async def download(request: Request) -> Response:
            key = request.query_params.get("id", "")
            file, content = await desk.work(lambda workspace: do(workspace, key), _model(request))
            headers = {"content-disposition": f"attachment; filename*=UTF-8''{quote(file, safe='')}"}
            return Response(content, media_type="application/octet-stream", headers=headers)

        return Route(f"/api/{name}", download)

    async def upload(request: Request) -> Response:
        name, model = request.query_params.get("name", ""), _model(request)
        async with desk.large:
            content = await body_of(request, MOST_FILE)
            await desk.work(lambda workspace: workspace.upload(name, content), model)
        return JSONResponse(await desk.work(desk.state, model))

    def answering(name: str, kind: type, do: Callable[[Workspace, Any], Any]) -> Route:
        async def answer(request: Request) -> Response:
            model, body = _model(request), await _body(desk, request, kind)
            result = await desk.work(lambda workspace: do(workspace, body), model)
            return JSONResponse(await desk.work(desk.state, model) if name in CHANGES else result)

        return Route(f"/api/{name}", answer, methods=["POST"])

    async def learn(request: Request) -> Response:
        model, body = _model(request), await _body(desk, request, requests.Learn)
        return StreamingResponse(_learned(desk, request, model, body), media_type="application/x-ndjson")

    return [
        Route("/", first_page),
        Route("/api/state", state),
        Route("/api/thumbnail", thumbnail),
        downloading("concept", Workspace.concept_file),
        downloading("demonstrations", Workspace.demonstrations_file),
        *(answering(name, *handler) for name, handler in {**ANSWERS, **CHANGES}.items()),
        Route("/api/open", opened, methods=["POST"]),
        Route("/api/upload", upload, methods=["POST"]),
        Route("/api/learn", learn, methods=["POST"]),
    ]


def _model(request: Request) -> str:
    """Name of the model of a request. Raise UserError if there is none, or several."""
    named = request.headers.getlist(MODEL)
    require(len(named) == 1 and named[0], MODEL, "the name of the model", f"{len(named) or 'none'}; reload the page")
    return unquote(named[0])


async def _body(desk: Desk, request: Request, kind: Callable[..., T]) -> T:
    """Read a request from JSON, in a thread: large texts take long to parse."""

    def parsed(content: bytes) -> T:
        for sign, most, what in ((b",", MOST_VALUES, "values"), (b"[", MOST_LISTS, "lists")):
            require(content.count(sign) <= most, "question", f"at most {most:,} {what}", f"{content.count(sign):,}")
        return from_mapping(kind, parse_json(content, "a question in JSON"), "")

    if kind is not requests.Recorded:
        return await asyncio.to_thread(parsed, await body_of(request, MOST_BODY))
    async with desk.large:
        return await asyncio.to_thread(parsed, await body_of(request, MOST_RECORDED))


async def _learned(desk: Desk, request: Request, model: str, body: requests.Learn) -> AsyncIterator[str]:
    """Progress of learning as JSON lines, until learning ends or the client disconnects.

    Other requests are handled while a concept is learned again, which takes long.
    """
    loop, lines = asyncio.get_running_loop(), asyncio.Queue[dict[str, Any] | None]()
    stopped = threading.Event()

    def tell(message: Mapping[str, Any] | None) -> None:
        loop.call_soon_threadsafe(lines.put_nowait, None if message is None else dict(message))

    def ended() -> bool:
        if body.again and desk.asked:
            asyncio.run_coroutine_threadsafe(desk.others(), loop).result()
        return stopped.is_set() or desk.ended.is_set()

    async def work() -> None:
        try:
            await desk.work(lambda workspace: workspace.learn(body, tell, ended), model)
        except Stopped:
            pass
        except HTTPException as error:
            tell({"error": error.detail})
        except Exception as error:
            tell({"error": message_of(error)})
        finally:
            tell(None)

    working = asyncio.create_task(work())
    try:
        while True:
            try:
                message = await asyncio.wait_for(lines.get(), WAIT)
            except TimeoutError:
                if await request.is_disconnected():
                    return
                continue
            if message is None:
                return
            yield json.dumps(message) + "\n"
            if await request.is_disconnected():
                return
    finally:
        stopped.set()
        await asyncio.shield(working)
