"""Access control of the server: only this machine's page, with its token, in requests of bounded size."""

import asyncio
import hmac
import json
from collections.abc import Mapping
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ftl_lightning.services.errors import short

TOKEN = "x-token"
"""Header required in every request but the first."""
SECONDS = 30.0
"""Maximum seconds to receive a request."""
HEADERS: Mapping[str, str] = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
}
"""Headers of every answer."""


class Guard:
    """Refuse requests that are not from the page: with other host names (which a name server may point here), from pages of other
    origins, or without the token.

    Args:
        app: answers the accepted requests.
        token: token of this run.
        hosts: ``host:port`` that requests may name.
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
                extra = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        if (refusal := self._refusal(scope)) is None:
            await self._app(scope, receive, with_headers)
            return
        body = json.dumps({"error": refusal}).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()), (b"connection", b"close")]
        await with_headers({"type": "http.response.start", "status": 403, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    def _refusal(self, scope: Scope) -> str | None:
        """Reason for refusing a request; ``None`` if it is accepted."""
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        if len(host := headers.get("host", [])) != 1 or host[0].lower() not in self._hosts:
            return f"host: expected {min(self._hosts)}, found {short(', '.join(host)) or 'none'}"
        for origin in headers.get("origin", []):
            if origin.lower().removeprefix("http://") not in self._hosts:
                return f"origin: expected http://{min(self._hosts)}, found {short(origin)}"
        if scope["path"] == "/":
            given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
        else:
            given = headers.get(TOKEN, [])
        if len(given) != 1 or not hmac.compare_digest(given[0].encode(), self._token.encode()):
            return "token: expected that of the address which the program printed, found another; open that address"
        return None


async def body_of(request: Request, most: int) -> bytes:
    """Read the bytes of a request.

    Raises:
        HTTPException: for more than ``most`` bytes, or if they take too long.
    """
    message = f"expected at most {most // 2**20} MB, found more"
    length = request.headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > most:
        raise HTTPException(413, message)
    content = bytearray()
    try:
        async with asyncio.timeout(SECONDS):
            async for part in request.stream():
                content += part
                if len(content) > most:
                    raise HTTPException(413, message)
    except TimeoutError as error:
        raise HTTPException(408, f"expected a whole question within {SECONDS:.0f} seconds, found a part") from error
    return bytes(content)
