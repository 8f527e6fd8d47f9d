"""Connections of the page's server: limits of their number and of the time to send a request."""

import asyncio
import json
from collections.abc import Sequence
from dataclasses import dataclass

from uvicorn.protocols.http.h11_impl import H11Protocol


@dataclass(frozen=True)
class Limits:
    """Limits of the server.

    Attributes:
        connections, per_address: maximum number of connections, and of those from one address. A new connection takes the place of
            the one that has waited longest for a request, and is refused if all are busy.
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
    """Whether there is room for one more connection; if there are too many, abort the one that has waited longest."""
    if len(group) < most:
        return True
    if not (waiting := [other for other in group if not other.busy]):
        return False
    oldest = min(waiting, key=lambda other: other._since)
    oldest.connections.discard(oldest)
    oldest.transport.abort()
    return True
