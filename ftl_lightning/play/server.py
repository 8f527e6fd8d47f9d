"""Serving the page on this machine, until the person ends it."""

import contextlib
import ipaddress
import secrets
import socket
import webbrowser
from collections.abc import Callable, Sequence

import uvicorn

from ftl_lightning.errors import UserError, short
from ftl_lightning.play.application import Desk, application
from ftl_lightning.play.workspace import Workspace
from ftl_lightning.printing import say

LOOPBACK = "127.0.0.1"
PORT = 8765
"""Unless another program has it."""
MOST_CONNECTIONS, IDLE = 200, 5
"""Connections at a time, and seconds that an idle one is kept."""


def serve(models: Sequence[str], make: Callable[[str], Workspace], host: str, port: int, browser: bool) -> None:
    """Serve the page until Ctrl-C, or until it is told on the page to end.

    Args:
        models: names of those that can be opened, the first one at first.
        make: makes the workspace of a model.
        host: address to listen at; any but the loopback address lets other machines in, which is told.
        port: 0 for :data:`PORT`, or any other if that is taken.
        browser: whether a browser is opened.

    Raises:
        UserError: for an address that cannot be had.
    """
    listening = _listening(host, port)
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(24)
    names = _names(host)
    desk = Desk(models, make)
    app = application(desk, token, [f"{name}:{port}" for name in names], lambda: setattr(server, "should_exit", True))
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="error",
            ws="none",
            lifespan="off",
            server_header=False,
            limit_concurrency=MOST_CONNECTIONS,
            timeout_keep_alive=IDLE,
            timeout_graceful_shutdown=1,
        )
    )
    address = f"http://{_bracketed(names[0])}:{port}/?token={token}"
    say(f"open {address}\nCtrl-C ends the program")
    if host != LOOPBACK:
        told = f"http://{names[-1]}:{port}/?token={token}"
        say(f"warning: other machines of this network reach it at {told}; whoever has this address can use the program", error=True)
    if browser:
        webbrowser.open(address)
    with contextlib.suppress(KeyboardInterrupt):  # the usual end
        try:
            server.run(sockets=[listening])
        finally:
            desk.ended.set()
    say("ended")


def _bracketed(name: str) -> str:
    return f"[{name}]" if ":" in name and not name.startswith("[") else name


def _listening(host: str, port: int) -> socket.socket:
    """A socket at an address."""
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(host).version == 6 else socket.AF_INET
    except ValueError as error:
        raise UserError(f"host: expected an address such as {LOOPBACK} or 0.0.0.0, found {short(host)!r}") from error
    last: OSError | None = None
    for wanted in (port,) if port else (PORT, 0):
        found = socket.socket(family)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            found.bind((host, wanted))
        except (OSError, OverflowError) as error:
            found.close()
            last = error if isinstance(error, OSError) else OSError(str(error))
            continue
        return found
    told = last.strerror or str(last) if last else ""
    raise UserError(f"host, port: expected an address that is free, found {host}:{port} ({told}); choose another port")


def _names(host: str) -> list[str]:
    """By which the server may be asked, this machine's own first."""
    if ipaddress.ip_address(host).is_unspecified:
        return [LOOPBACK, "localhost", _own_address()]
    if ipaddress.ip_address(host).is_loopback:
        return [host, "localhost"]
    return [_bracketed(host)]


def _own_address() -> str:
    """Address of this machine in its network; nothing is sent to find it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address that belongs to nobody (RFC 5737)
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
