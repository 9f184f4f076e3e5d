"""The page's place: a port of this machine alone, behind a door that a token opens."""

import http.client
import secrets
import socket
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import viser

from neurad.core.errors import InputError
from neurad.inspect.door import guarded
from neurad.runtime.progress import say

HOST = "127.0.0.1"
"""No other machine sees the page."""
PORT = 8080
"""Where the page is unless somebody says otherwise, or the next free one."""


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
        return asked.getresponse().status == http.HTTPStatus.FORBIDDEN
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
