"""`model view`: a dataset or a run in a browser; pictures are drawn one by one, only in the main thread."""

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import viser

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import Held, hold_signals, say, tell
from hyaline_web.view.live_run import LiveRun, MovedOn, Picture
from hyaline_web.view.schedule import Job, Pose, Schedule
from hyaline_web.view.server import HOST, Server, serving
from hyaline_web.view.stage import Panel, Stage
from model.run.run_folder import RUN, open_trained
from model.runtime import choose_device
from model.settings import RUNS, Device

TRAINING_SHARE = 0.09
"""Share of one core that this process takes while a run trains, for any number of browsers: it slows training by less
than a tenth, and takes nothing without a browser."""
LOOK_EVERY_S = 2.0
"""Seconds between two checks for newer weights."""
WAIT_S, IDLE_S = 0.05, 0.5
"""Seconds to wait for work with a connected browser, and without one."""
JPEG_QUALITY = 85
"""Quality of pictures while a camera moves; the others are sent losslessly."""


class Viewer:
    """Serves the connected browsers."""

    def __init__(self, server: Server, dataset: Dataset, run: LiveRun | None) -> None:
        self._server, self._run = server, run
        self._schedule = Schedule()
        self._ready_at = self._looked_at = -math.inf
        self._news = threading.Event()
        self._stage = Stage(server, dataset, lambda view: self.panel.show_view(view))
        self.panel = Panel(
            server,
            dataset,
            has_run=run is not None,
            on_sight=self._redraw,
            on_cameras=self._stage.show_cameras,
            on_meshes=self._stage.show_meshes,
        )
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
            self.panel.tell_run(f"{self._run.folder}: {self._run.status}")
        except HyalineError as error:
            self.panel.tell_run(str(error))

    def _draw(self, job: Job, is_wanted: Callable[[], bool]) -> None:
        started = time.monotonic()
        try:
            picture, trouble = self._picture(job, is_wanted), ""
        except HyalineError as error:
            picture, trouble = None, str(error)
        self.panel.tell_trouble(trouble)
        client = self._server.get_clients().get(job.client)
        if client is None:  # It disconnected before its last move was processed.
            self._schedule.forget(job.client)
        else:
            kind = "jpeg" if job.is_quick else "png"
            client.scene.set_background_image(picture, format=kind, jpeg_quality=JPEG_QUALITY)
            client.flush()
        self._schedule.finish(job, time.monotonic() - started)

    def _picture(self, job: Job, is_wanted: Callable[[], bool]) -> Picture | None:
        if self._run is None or not self.panel.shows_prediction:
            return None
        return self._run.draw(job.camera, is_quick=job.is_quick, is_wanted=is_wanted)

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

    def _redraw(self) -> None:
        self._schedule.redraw()
        self._news.set()

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
