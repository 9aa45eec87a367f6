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
import os
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server
from PIL import ImageColor
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset, View, open_dataset
from datagen.data.geometries import read_meshes
from datagen.data.meshes import is_there
from datagen.data.paths import TRUTH, find_dataset, view_name
from datagen.disk.errors import HyalineError
from datagen.look.drawings import object_colors
from datagen.pages.charts import COLORS
from datagen.terminal.command import Held, hold_signals, say, tell
from eval.score.metrics import psnr
from hyaline_web.view.live_run import Job, LiveRun, MovedOn, Picture, Pose, Schedule, window_pose
from model.run.run_folder import RUN, open_trained
from model.runtime import choose_device
from model.settings import RUNS, Device

HOST = "127.0.0.1"
NAMES = (HOST, "localhost", "::1")
"""What a browser may call this machine; the port may be another, through `ssh -L`."""
UNFRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
"""Headers that forbid other pages to show the viewer's inside of them."""
LOOK_EVERY_S = 2.0
"""Seconds between two checks for newer weights."""
WAIT_S, IDLE_S = 0.05, 0.5
"""Seconds to wait for work with a connected browser, and without one."""


class Server(viser.ViserServer):
    """A viser server that only answers its own page."""

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


# What is shown: all browsers share it, and viser calls its callbacks in threads of its own

FRAME_SHARE = 0.05
"""Size of a camera's frame, relative to its distance from the centre of the scene."""
MOST_PIXELS = 160
"""Longer side of a picture in its frame; larger ones are subsampled."""
GLASS_OPACITY = 0.35
FIRST = (
    "Drawing the first picture ...",
    "It may take a minute; of a run in training, it comes with its first checkpoint.",
)
"""Title and text of the notification until a browser has its first picture."""


def as_text(text: str) -> str:
    """Markdown that shows a text as it is, such as a folder's name, and loads nothing."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def split_color(dataset: Dataset, split: str) -> str:
    """The colour of a split's cameras, as `datagen look` draws them."""
    return COLORS[[*dataset.splits].index(split) % len(COLORS)]


class Stage:
    """A dataset in the viewer's scene, and its controls."""

    def __init__(self, server: viser.ViserServer, dataset: Dataset, *, has_run: bool) -> None:
        """Adds the cameras without pictures, and the controls."""
        self._server, gui = server, server.gui
        self.asked: View | None = None
        """A view whose camera was clicked, and which the panel does not show yet."""
        self._shown: viser.GuiImageHandle | None = None
        meshes = read_meshes(dataset, TRUTH) if dataset.objects else ()  # Imported pictures may have none.
        places = [dataset.cameras(split).world_from_camera[:, :3, 3] for split in dataset.splits]
        corners = np.concatenate([mesh.vertices for mesh in meshes if is_there(mesh)] or places)
        self._middle = (corners.min(axis=0) + corners.max(axis=0)).astype(np.float64) / 2
        first = dataset.view("interpolating" if "interpolating" in dataset.splits else dataset.splits[0], 0).camera
        # Before the frames: viser 1.1 sends at most 128 messages together, and its page places its camera once, when
        # the first batch arrives. If the camera's messages come later, it looks at the world's origin instead.
        server.initial_camera.position, _, server.initial_camera.fov = window_pose(first)
        server.initial_camera.look_at = self._ahead(first)
        server.initial_camera.up = (0.0, 0.0, 1.0)
        self._frames = [(view, self._add_frame(view)) for split in dataset.splits for view in dataset.views(split)]
        colors = object_colors(len(dataset.objects))[1:]
        solids = [
            server.scene.add_mesh_simple(
                f"/meshes/{item.name}",
                mesh.vertices,
                mesh.faces,
                color=color,
                opacity=GLASS_OPACITY if item.is_glass else None,
                side="double",
            )
            for item, mesh, color in zip(dataset.objects, meshes, colors)
            if is_there(mesh)
        ]
        self._status, self._trouble = gui.add_markdown(as_text(dataset.name)), gui.add_markdown("", visible=False)
        for label, handles in (("meshes", solids), ("cameras", [frame for _, frame in self._frames])):
            self._add_switch(label, handles, is_on=not has_run)  # They would cover the prediction.
        splits = (f'<b style="color: {split_color(dataset, split)}">■</b> {split}' for split in dataset.splits)
        gui.add_html(
            "<style>label { color: var(--mantine-color-text); opacity: 1 }</style>"  # viser's are too pale.
            f'<p style="margin: 8px 12px; font-size: .8em">Click a camera to look through it: {", ".join(splits)}</p>'
        )

    def tell_run(self, status: str) -> None:
        """Shows the run's progress."""
        self._status.content = as_text(status)

    def tell_trouble(self, trouble: str) -> None:
        """Shows why there is no picture; empty: hides the message."""
        self._trouble.content, self._trouble.visible = as_text(trouble), bool(trouble)

    def show(self, view: View, picture: Picture | None) -> None:
        """Shows a view's truth in the panel, and below it a prediction and its error as reports draw it."""
        truth = view.image
        pictures = [truth]
        label = f"{view.split} {view.index}: truth"
        if picture is not None:
            errors = 8 * np.abs(picture.astype(np.int32) - truth)
            pictures += [picture, errors.clip(max=255).astype(np.uint8)]
            label += f", prediction ({psnr(picture, truth):.2f} dB), error × 8"  # noqa: RUF001
        times = -(-256 // truth.shape[1])  # At least as wide as in reports.
        if self._shown is not None:
            self._shown.remove()
        enlarged = np.concatenate(pictures).repeat(times, axis=0).repeat(times, axis=1)
        self._shown = self._server.gui.add_image(enlarged, label=label, format="png")

    def pictures(self) -> Iterator[None]:
        """Adds the pictures to the cameras' frames, one per step; views that are not built stay empty."""
        for view, frame in self._frames:
            with contextlib.suppress(HyalineError):
                picture = view.image
                step = -(-max(picture.shape[:2]) // MOST_PIXELS)
                frame.image = picture[::step, ::step]
                yield

    def _add_switch(self, label: str, handles: Sequence[viser.SceneNodeHandle], *, is_on: bool) -> None:
        """A check box that shows or hides parts of the scene."""
        box = self._server.gui.add_checkbox(label, is_on)

        def show(_: object = None) -> None:
            for handle in handles:
                handle.visible = box.value

        box.on_update(show)
        show()

    def _add_frame(self, view: View) -> viser.CameraFrustumHandle:
        camera = view.camera
        position, wxyz, fov_y = window_pose(camera)
        frame = self._server.scene.add_camera_frustum(
            f"/cameras/{view.split}/{view_name(view.index)}",
            fov_y,
            camera.width / camera.height,
            scale=FRAME_SHARE * float(np.linalg.norm(position - self._middle)),
            thickness=1.5,
            thickness_units="screen",
            color=ImageColor.getrgb(split_color(view.dataset, view.split))[:3],
            wxyz=wxyz,
            position=position,
        )

        @frame.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
            self.asked = view
            if event.client is not None:
                with event.client.atomic():
                    looking = event.client.camera
                    looking.position, looking.look_at = position, self._ahead(camera)
                    looking.wxyz, looking.fov = wxyz, fov_y

        return frame

    def _ahead(self, camera: Camera) -> np.ndarray:
        """The point on a camera's axis to orbit: as far away as the centre of the scene."""
        position, forward = camera.world_from_camera[:3, 3], -camera.world_from_camera[:3, 2]
        return position + forward * max(float(np.linalg.norm(self._middle - position)), 1e-3)


class Viewer:
    """Serves the connected browsers."""

    def __init__(self, server: Server, dataset: Dataset, run: LiveRun | None) -> None:
        self._server, self._run = server, run
        self._schedule = Schedule()
        self._looked_at = -math.inf
        self._news = threading.Event()
        self._notes: dict[int, viser.NotificationHandle] = {}
        self.stage = Stage(server, dataset, has_run=run is not None)
        self._pictures: Iterator[None] = self.stage.pictures()
        server.on_client_connect(self._connect)
        server.on_client_disconnect(lambda client: self._schedule.forget(client.client_id))

    def step(self, held: Held) -> None:
        """Does the most urgent piece of work, or waits a moment for one."""
        if not self._schedule.is_watched:
            self._wait(IDLE_S)
            return
        if time.monotonic() - self._looked_at >= LOOK_EVERY_S:
            self._looked_at = time.monotonic()
            self._look()
        job = self._schedule.next_job(time.monotonic())
        if job is not None:
            with contextlib.suppress(MovedOn):
                self._draw(job, lambda: held.number is None and self._schedule.is_wanted(job))
        elif self.stage.asked is not None:
            self._compare(held)
        elif next(self._pictures, self) is self:
            self._wait(WAIT_S)

    def _look(self) -> None:
        """Reads newer weights, if there are any."""
        if self._run is None:
            return
        try:
            if self._run.refresh():
                self._schedule.redraw()
            self.stage.tell_run(f"{self._run.folder}: {self._run.status}")
        except HyalineError as error:
            self.stage.tell_run(str(error))

    def _draw(self, job: Job, is_wanted: Callable[[], bool]) -> None:
        picture, trouble = None, ""
        if self._run is not None:
            try:
                picture = self._run.draw(job.camera, is_quick=job.is_quick, is_wanted=is_wanted)
            except HyalineError as error:
                trouble = str(error)
        self.stage.tell_trouble(trouble)
        client = self._server.get_clients().get(job.client)
        if client is None:  # It disconnected before its last move was processed.
            self._schedule.forget(job.client)
        else:
            if (picture is not None or trouble) and job.client in self._notes:
                self._notes.pop(job.client).remove()
            client.scene.set_background_image(picture, format="png")
            client.flush()
        self._schedule.finish(job)

    def _compare(self, held: Held) -> None:
        """Shows the view that was asked for beside its truth, as far as both are there."""
        view, self.stage.asked = self.stage.asked, None
        assert view is not None
        with contextlib.suppress(MovedOn, HyalineError):
            picture = None
            if self._run is not None:
                picture = self._run.draw(view.camera, is_quick=False, is_wanted=lambda: held.number is None)
            self.stage.show(view, picture)

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

        if self._run is not None:
            self._notes[client.client_id] = client.add_notification(*FIRST, loading=True, with_close_button=False)
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
        if not live.is_trained:
            os.nice(19)  # Training comes first.
    with serving(port, opened.name) as server:
        viewer = Viewer(server, opened, live)
        with hold_signals() as held:
            tell(f"http://{HOST}:{server.get_port()}")
            sys.stdout.flush()
            say(f"{what}: open the address in a browser; Ctrl-C stops the viewer")
            while held.number is None:
                viewer.step(held)
