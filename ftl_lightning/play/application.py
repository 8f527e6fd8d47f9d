"""What the server answers, and to what."""

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

from ftl_lightning.errors import UserError, mistake_of_machine, short
from ftl_lightning.play import requests
from ftl_lightning.play.guard import Guard, body_of
from ftl_lightning.play.page import POLICY, page
from ftl_lightning.play.workspace import Stopped, Workspace
from ftl_lightning.printing import line, say
from ftl_lightning.schema import from_mapping, parse_json

MOST_ASKED, MOST_OPENED = 4 * 2**20, 64 * 2**20
"""Bytes of a question, and of a file that is opened."""
MOST_WAITING = 32
"""Questions that wait for one that is being answered; more are sent away."""
WAIT = 0.5
"""Seconds after which it is asked whether anybody still waits for what is learned."""
SERVED = "; connect-src 'self'; frame-ancestors 'none'"
"""What a page that is served may do beside the policy of every page: ask this server."""

ANSWERS: Mapping[str, tuple[type, Callable[[Workspace, Any], Any]]] = {
    "scene": (requests.Pose, Workspace.scene),
    "record": (requests.Recorded, Workspace.record),
    "draw": (requests.Drawn, Workspace.draw),
    "remove": (requests.One, Workspace.remove),
    "undo": (requests.Nothing, Workspace.undo),
    "clear": (requests.Nothing, Workspace.clear),
    "sample": (requests.Sample, Workspace.sample),
}
"""What is posted as JSON: its form, and who answers."""

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
"""What is told in one line; the server goes on."""


class Desk:
    """The workspaces of the models that were opened, the last one of which is worked in, one question at a time.

    Args:
        models: names of those that can be opened, the first one at first.
        make: makes the workspace of a model; called in a thread.
    """

    def __init__(self, models: Sequence[str], make: Callable[[str], Workspace]) -> None:
        self._models, self._make = tuple(models), make
        self._opened: dict[str, Workspace] = {}
        self._now = self._models[0]
        self._lock, self._waiting = asyncio.Lock(), 0
        self.ended = threading.Event()

    async def work(self, do: Callable[[Workspace], Any]) -> Any:
        """Do something in the workspace, in a thread.

        Raises:
            HTTPException: where too many wait already.
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
        """Turn to another model; what was done with this one is kept.

        Raises:
            UserError: for a model that is none of those that can be opened.
        """
        if model not in self._models:
            raise UserError(f"model: expected one of {', '.join(self._models)}, found {short(model)!r}")
        workspace = self._workspace(model)
        self._now = model
        return self.state(workspace)

    def state(self, workspace: Workspace) -> dict[str, Any]:
        """What the page shows at first."""
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
    """An application that answers one page of this machine's own.

    Args:
        routes: what it answers, beside ending.
        token: that questions carry.
        hosts: ``host:port`` by which it may be asked.
        end: ends the program.
        begin: done at the beginning, while the page may be asked already; ``None`` for nothing.
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
    found = Starlette(routes=every, exception_handlers=handlers, lifespan=lifespan)
    found.add_middleware(Guard, token=token, hosts=frozenset(hosts))
    return found


async def first_page(request: Request) -> Response:
    """The page itself; what it shows it asks for."""
    nonce = secrets.token_urlsafe(16)
    return HTMLResponse(page(nonce), headers={"content-security-policy": POLICY.format(nonce=nonce) + SERVED})


def viewing(shown: Mapping[str, Any]) -> list[Route]:
    """Routes of a page that shows one thing: the answer to ``/api/state``."""

    async def state(request: Request) -> Response:
        return JSONResponse(shown)

    return [Route("/", first_page), Route("/api/state", state)]


def reading(text: str) -> list[Route]:
    """Routes of a whole page that asks for nothing."""

    async def whole(request: Request) -> Response:
        return HTMLResponse(text)  # which has a policy of its own

    return [Route("/", whole)]


def playing(desk: Desk) -> list[Route]:
    """Routes of the page on which a person shows, learns and mixes."""

    async def state(request: Request) -> Response:
        return JSONResponse(await desk.work(desk.state))

    async def opened(request: Request) -> Response:
        asked = from_mapping(requests.Open, await _asked(request), "")
        return JSONResponse(await desk.work(lambda _: desk.open(asked.model)))

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
        asked = from_mapping(requests.Named, await _asked(request), "")
        await desk.work(lambda workspace: workspace.forget(asked))
        return JSONResponse(await desk.work(desk.state))

    async def rename(request: Request) -> Response:
        asked = from_mapping(requests.Renamed, await _asked(request), "")
        await desk.work(lambda workspace: workspace.rename(asked))
        return JSONResponse(await desk.work(desk.state))

    async def learn(request: Request) -> Response:
        asked = from_mapping(requests.Learn, await _asked(request), "")
        return StreamingResponse(_learned(desk, request, asked), media_type="application/x-ndjson")

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
        asked = from_mapping(kind, await _asked(request), "")
        return JSONResponse(await desk.work(lambda workspace: do(workspace, asked)))

    return answer


def _id(request: Request) -> str:
    return request.query_params.get("id", "")


async def _asked(request: Request) -> Any:
    return parse_json(await body_of(request, MOST_ASKED), "a question in JSON")


def _attached(name: str, content: bytes) -> Response:
    told = f"attachment; filename*=UTF-8''{quote(name, safe='')}"
    return Response(content, media_type="application/octet-stream", headers={"content-disposition": told})


async def _learned(desk: Desk, request: Request, asked: requests.Learn) -> AsyncIterator[str]:
    """What learning tells, a line each, until it is done or nobody listens."""
    loop, lines = asyncio.get_running_loop(), asyncio.Queue[dict[str, Any] | None]()
    stopped = threading.Event()

    def tell(told: Mapping[str, Any] | None) -> None:
        loop.call_soon_threadsafe(lines.put_nowait, None if told is None else dict(told))

    async def work() -> None:
        try:
            await desk.work(lambda workspace: workspace.learn(asked, tell, lambda: stopped.is_set() or desk.ended.is_set()))
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
                told = await asyncio.wait_for(lines.get(), WAIT)
            except TimeoutError:
                if await request.is_disconnected():
                    return
                continue
            if told is None:
                return
            yield json.dumps(told) + "\n"
            if await request.is_disconnected():
                return
    finally:
        stopped.set()
        await asyncio.shield(working)


def _one_line(error: Exception) -> str:
    """What a person is told of an error; what is the program's own fault is printed where it runs."""
    if isinstance(error, UserError):
        return line(str(error))
    if (told := mistake_of_machine(error)) is not None:
        return line(told)
    say(f"error: {type(error).__name__}: {error}", error=True)
    return f"the program failed ({type(error).__name__}); what it printed says more"


async def _refused(request: Request, error: Exception) -> Response:
    status, told = (error.status_code, error.detail) if isinstance(error, HTTPException) else (400, "broken off")
    return JSONResponse({"error": line(str(told))}, status)


async def _mistaken(request: Request, error: Exception) -> Response:
    own = isinstance(error, UserError | ClientDisconnect) or mistake_of_machine(error) is not None
    return JSONResponse({"error": _one_line(error)}, 400 if own else 500)
