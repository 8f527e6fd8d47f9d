"""Serve the page on this machine until the user ends the program."""

import contextlib
import ipaddress
import secrets
import socket
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType

import uvicorn
from starlette.routing import Route

from ftl_lightning.apps.play.application import Begin, guarded
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.text import say

LOOPBACK = "127.0.0.1"
PORT = 8765
"""Default port, unless another program uses it."""
MOST_CONNECTIONS, IDLE, PATIENCE = 200, 5, 3
"""Maximum number of connections, seconds before an idle connection is closed, and seconds for the last answers at the end."""


@dataclass(frozen=True)
class Place:
    """Address of a page.

    Attributes:
        host: address to listen on; any but the loopback address admits other machines, with a warning.
        port: port number; 0 for :data:`PORT`, or any free port if that is in use.
        browser: whether to open a browser.
    """

    host: str = LOOPBACK
    port: int = 0
    browser: bool = True


def serve(
    routes: Sequence[Route],
    place: Place,
    begin: Begin | None = None,
    close: Callable[[], None] = lambda: None,
) -> None:
    """Serve a page until Ctrl-C, or until the page ends the program.

    Args:
        routes: routes of the page.
        place: address of the page.
        begin: run at the start, while requests are already answered.
        close: called when the program ends.

    Raises:
        UserError: if the address is not available.
    """
    listening = _listening(place.host, place.port)
    port, names, token = listening.getsockname()[1], _names(place.host), secrets.token_urlsafe(24)
    hosts = [f"{name}:{port}" for name in names]
    app = guarded(routes, token, hosts, lambda: server.end(), begin)
    config = uvicorn.Config(
        app,
        log_level="critical",
        ws="none",
        server_header=False,
        limit_concurrency=MOST_CONNECTIONS,
        timeout_keep_alive=IDLE,
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
    """Server that stops running work before it waits for the last answers.

    Args:
        config: settings of the server.
        close: called first when the program ends.
    """

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
    last: OSError | None = None
    for wanted in (port,) if port else (PORT, 0):
        listener = socket.socket(family)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, wanted))
            listener.listen()  # before the address is printed
        except (OSError, OverflowError) as error:
            listener.close()
            last = error if isinstance(error, OSError) else OSError(str(error))
            continue
        return listener
    reason = last.strerror or str(last) if last else ""
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
