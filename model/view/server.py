"""The web server of the viewer, on viser: one port, bound to this machine unless told, quiet on standard output."""

import contextlib
import errno
import io
import socket
import warnings
from collections.abc import Iterator

import viser

from datagen.disk.errors import HyalineError
from model.view.visitors import Value, Visitors


class Server(viser.ViserServer):
    """A viser server that answers browsers of this machine's user alone, and only once there is something to see."""

    def __init__(self, host: str, port: int, label: str) -> None:
        self._visitors = Visitors(host, protocol=f"viser-v{viser.__version__}", takes=self._takes)
        # A browser may go between two messages to it; viser then warns of the second.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        with self._visitors.guarding():
            super().__init__(host=host, port=port, label=label, verbose=False)

    @property
    def is_guarded(self) -> bool:
        """False where viser starts its web server in another way than version 1.1 did."""
        return self._visitors.is_guarding

    def open(self) -> None:
        """Lets browsers in. viser's page keeps for good where its camera first stood, so all must be there by then."""
        self._visitors.is_open = True

    def _takes(self, control: str, value: Value) -> bool:
        """True when a control of the panel can have such a value."""
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
        port: 0 takes any that is free.

    Raises:
        HyalineError: the port is taken, or there is no such address.
    """
    _check_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box.
        server = Server(host, port, label)
    try:
        if not server.is_guarded:
            raise HyalineError(
                f"model view: viser {viser.__version__} cannot be guarded against other web sites; install 1.1.1"
            )
        # viser goes on to the next port when somebody has just taken this one.
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
            f"--port: {port} needs rights that this account has not; choose one above 1023, such as --port 8080"
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
        f"--port: {port} of {host} is taken, perhaps by another viewer; choose another, or 0 for any that is free"
    )
