"""Tests that the viewer answers its own page alone, and where a browser begins."""

# ruff: noqa: E402 (viser may be missing)

import contextlib
import http.client
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.viewer import PATIENCE_S, require_viewer

import hyaline

require_viewer()

import viser

from hyaline_web.view.view import Viewer, serving

pytestmark = pytest.mark.usefixtures("at_home")

HANDSHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}


def answer_to(port: int, headers: dict[str, str]) -> http.client.HTTPResponse:
    """The answer to a request with these headers alone."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    with contextlib.closing(connection):
        connection.putrequest("GET", "/", skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse()


@pytest.fixture
def served(home: Path) -> Iterator[tuple[str, Viewer]]:
    """The address of a viewer of a dataset, and the viewer."""
    with serving(0, "one") as server:
        yield f"http://127.0.0.1:{server.get_port()}", Viewer(server, hyaline.open_dataset(home / "data" / "one"), None)


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{port}", None, 101),
        ("127.0.0.1:{port}", "http://127.0.0.1:{port}", 101),
        ("LocalHost:9000", "http://localhost:9000", 101),  # Through `ssh -L 9000:localhost:8080`.
        ("[::1]:{port}", "http://[::1]:{port}", 101),
        ("127.0.0.1:{port}", "http://evil.example", 403),
        ("127.0.0.1:{port}", "http://localhost:{port}", 403),
        ("127.0.0.1:{port}", "null", 403),
        ("evil.example:{port}", "http://evil.example:{port}", 403),  # Whose name now leads to 127.0.0.1.
        ("evil.example@127.0.0.1[", None, 403),
        (None, None, 403),
    ],
)
def test_only_the_viewers_own_page_under_a_name_of_this_machine_is_let_in(
    served: tuple[str, Viewer], host: str | None, origin: str | None, status: int
) -> None:
    port = int(served[0].rpartition(":")[2])
    own = {"Host": host, "Origin": origin}
    headers = {name: value.format(port=port) for name, value in own.items() if value is not None}
    assert answer_to(port, headers | HANDSHAKE).status == status
    answer = answer_to(port, headers)
    assert answer.status == (200 if status == 101 else status), "the page itself, too"
    # No other page may frame it.
    assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert answer.headers["X-Frame-Options"] == "DENY"
