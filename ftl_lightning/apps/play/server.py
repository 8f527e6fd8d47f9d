"""Serve a page on this machine until the user ends the program: access control, limits of connections, errors and the server."""

import asyncio
import contextlib
import hmac
import ipaddress
import json
import secrets
import socket
import webbrowser
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from ftl_lightning.services.errors import UserError, mistake_of_machine, short
from ftl_lightning.services.text import line, say

LOOPBACK = "127.0.0.1"
PORT = 8765  # default port, unless another program uses it
PATIENCE = 3  # seconds for the last answers at the end
TOKEN = "x-token"  # header required in every request but the first
END_SECONDS = 0.25  # seconds from the request to end the program to its end
HEADERS: Mapping[str, str] = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
}
"""Headers of every answer."""
MISTAKES = (
    UserError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    ClientDisconnect,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Exceptions reported on a single line. Not Exception, which Starlette handles outside of :class:`Guard` and so without headers."""
Begin = Callable[[], Awaitable[Any]]  # called at the start, while requests are already answered


@dataclass(frozen=True)
class Limits:
    """Limits of the server.

    Attributes:
        connections, per_address: maximum number of connections, and of those from one address. A new connection takes the place of
            the connection that has waited longest for a request, and is refused if all are busy.
        headers, body: maximum seconds to receive the headers of a request, and its body.
        idle: seconds before a connection without a new request is closed.
    """

    connections: int = 200
    per_address: int = 64
    headers: float = 5.0
    body: float = 30.0
    idle: int = 5


class Connection(H11Protocol):
    """Connection of the server :mod:`uvicorn` with :class:`Limits`. Names of methods are those of uvicorn."""

    limits = Limits()
    _timer: asyncio.TimerHandle | None = None
    _since = 0.0

    @property
    def busy(self) -> bool:
        """Whether a request is received or answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request, or refuse the connection."""
        super().connection_made(transport)
        self._since = self.loop.time()
        self._timer = self.loop.call_later(self.limits.headers, self._refuse, "408 Request Timeout", "no request in time")
        known = [other for other in self.connections if isinstance(other, Connection) and other is not self]
        same = [other for other in known if other._address == self._address]
        if not (_has_room(same, self.limits.per_address) and _has_room(known, self.limits.connections)):
            self._refuse("503 Service Unavailable", "too many connections at a time; wait for an answer")

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._stop_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive a part of a request: headers in limited time, however many parts they come in."""
        if self._timer is None and not self.busy:
            self._timer = self.loop.call_later(self.limits.headers, self._refuse, "408 Request Timeout", "headers took too long")
        super().data_received(data)
        if self.busy:
            self._stop_timer()

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        self._since = self.loop.time()
        super().on_response_complete()

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _refuse(self, status: str, reason: str) -> None:
        """Close the connection with an answer of one line."""
        self._stop_timer()
        self.connections.discard(self)
        if not self.transport.is_closing():
            body = json.dumps({"error": reason})
            head = (
                f"HTTP/1.1 {status}\r\ncontent-type: application/json\r\ncontent-length: {len(body)}\r\nconnection: close\r\n\r\n"
            )
            self.transport.write(f"{head}{body}".encode())
            self.transport.close()


def _has_room(group: Sequence[Connection], most: int) -> bool:
    """Whether there is room for one more connection; if there are too many, abort the connection that has waited longest."""
    if len(group) < most:
        return True
    if not (waiting := [other for other in group if not other.busy]):
        return False
    oldest = min(waiting, key=lambda other: other._since)
    oldest.connections.discard(oldest)
    oldest.transport.abort()
    return True


class Guard:
    """Refuse requests that are not from the page: with other host names (which a name server may point here), from pages of other
    origins, or without the token of this run.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str]) -> None:
        self._app, self._token, self._hosts = app, token, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        refusal = self._refusal(Request(scope))
        answer = self._app if refusal is None else JSONResponse({"error": refusal}, 403, {"connection": "close"})
        await answer(scope, receive, with_headers)

    def _refusal(self, request: Request) -> str | None:
        """Reason for refusing a request; ``None`` if it is accepted."""
        host = request.headers.getlist("host")
        if len(host) != 1 or host[0].lower() not in self._hosts:
            return f"host: expected {min(self._hosts)}, found {short(', '.join(host)) or 'none'}"
        for origin in request.headers.getlist("origin"):
            if origin.lower().removeprefix("http://") not in self._hosts:
                return f"origin: expected http://{min(self._hosts)}, found {short(origin)}"
        first = request.scope["path"] == "/"
        tokens = request.query_params.getlist("token") if first else request.headers.getlist(TOKEN)
        if len(tokens) != 1 or not hmac.compare_digest(tokens[0].encode(), self._token.encode()):
            return "token: expected that of the address which the program printed, found another; open that address"
        return None


async def body_of(request: Request, most: int) -> bytes:
    """Read the bytes of a request. Raise HTTPException for more than ``most`` bytes, or if they take too long."""
    size, seconds = f"{most // 2**20} MB" if most >= 2**20 else f"{most // 2**10} kB", request.app.state.limits.body
    message = f"expected at most {size}, found more"
    length = request.headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > most:
        raise HTTPException(413, message)
    content = bytearray()
    try:
        async with asyncio.timeout(seconds):
            async for part in request.stream():
                content += part
                if len(content) > most:
                    raise HTTPException(413, message)
    except TimeoutError as error:
        raise HTTPException(408, f"expected a whole question within {seconds:g} seconds, found a part") from error
    return bytes(content)


def guarded(
    routes: Sequence[Route],
    token: str,
    hosts: Sequence[str],
    end: Callable[[], None],
    begin: Begin | None = None,
    limits: Limits = Limits(),
) -> Starlette:
    """Application of a single page: answer requests that name the token and one of the ``hosts`` (``host:port``), by ``routes`` or
    by ``end``, which ends the program. ``begin`` is called at the start.
    """

    async def ended(request: Request) -> Response:
        asyncio.get_running_loop().call_later(END_SECONDS, end)
        return JSONResponse({"ended": True})

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        beginning = asyncio.ensure_future(begin()) if begin is not None else None
        yield
        if beginning is not None:
            beginning.cancel()

    handlers: Any = {HTTPException: _refused, **dict.fromkeys(MISTAKES, _mistaken)}
    all_routes = [*routes, Route("/api/end", ended, methods=["POST"])]
    application = Starlette(routes=all_routes, exception_handlers=handlers, lifespan=lifespan)
    application.state.limits = limits
    application.add_middleware(Guard, token=token, hosts=frozenset(hosts))
    return application


def message_of(error: Exception) -> str:
    """Message of an error for the user; bugs of the program are also printed."""
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
    return JSONResponse({"error": message_of(error)}, 400 if expected else 500)


@dataclass(frozen=True)
class Place:
    """Address of a page; any host but the loopback admits other machines, with a warning. Port 0 is :data:`PORT`, or any if that is
    in use. ``limits`` are those of connections and requests.
    """

    host: str = LOOPBACK
    port: int = 0
    browser: bool = True
    limits: Limits = field(default_factory=Limits)


def serve(routes: Sequence[Route], place: Place, begin: Begin | None = None, close: Callable[[], None] = lambda: None) -> None:
    """Serve a page until Ctrl-C or its request to end, then call ``close``. Raise UserError if the address is not available."""
    listening = _listening(place.host, place.port)
    port, names, token = listening.getsockname()[1], _names(place.host), secrets.token_urlsafe(24)
    hosts = [f"{name}:{port}" for name in names]
    app = guarded(routes, token, hosts, lambda: server.end(), begin, place.limits)

    class Limited(Connection):
        limits = place.limits

    config = uvicorn.Config(
        app,
        http=Limited,
        log_level="critical",
        ws="none",
        server_header=False,
        timeout_keep_alive=place.limits.idle,
        timeout_graceful_shutdown=PATIENCE,
    )
    server = _Server(config, close)
    address = f"http://{hosts[0]}/?token={token}"
    say(f"open {address}\nCtrl-C ends the program")
    if not ipaddress.ip_address(place.host).is_loopback:
        link = f"http://{hosts[-1]}/?token={token}"
        say(f"warning: other machines of this network reach it at {link}; whoever has this address can use the program", error=True)
    if place.browser:
        webbrowser.open(address)
    with contextlib.suppress(KeyboardInterrupt):  # the usual end
        server.run(sockets=[listening])
    say("ended")


class _Server(uvicorn.Server):
    """Server that stops running work, by ``close``, before it waits for the last answers."""

    def __init__(self, config: uvicorn.Config, close: Callable[[], None]) -> None:
        super().__init__(config)
        self._close = close

    def end(self) -> None:
        """End the program."""
        self._close()
        self.should_exit = True

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle Ctrl-C; the name is that of uvicorn."""
        self._close()
        super().handle_exit(sig, frame)


def _listening(host: str, port: int) -> socket.socket:
    """Socket that listens on an address."""
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(host).version == 6 else socket.AF_INET
    except ValueError as error:
        raise UserError(f"host: expected an address such as {LOOPBACK} or 0.0.0.0, found {short(host)!r}") from error
    dualstack, reason = family == socket.AF_INET6 and socket.has_dualstack_ipv6(), ""
    for wanted in (port,) if port else (PORT, 0):
        try:
            return socket.create_server((host, wanted), family=family, dualstack_ipv6=dualstack)
        except OSError as error:
            reason = error.strerror or str(error)
    raise UserError(f"host, port: expected an address that is free, found {host}:{port} ({reason}); choose another port")


def _names(host: str) -> list[str]:
    """Accepted host names; the first is used on this machine."""
    bracketed = f"[{host}]" if ":" in host else host
    if ipaddress.ip_address(host).is_unspecified:
        return [LOOPBACK, "localhost", _network_address()]
    if ipaddress.ip_address(host).is_loopback:
        return [bracketed, "localhost"]
    return [bracketed]


def _network_address() -> str:
    """Address of this machine in its network; determined without sending anything."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # a reserved address (RFC 5737)
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
