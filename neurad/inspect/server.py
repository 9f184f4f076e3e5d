"""The page's place: a port of this machine alone."""

from __future__ import annotations

import socket
from contextlib import redirect_stdout
from io import StringIO

import viser

from neurad.core.errors import InputError

HOST = "127.0.0.1"
"""The page has no password, so no other machine may see it."""
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


def serve(port: int | None) -> viser.ViserServer:
    """A page on a port of this machine, and on no other address.

    Raises:
        InputError: the port is taken.
    """
    with redirect_stdout(StringIO()):  # it says where it is; so does the command
        server = viser.ViserServer(host=HOST, port=PORT if port is None else port, label="neurad", verbose=False)
    # A browser can ask for a tunnel through which others see the page: nobody gets one.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    if port and server.get_port() != port:  # taken since it was looked at
        stop(server)
        raise InputError(_refused(port))
    return server


def stop(server: viser.ViserServer) -> None:
    """End a page."""
    with redirect_stdout(StringIO()):
        server.stop()


def _refused(port: int) -> str:
    return f"--port {port}: it is in use, or needs rights that you lack; give another, or 0 for any free one"
