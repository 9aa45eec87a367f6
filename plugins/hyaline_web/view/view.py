"""`model view`: a dataset or a run in a browser; pictures are drawn one by one, only in the main thread.

The web server is viser's: one port, reachable from this machine alone, quiet on standard output. Any page that is open
in a browser can reach a port of its machine, and viser answers every web site under every name. So a request is refused
if another site sends it or frames the answer, or if it uses a name that is not this machine's (DNS rebinding).
"""

import contextlib
import http
import io
import logging
import math
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import Held, hold_signals, say, tell
from hyaline_web.view.live_run import LiveRun, MovedOn
from hyaline_web.view.schedule import Job, Pose, Schedule
from hyaline_web.view.stage import Stage
from model.run.run_folder import RUN, open_trained
from model.runtime import choose_device
from model.settings import RUNS, Device

HOST = "127.0.0.1"
NAMES = (HOST, "localhost", "::1")
"""What a browser may call this machine; the port may be another, through `ssh -L`."""
UNFRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
"""Headers that forbid other pages to show the viewer's inside of them."""
TRAINING_SHARE = 0.09
"""Share of one core that this process takes while a run trains, for any number of browsers: it slows training by less
than a tenth, and takes nothing without a browser."""
LOOK_EVERY_S = 2.0
"""Seconds between two checks for newer weights."""
WAIT_S, IDLE_S = 0.05, 0.5
"""Seconds to wait for work with a connected browser, and without one."""
JPEG_QUALITY = 85
"""Quality of pictures while a camera moves; the others are sent losslessly."""


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
        site = f"http://{''.join(hosts[:1]).lower()}"
        is_here = False
        with contextlib.suppress(ValueError):
            is_here = len(hosts) == 1 and urlsplit(site).hostname in NAMES
        if not is_here or {item.lower() for item in origins} - {site}:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "The viewer only answers its own page on localhost.\n")
        if not self.is_open:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "The viewer is starting; reload it soon.\n")
        return None


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


class Viewer:
    """Serves the connected browsers."""

    def __init__(self, server: Server, dataset: Dataset, run: LiveRun | None) -> None:
        self._server, self._run = server, run
        self._schedule = Schedule()
        self._ready_at = self._looked_at = -math.inf
        self._news = threading.Event()
        self._stage = Stage(server, dataset, has_run=run is not None)
        self._pictures: Iterator[None] = self._stage.pictures()
        server.on_client_connect(self._connect)
        server.on_client_disconnect(lambda client: self._schedule.forget(client.client_id))
        server.is_open = True

    def step(self, held: Held) -> None:
        """Does the most urgent piece of work, or waits a moment for one."""
        if not self._schedule.is_watched:
            self._wait(IDLE_S)
            return
        started, processor = time.monotonic(), time.process_time()
        if started < self._ready_at:
            self._wait(WAIT_S)
            return
        if started - self._looked_at >= LOOK_EVERY_S:
            self._looked_at = started
            self._look()
        job = self._schedule.next_job(time.monotonic())
        if job is not None:
            with contextlib.suppress(MovedOn):
                self._draw(job, lambda: held.number is None and self._schedule.is_wanted(job))
        elif next(self._pictures, self) is self:
            self._wait(WAIT_S)
        if self._run is not None and not self._run.is_trained:
            self._ready_at = time.monotonic() + (time.process_time() - processor) * (1 / TRAINING_SHARE - 1)

    def _look(self) -> None:
        """Reads newer weights, if there are any."""
        if self._run is None:
            return
        try:
            if self._run.refresh():
                self._schedule.redraw()
            self._stage.tell_run(f"{self._run.folder}: {self._run.status}")
        except HyalineError as error:
            self._stage.tell_run(str(error))

    def _draw(self, job: Job, is_wanted: Callable[[], bool]) -> None:
        started, picture, trouble = time.monotonic(), None, ""
        if self._run is not None:
            try:
                picture = self._run.draw(job.camera, is_quick=job.is_quick, is_wanted=is_wanted)
            except HyalineError as error:
                trouble = str(error)
        self._stage.tell_trouble(trouble)
        client = self._server.get_clients().get(job.client)
        if client is None:  # It disconnected before its last move was processed.
            self._schedule.forget(job.client)
        else:
            kind = "jpeg" if job.is_quick else "png"
            client.scene.set_background_image(picture, format=kind, jpeg_quality=JPEG_QUALITY)
            client.flush()
        self._schedule.finish(job, time.monotonic() - started)

    # Callbacks in viser's threads.

    def _connect(self, client: viser.ClientHandle) -> None:
        def moved(camera: viser.CameraHandle) -> None:
            pose = Pose(
                position=np.array(camera.position),
                wxyz=np.array(camera.wxyz),
                fov_y=camera.fov,
                window=(camera.image_width, camera.image_height),
            )
            self._schedule.move(client.client_id, pose, time.monotonic())
            self._news.set()

        client.camera.on_update(moved)
        moved(client.camera)

    def _wait(self, seconds: float) -> None:
        self._news.wait(seconds)
        self._news.clear()


def show(what: str, *, port: int, device: Device) -> None:
    """Shows a dataset, or a run's predictions as well, until a signal arrives.

    The run is only read from its folder; another process may be training it.

    Raises:
        HyalineError: neither a run nor a dataset is there, it cannot be shown, or the port is taken.
        Stopped: a signal has arrived.
    """
    run = next((place for place in (Path(what), RUNS / what) if (place / RUN).is_file()), None)
    if run is not None:
        record, opened = open_trained(run)
        live = LiveRun(run, record.config, opened, device=choose_device(device))
    else:
        place = find_dataset(what)
        if not (place / "dataset.json").is_file():
            raise HyalineError(
                f"{what}: neither a run nor a dataset; expected a folder such as runs/glass_table/paper or "
                "data/glass_table"
            )
        opened, live = open_dataset(place), None

    if live is not None:
        live.refresh()
    with serving(port, opened.name) as server:
        viewer = Viewer(server, opened, live)
        with hold_signals() as held:
            tell(f"http://{HOST}:{server.get_port()}")
            sys.stdout.flush()
            say(f"{what}: open the address in a browser; Ctrl-C stops the viewer")
            while held.number is None:
                viewer.step(held)
