"""Who may ask the server: this machine's own page, with its token, in questions of a bounded size."""

import asyncio
import hmac
import json
from collections.abc import Mapping
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ftl_lightning.errors import short

TOKEN = "x-token"
"""The header that every question but the first carries."""
SECONDS = 30.0
"""That a question's bytes may take."""
HEADERS: Mapping[str, str] = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
}
"""Of every answer."""


class Guard:
    """Turns away what does not come from the page: other hosts' names (which a name server may point here), pages of other
    origins, and whoever does not know the token.

    Args:
        app: that answers the others.
        token: of this run.
        hosts: ``host:port`` by which the server may be asked.
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
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *own]}
            await send(message)

        if (told := self._refusal(scope)) is None:
            await self._app(scope, receive, with_headers)
            return
        body = json.dumps({"error": told}).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()), (b"connection", b"close")]
        await with_headers({"type": "http.response.start", "status": 403, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    def _refusal(self, scope: Scope) -> str | None:
        """Why a question is turned away; ``None`` if it is not."""
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
    """The bytes of a question.

    Raises:
        HTTPException: where there are more than ``most``, or they take too long.
    """
    told = f"expected at most {most // 2**20} MB, found more"
    length = request.headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > most:
        raise HTTPException(413, told)
    content = bytearray()
    try:
        async with asyncio.timeout(SECONDS):
            async for part in request.stream():
                content += part
                if len(content) > most:
                    raise HTTPException(413, told)
    except TimeoutError as error:
        raise HTTPException(408, f"expected a whole question within {SECONDS:.0f} seconds, found a part") from error
    return bytes(content)
