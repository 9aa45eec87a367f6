"""The viewer's web server, on viser: one port, reachable from this machine alone, quiet on standard output.

Any page that is open in a browser can reach a port of its machine, and viser answers every web site under every name.
So a request is refused if another site sends it or frames the answer, or if it uses a name that is not this machine's
(DNS rebinding).
"""

import contextlib
import http
import io
import logging
import warnings
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from datagen.disk.errors import HyalineError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost", "::1")
"""What a browser may call this machine; the port may be another, through `ssh -L`."""
UNFRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
"""Headers that forbid other pages to show the viewer's inside of them."""


class Server(viser.ViserServer):
    """A viser server that only answers its own page, and only once there is something to see."""

    is_open = False
    """False until the scene is complete: viser's page keeps its first camera for good. Earlier browsers try again."""
    is_guarded = False
    """True once viser has started its web server through the guard."""

    def __init__(self, port: int, label: str) -> None:
        serve = websockets.asyncio.server.serve

        def guarded(*arguments: Any, process_request: Callable[..., Response | None], **options: Any) -> Any:
            def answer(connection: ServerConnection, request: Request) -> Response | None:
                response = self._refusal(connection, request) or process_request(connection, request)
                if response is not None:
                    response.headers.update(UNFRAMED)
                return response

            self.is_guarded = True
            return serve(*arguments, process_request=answer, **options)

        websockets.asyncio.server.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
        try:
            super().__init__(host=HOST, port=port, label=label, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not _is_here(hosts[0]) or {item.lower() for item in origins} - {_site(hosts[0])}:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "The viewer only answers its own page on localhost.\n")
        if not self.is_open:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "The viewer is starting; reload it soon.\n")
        return None


def _is_here(host: str) -> bool:
    """True for a Host header that names this machine."""
    try:
        return urlsplit(_site(host)).hostname in NAMES
    except ValueError:
        return False


def _site(host: str) -> str:
    return f"http://{host.lower()}"


@contextlib.contextmanager
def serving(port: int, label: str) -> Iterator[Server]:
    """A server that answers until the block ends.

    Args:
        port: 0 for any free one.
    """
    # A browser may disconnect between two messages; viser then warns about the second.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    logging.getLogger("websockets.server").disabled = True  # It prints a traceback for anything but a handshake.
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box.
        server = Server(port, label)
    try:
        if not server.is_guarded:
            raise HyalineError(
                f"model view: viser {viser.__version__} cannot be guarded against other web sites; install 1.1.1"
            )
        if port and server.get_port() != port:  # viser takes the next free one.
            raise HyalineError(
                f"--port: {port} is taken, perhaps by another viewer, or needs root privileges; choose another above "
                "1023, or 0 for any free one"
            )
        server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
