"""The page's place, a port of this machine alone; who may open it, and what a browser may send it.

A port of this machine is no wall: any page in the user's browser can ask for it, under a name of its own that leads
here (DNS rebinding) or from its own origin (websockets know no same-origin policy). So the address has a token, and the
Host and Origin of every request have to be those of a page on this machine.
"""

import asyncio
import hmac
import http.client
import logging
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from dataclasses import replace
from http import HTTPStatus
from io import StringIO
from typing import Any

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request

from neurad.core.errors import InputError
from neurad.core.ranges import Range
from neurad.formats.cameras.intrinsics import ANGLES
from neurad.runtime.progress import say

HOST = "127.0.0.1"
"""No other machine sees the page."""
PORT = 8080
"""Where the page is unless somebody says otherwise, or the next free one."""
MAX_MESSAGE = 1 << 16
"""Bytes of the longest message that is read; the page sends some hundred."""
_LOCAL = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
"""Names of this machine in the Host header; the port may be that of a tunnel."""
_COORDINATE = Range(-1e12, 1e12)
"""Squares of such numbers are finite in 32 bits."""
_UNIT = Range(0.5, 2.0)
"""Squared length of what should be a unit vector."""
_ANY = Range()
_CAMERA = {
    "fov": Range(*ANGLES),
    "near": Range(0.0, 1e12),
    "far": Range(0.0, 1e12),
    "image_height": Range(0, 1 << 16),  # 0 before the window has its layout
    "image_width": Range(0, 1 << 16),
}
_CONNECTION: ContextVar[ServerConnection | None] = ContextVar("connection", default=None)
"""The connection that the running task serves."""


def check_port(port: int | None) -> None:
    """Refuse a port that cannot be had, before anything is read; None and 0 leave the choice.

    Raises:
        InputError: it is in use, or not allowed.
    """
    if not port:
        return
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((HOST, port))
        except OSError as error:
            raise InputError(_refused(port)) from error


def serve(port: int | None) -> tuple[viser.ViserServer, str]:
    """A page on a port of this machine, and on no other address; and what to open, which has a token.

    Raises:
        InputError: the port is taken, or the installed viser lets somebody in without the token.
    """
    token = secrets.token_urlsafe(32)
    with redirect_stdout(StringIO()), guarded(token):  # it says where it is; so does the command
        server = viser.ViserServer(host=HOST, port=PORT if port is None else port, label="neurad", verbose=False)
    server.get_event_loop().set_exception_handler(_say)
    where = server.get_port()
    if port and where != port:  # taken since it was looked at
        stop(server)
        raise InputError(_refused(port))
    if not _is_shut(where):
        stop(server)
        raise InputError(f"view: viser {viser.__version__} lets in everybody; install 1.1: pip install viser==1.1.1")
    return server, f"http://{HOST}:{where}/{token}/"


def stop(server: viser.ViserServer) -> None:
    """End a page."""
    with redirect_stdout(StringIO()):
        server.stop()


def _is_shut(port: int) -> bool:
    asked = http.client.HTTPConnection(HOST, port, timeout=10)
    try:
        asked.request("GET", "/")
        return asked.getresponse().status == HTTPStatus.FORBIDDEN
    except (OSError, http.client.HTTPException):
        return False
    finally:
        asked.close()


def _say(loop: object, context: dict[str, Any]) -> None:
    """A sentence for what a control of the page did not take, where asyncio has a traceback."""
    if isinstance(error := context.get("exception"), Exception):
        say(f"view: {type(error).__name__}: {error}")


def _refused(port: int) -> str:
    return f"--port {port}: it is in use, or needs rights that you lack; give another, or 0 for any free one"


@contextmanager
def guarded(token: str) -> Iterator[None]:
    """Servers of websockets that begin in here let in who knows the token, and read what :func:`is_wanted` approves.

    viser has no place to say so, but begins its server with a documented class that does.
    """
    kept = websockets.asyncio.server.serve
    logger = logging.Logger("neurad.view", logging.CRITICAL)  # else garbage on the port is a traceback on the terminal
    own: dict[str, Any] = {"create_connection": _Connection, "max_size": MAX_MESSAGE, "logger": logger}

    def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        async def served(connection: ServerConnection) -> None:
            _CONNECTION.set(connection)
            try:
                await handler(connection)
            except Exception as error:
                say_dropped(error)
                await connection.close(1008, "neurad: not understood")

        def enter(connection: ServerConnection, request: Request) -> Any:
            path = path_below(token, request)
            if path is None:
                return connection.respond(HTTPStatus.FORBIDDEN, "Open the address that neurad view printed.\n")
            return process_request(connection, replace(request, path=path))

        return kept(served, *args, **{**options, **own, "process_request": enter})

    websockets.asyncio.server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = kept  # type: ignore[misc]


def path_below(token: str, request: Request) -> str | None:
    """What follows the token in the path of a request; None where it is missing or the request is a foreign page's."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    if len(hosts) != 1 or not _LOCAL.fullmatch(hosts[0]) or origins not in ([], [f"http://{hosts[0]}"]):
        return None
    given, _, rest = request.path.partition("?")[0].removeprefix("/").partition("/")
    return f"/{rest}" if hmac.compare_digest(given.encode(errors="surrogateescape"), token.encode()) else None


def is_wanted(raw: object) -> bool:
    """Whether a message is one that the viewer's page sends; others that viser knows are not for us.

    Args:
        raw: of the websocket, in viser's format: a map in MessagePack with the ``type`` of the message.

    Raises:
        InputError: it is no message, or a number in it is out of range.
    """
    try:
        message = msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        message = None
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(message, dict) or not isinstance(kind, str):
        raise InputError("what it sent is no message of the page")
    if kind == "ViewerCameraMessage":
        wrong = _wrong_camera(message)
    elif kind == "ScenePointerMessage" and message.get("event_type") == "click":
        wrong = _wrong_click(message)
    elif kind == "GuiUpdateMessage":
        wrong = _wrong_control(message)
    else:
        return False
    if wrong:
        raise InputError(f"{wrong} of a {kind} is out of range")
    return True


def connection_closer() -> Callable[[], None]:
    """What ends the connection that the running task serves, from any thread."""
    connection, loop = _CONNECTION.get(), asyncio.get_running_loop()

    def close() -> None:
        if connection is not None:
            asyncio.run_coroutine_threadsafe(connection.close(1008, "neurad: not understood"), loop)

    return close


def say_dropped(error: Exception) -> None:
    """Say why a browser was dropped; it may come back."""
    kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    say(f"view: a browser was dropped: {kind}{error}")


class _Connection(ServerConnection):
    """A connection that passes on nothing but what :func:`is_wanted` approves."""

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            raw = await super().recv(decode)
            if is_wanted(raw):
                return raw


def _wrong_camera(message: Mapping[str, Any]) -> str:
    """The first field that is out of range; empty where none is."""
    for name, allowed in _CAMERA.items():
        if message.get(name) not in allowed:
            return name
    for name in ("position", "look_at", "up_direction"):
        if not _is_vector(message.get(name), 3):
            return name
    return "" if _is_vector(message.get("wxyz"), 4, _UNIT) else "wxyz"


def _wrong_click(message: Mapping[str, Any]) -> str:
    places = message.get("screen_pos")
    if not isinstance(places, list) or not places or not all(_is_vector(place, 2) for place in places):
        return "screen_pos"
    if not _is_vector(message.get("ray_origin"), 3):
        return "ray_origin"
    return "" if _is_vector(message.get("ray_direction"), 3, _UNIT) else "ray_direction"


def _wrong_control(message: Mapping[str, Any]) -> str:
    """The panel looks at what a control may say; viser would set any attribute of it."""
    updates = message.get("updates")
    if not isinstance(updates, dict) or list(updates) != ["value"]:
        return "updates"
    value = updates["value"]
    return "" if isinstance(value, (bool, str)) or value in _COORDINATE else "value"


def _is_vector(value: object, count: int, square: Range = _ANY) -> bool:
    """Whether a value is so many numbers, with a squared length in a range."""
    if not isinstance(value, list) or len(value) != count or not all(number in _COORDINATE for number in value):
        return False
    return sum(number**2 for number in value) in square
