"""The viewer's web server, on viser: one port, by default reachable only from this machine, quiet on standard output.

viser accepts connections from every web site, under every name, and executes any message. Any page that is open in a
browser can reach a port of its machine. So connections are refused here if another site opens them or if they use a
name that is not this machine's (DNS rebinding), and only those messages pass that viser's own page sends to this
viewer, with values that it can send.
"""

import contextlib
import errno
import http
import io
import ipaddress
import logging
import math
import socket
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any
from urllib.parse import urlsplit

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from datagen.disk.errors import HyalineError

Length = Annotated[float, msgspec.Meta(ge=-1e8, le=1e8)]
Triple = tuple[Length, Length, Length]
Pixels = Annotated[int, msgspec.Meta(ge=0, le=100_000)]
Word = Annotated[str, msgspec.Meta(max_length=200)]
Value = bool | int | float | str
"""Value of a control."""

MOST_BYTES = 1 << 16
"""Largest message; the page's own are a hundred times smaller."""


class _Message(
    msgspec.Struct,
    tag_field="type",
    forbid_unknown_fields=True,
):
    """A message of viser's page. NaN and infinity exceed every limit."""


class _Camera(_Message, tag="ViewerCameraMessage"):
    wxyz: tuple[Length, Length, Length, Length]
    position: Triple
    fov: Annotated[float, msgspec.Meta(ge=1e-3, le=3.1)]
    near: Length
    far: Length
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class _Click(_Message, tag="SceneNodeClickMessage"):
    name: Word
    instance_index: int | None
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[Length, Length]
    modifier: Word | None
    owner: Word = ""


class _NewValue(
    msgspec.Struct,
    forbid_unknown_fields=True,
):
    value: Value


class _Control(_Message, tag="GuiUpdateMessage"):
    uuid: Word
    updates: _NewValue


_DECODER = msgspec.msgpack.Decoder(_Camera | _Click | _Control)


class Visitors:
    """Filters connections and messages from browsers to viser."""

    def __init__(self, host: str, *, protocol: str, takes: Callable[[str, Value], bool]) -> None:
        """
        Args:
            host: the address that the server is bound to.
            protocol: the WebSocket's subprotocol, which names viser's version.
            takes: whether a control, named by its UUID, can have a value.
        """
        self._host, self._protocol, self._takes = host.lower(), protocol, takes
        self.is_open = False
        """False until there is something to see: browsers that connect earlier try again."""
        self.is_guarding = False

    @contextlib.contextmanager
    def guarding(self) -> Iterator[None]:
        """Guards a server that viser starts in this block; viser has no option for that."""
        serve = websockets.asyncio.server.serve

        def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
            def admit(connection: ServerConnection, request: Request) -> Any:
                return self._refusal(connection, request) or process_request(connection, request)

            self.is_guarding = True
            mine = {"create_connection": self._connection_kind(), "max_size": MOST_BYTES, "logger": _mute_logger()}
            return serve(*arguments, process_request=admit, **options | mine)

        websockets.asyncio.server.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve

    def check(self, data: bytes | str) -> bytes | None:
        """The message to pass on to viser; None: drop it."""
        try:
            message = _DECODER.decode(data if isinstance(data, bytes) else b"")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        if isinstance(message, _Camera) and not _is_posed(message):
            return None
        if isinstance(message, _Control) and not self._takes(message.uuid, message.updates.value):
            return None
        return msgspec.msgpack.encode(message)  # Not the received bytes, which other decoders may read differently.

    def _connection_kind(self) -> type[ServerConnection]:
        check = self.check

        class Checked(ServerConnection):
            """Receives only accepted messages."""

            async def recv(self, decode: bool | None = None) -> bytes:  # pyright: ignore[reportIncompatibleMethodOverride]
                while (message := check(await super().recv(decode))) is None:
                    pass
                return message

        return Checked

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self.knows(hosts[0]):
            return connection.respond(
                http.HTTPStatus.FORBIDDEN,
                "The viewer only answers to localhost, its own address and its machine's name; for another name, start "
                "`model view` with --host NAME.\n",
            )
        if not {origin.lower() for origin in origins} <= {f"{way}://{hosts[0].lower()}" for way in ("http", "https")}:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Requests from other web sites are refused.\n")
        if not self.is_open:
            return connection.respond(
                http.HTTPStatus.SERVICE_UNAVAILABLE, "The viewer is starting; reload in a moment.\n"
            )
        spoken = ",".join(request.headers.get_all("Sec-WebSocket-Protocol")).replace(" ", "").split(",")
        if "Upgrade" in request.headers and self._protocol not in spoken:
            return connection.respond(
                http.HTTPStatus.BAD_REQUEST, "The page is from another version of viser; reload it.\n"
            )
        return None

    def knows(self, host: str) -> bool:
        """True for a Host header that names this machine."""
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
        except ValueError:
            return False
        try:
            address, bound = ipaddress.ip_address(name), _address(self._host)
        except ValueError:
            machine = socket.gethostname().lower()
            return name in ("localhost", self._host, machine, f"{machine}.local", socket.getfqdn().lower())
        return address.is_loopback or address == bound or (bound is not None and bound.is_unspecified)


def _is_posed(camera: _Camera) -> bool:
    """True if a camera has a viewing direction and an up direction."""
    units = math.hypot(*camera.wxyz), math.hypot(*camera.up_direction)
    return all(0.99 < unit < 1.01 for unit in units) and math.dist(camera.look_at, camera.position) > 1e-4


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """A host's IP address; None if it was given by name."""
    try:
        return ipaddress.ip_address(host or "0.0.0.0")
    except ValueError:
        return None


def _mute_logger() -> logging.Logger:
    """websockets would print a traceback for anything that is not a handshake."""
    logger = logging.getLogger("hyaline.visitors")
    logger.disabled = True
    return logger


class Server(viser.ViserServer):
    """A viser server that only answers its own pages, and only once there is something to see."""

    def __init__(self, host: str, port: int, label: str) -> None:
        self._visitors = Visitors(host, protocol=f"viser-v{viser.__version__}", takes=self._takes)
        # A browser may disconnect between two messages; viser then warns about the second.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        with self._visitors.guarding():
            super().__init__(host=host, port=port, label=label, verbose=False)

    @property
    def is_guarded(self) -> bool:
        """False if viser starts its web server in a different way than version 1.1."""
        return self._visitors.is_guarding

    def open(self) -> None:
        """Accepts browsers. viser's page keeps its first camera for good, so the scene must be complete by then."""
        self._visitors.is_open = True

    def _takes(self, control: str, value: Value) -> bool:
        """True if a control of the panel can have this value."""
        handle = self.gui._gui_input_handle_from_uuid.get(control)
        if isinstance(handle, viser.GuiDropdownHandle):
            return value in handle.options
        if isinstance(handle, viser.GuiSliderHandle):
            return type(value) is int and handle.min <= value <= handle.max
        return isinstance(handle, viser.GuiCheckboxHandle) and isinstance(value, bool)


@contextlib.contextmanager
def serving(host: str, port: int, label: str) -> Iterator[Server]:
    """A server that answers until the block ends.

    Args:
        port: 0 for any free one.
    """
    _check_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box.
        server = Server(host, port, label)
    try:
        if not server.is_guarded:
            raise HyalineError(
                f"model view: viser {viser.__version__} cannot be guarded against other web sites; install 1.1.1"
            )
        # viser takes the next port if this one has just been taken.
        if port and server.get_port() != port:
            raise _taken(host, port)
        server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _check_free(host: str, port: int) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except PermissionError as error:
        raise HyalineError(
            f"--port: {port} needs root privileges; choose one above 1023, such as --port 8080"
        ) from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _taken(host, port) from error
        raise HyalineError(
            f"--host: cannot listen at {host} ({error.strerror}); expected an address of this machine, such as "
            "127.0.0.1, or 0.0.0.0 for all of them"
        ) from error


def _taken(host: str, port: int) -> HyalineError:
    return HyalineError(
        f"--port: {port} of {host} is taken, perhaps by another viewer; choose another, or 0 for any free one"
    )
