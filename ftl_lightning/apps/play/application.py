"""Routes of the page's server, and the handlers of its requests."""

import asyncio
import json
import secrets
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.guard import Guard, body_of
from ftl_lightning.apps.play.page import POLICY, page
from ftl_lightning.apps.play.workspace import Stopped, Workspace
from ftl_lightning.services.errors import UserError, mistake_of_machine, short
from ftl_lightning.services.text import line, say
from ftl_lightning.services.validation import from_mapping, parse_json

MOST_ASKED, MOST_OPENED = 4 * 2**20, 64 * 2**20
"""Maximum bytes of a request, and of an uploaded file."""
MOST_WAITING = 32
"""Maximum number of pending requests; further requests are refused."""
WAIT = 0.5
"""Seconds between checks whether the client still waits for learning."""
SERVED = "; connect-src 'self'; frame-ancestors 'none'"
"""Addition to the policy of every page: a served page may send requests to this server."""

ANSWERS: Mapping[str, tuple[type, Callable[[Workspace, Any], Any]]] = {
    "scene": (requests.Pose, Workspace.scene),
    "record": (requests.Recorded, Workspace.record),
    "draw": (requests.Drawn, Workspace.draw),
    "remove": (requests.One, Workspace.remove),
    "undo": (requests.Nothing, Workspace.undo),
    "clear": (requests.Nothing, Workspace.clear),
    "sample": (requests.Sample, Workspace.sample),
}
"""Type and handler of requests with a JSON body."""

MISTAKES = (
    UserError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Exceptions that are reported in one line; the server continues."""


class Desk:
    """Workspaces of the opened models. Requests are handled in the current workspace, one at a time.

    Args:
        models: names of models that can be opened; the first is the initial model.
        make: creates the workspace of a model; called in a thread.
    """

    def __init__(self, models: Sequence[str], make: Callable[[str], Workspace]) -> None:
        self._models, self._make = tuple(models), make
        self._opened: dict[str, Workspace] = {}
        self._now = self._models[0]
        self._lock, self._waiting = asyncio.Lock(), 0
        self.ended = threading.Event()

    async def work(self, do: Callable[[Workspace], Any]) -> Any:
        """Call a function with the current workspace, in a thread.

        Raises:
            HTTPException: if too many requests are pending.
        """
        if self._waiting >= MOST_WAITING:
            raise HTTPException(429, "too many questions at a time; wait for an answer")
        self._waiting += 1
        try:
            async with self._lock:
                return await asyncio.to_thread(lambda: do(self._workspace(self._now)))
        finally:
            self._waiting -= 1

    def _workspace(self, model: str) -> Workspace:
        if model not in self._opened:
            self._opened[model] = self._make(model)
        return self._opened[model]

    def open(self, model: str) -> dict[str, Any]:
        """Switch to another model; the workspace of the previous model is kept.

        Raises:
            UserError: for a model that cannot be opened.
        """
        if model not in self._models:
            raise UserError(f"model: expected one of {', '.join(self._models)}, found {short(model)!r}")
        workspace = self._workspace(model)
        self._now = model
        return self.state(workspace)

    def state(self, workspace: Workspace) -> dict[str, Any]:
        """Initial state of the page."""
        return workspace.state() | {"models": [{"name": name, "title": _title(name)} for name in self._models]}


def _title(model: str) -> str:
    return model.rpartition("/")[2].replace("_", " ")


Begin = Callable[[], Awaitable[Any]]


def guarded(
    routes: Sequence[Route],
    token: str,
    hosts: Sequence[str],
    end: Callable[[], None],
    begin: Begin | None = None,
) -> Starlette:
    """Application that answers requests of a single page.

    Args:
        routes: routes besides the end of the program.
        token: required in requests.
        hosts: ``host:port`` that requests may name.
        end: ends the program.
        begin: run at the start, while requests are already answered; ``None`` for nothing.
    """

    async def ended(request: Request) -> Response:
        asyncio.get_running_loop().call_later(WAIT / 2, end)
        return JSONResponse({"ended": True})

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        beginning = asyncio.ensure_future(begin()) if begin is not None else None
        yield
        if beginning is not None:
            beginning.cancel()

    every = [*routes, Route("/api/end", ended, methods=["POST"])]
    handlers: Any = {HTTPException: _refused, **dict.fromkeys(MISTAKES, _mistaken)}
    application = Starlette(routes=every, exception_handlers=handlers, lifespan=lifespan)
    application.add_middleware(Guard, token=token, hosts=frozenset(hosts))
    return application


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
        return JSONResponse(await desk.work(desk.state))

    async def opened(request: Request) -> Response:
        body = from_mapping(requests.Open, await _body(request), "")
        return JSONResponse(await desk.work(lambda _: desk.open(body.model)))

    async def thumbnail(request: Request) -> Response:
        return JSONResponse(await desk.work(lambda workspace: workspace.thumbnail(_id(request))))

    async def concept(request: Request) -> Response:
        return _attached(*await desk.work(lambda workspace: workspace.concept_file(_id(request))))

    async def demonstrations(request: Request) -> Response:
        return _attached(*await desk.work(lambda workspace: workspace.demonstrations_file(_id(request))))

    async def upload(request: Request) -> Response:
        name, content = request.query_params.get("name", ""), await body_of(request, MOST_OPENED)
        await desk.work(lambda workspace: workspace.upload(name, content))
        return JSONResponse(await desk.work(desk.state))

    async def forget(request: Request) -> Response:
        body = from_mapping(requests.Named, await _body(request), "")
        await desk.work(lambda workspace: workspace.forget(body))
        return JSONResponse(await desk.work(desk.state))

    async def rename(request: Request) -> Response:
        body = from_mapping(requests.Renamed, await _body(request), "")
        await desk.work(lambda workspace: workspace.rename(body))
        return JSONResponse(await desk.work(desk.state))

    async def learn(request: Request) -> Response:
        body = from_mapping(requests.Learn, await _body(request), "")
        return StreamingResponse(_learned(desk, request, body), media_type="application/x-ndjson")

    return [
        Route("/", first_page),
        Route("/api/state", state),
        Route("/api/thumbnail", thumbnail),
        Route("/api/concept", concept),
        Route("/api/demonstrations", demonstrations),
        *(Route(f"/api/{name}", _answering(desk, name), methods=["POST"]) for name in ANSWERS),
        Route("/api/open", opened, methods=["POST"]),
        Route("/api/upload", upload, methods=["POST"]),
        Route("/api/forget", forget, methods=["POST"]),
        Route("/api/rename", rename, methods=["POST"]),
        Route("/api/learn", learn, methods=["POST"]),
    ]


def _answering(desk: Desk, name: str) -> Callable[[Request], Any]:
    kind, do = ANSWERS[name]

    async def answer(request: Request) -> Response:
        body = from_mapping(kind, await _body(request), "")
        return JSONResponse(await desk.work(lambda workspace: do(workspace, body)))

    return answer


def _id(request: Request) -> str:
    return request.query_params.get("id", "")


async def _body(request: Request) -> Any:
    return parse_json(await body_of(request, MOST_ASKED), "a question in JSON")


def _attached(name: str, content: bytes) -> Response:
    disposition = f"attachment; filename*=UTF-8''{quote(name, safe='')}"
    return Response(content, media_type="application/octet-stream", headers={"content-disposition": disposition})


async def _learned(desk: Desk, request: Request, body: requests.Learn) -> AsyncIterator[str]:
    """Progress of learning as JSON lines, until learning ends or the client disconnects."""
    loop, lines = asyncio.get_running_loop(), asyncio.Queue[dict[str, Any] | None]()
    stopped = threading.Event()

    def tell(message: Mapping[str, Any] | None) -> None:
        loop.call_soon_threadsafe(lines.put_nowait, None if message is None else dict(message))

    async def work() -> None:
        try:
            await desk.work(lambda workspace: workspace.learn(body, tell, lambda: stopped.is_set() or desk.ended.is_set()))
        except Stopped:
            pass
        except HTTPException as error:
            tell({"error": error.detail})
        except Exception as error:
            tell({"error": _one_line(error)})
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


def _one_line(error: Exception) -> str:
    """Message of an error for the user; failures of the program are printed as well."""
    if isinstance(error, UserError):
        return line(str(error))
    if (message := mistake_of_machine(error)) is not None:
        return line(message)
    say(f"error: {type(error).__name__}: {error}", error=True)
    return f"the program failed ({type(error).__name__}); what it printed says more"


async def _refused(request: Request, error: Exception) -> Response:
    status, detail = (error.status_code, error.detail) if isinstance(error, HTTPException) else (400, "broken off")
    return JSONResponse({"error": line(str(detail))}, status)


async def _mistaken(request: Request, error: Exception) -> Response:
    expected = isinstance(error, UserError | ClientDisconnect) or mistake_of_machine(error) is not None
    return JSONResponse({"error": _one_line(error)}, 400 if expected else 500)
