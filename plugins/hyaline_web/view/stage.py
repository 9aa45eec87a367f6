"""The viewer's scene (the dataset's cameras with their pictures, and the meshes of one geometry) and its panel."""

import re
import threading
from collections.abc import Callable, Iterator

import numpy as np
import viser

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset, View
from datagen.data.geometries import list_geometries, read_meshes
from datagen.data.meshes import is_there
from datagen.data.paths import TRUTH, view_name
from datagen.disk.errors import HyalineError
from datagen.look.drawings import object_colors
from hyaline_web.view.schedule import window_pose

COLORS = {"train": (90, 140, 230), "interpolating": (70, 180, 110), "extrapolating": (220, 90, 80)}
"""Colours of camera frames by split."""
FRAME_SHARE = 0.05
"""Size of a camera's frame, relative to its distance from the centre of the scene."""
MOST_PIXELS = 160
"""Longer side of a picture in its frame; larger ones are subsampled."""
GLASS_OPACITY = 0.35


def as_text(text: str) -> str:
    """Markdown that shows a text as it is, such as a folder's name, and loads nothing."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


class Stage:
    """Shows a dataset in the viewer's scene."""

    def __init__(self, server: viser.ViserServer, dataset: Dataset, on_click: Callable[[View], None]) -> None:
        """Adds the cameras without pictures; meshes are only added by `show_meshes`.

        Args:
            on_click: called in a viser thread when a camera was clicked and the browser looks through it.
        """
        self._server, self._dataset, self._on_click = server, dataset, on_click
        meshes = read_meshes(dataset, TRUTH) if dataset.objects else ()  # Imported pictures may have none.
        corners = [mesh.vertices for mesh in meshes if is_there(mesh)] or [_places(dataset)]
        low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
        self.middle = (low + high).astype(np.float64) / 2
        first = dataset.view("interpolating" if "interpolating" in dataset.splits else dataset.splits[0], 0).camera
        # Before the frames: viser 1.1 sends at most 128 messages together, and its page places its camera once, when
        # the first batch arrives. If the camera's messages come later, it looks at the world's origin instead.
        server.initial_camera.position, _, server.initial_camera.fov = window_pose(first)
        server.initial_camera.look_at = self._ahead(first)
        server.initial_camera.up = (0.0, 0.0, 1.0)
        self._frames = [(view, self._add_frame(view)) for split in dataset.splits for view in dataset.views(split)]
        self._meshes: list[viser.MeshHandle] = []

    def show_cameras(self, is_shown: bool) -> None:
        for _, frame in self._frames:
            frame.visible = is_shown

    def show_meshes(self, geometry: str | None) -> None:
        """Replaces the shown meshes by those of this geometry; None: shows none."""
        meshes = () if geometry is None else read_meshes(self._dataset, geometry)
        for handle in self._meshes:
            handle.remove()
        colors = object_colors(len(self._dataset.objects))[1:]
        self._meshes = [
            self._server.scene.add_mesh_simple(
                f"/meshes/{item.name}",
                mesh.vertices,
                mesh.faces,
                color=color,
                opacity=GLASS_OPACITY if item.is_glass else None,
                side="double",
            )
            for item, mesh, color in zip(self._dataset.objects, meshes, colors)
            if is_there(mesh)
        ]

    def pictures(self) -> Iterator[None]:
        """Adds the pictures to the cameras' frames, one per step; views that are not built stay empty."""
        for view, frame in self._frames:
            try:
                picture = view.image
            except HyalineError:
                continue
            step = -(-max(picture.shape[:2]) // MOST_PIXELS)
            frame.image = picture[::step, ::step]
            yield

    def _add_frame(self, view: View) -> viser.CameraFrustumHandle:
        camera = view.camera
        position, wxyz, fov_y = window_pose(camera)
        frame = self._server.scene.add_camera_frustum(
            f"/cameras/{view.split}/{view_name(view.index)}",
            fov_y,
            camera.width / camera.height,
            scale=FRAME_SHARE * float(np.linalg.norm(position - self.middle)),
            thickness=1.5,
            thickness_units="screen",
            color=COLORS.get(view.split, COLORS["extrapolating"]),
            wxyz=wxyz,
            position=position,
        )

        @frame.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
            if event.client is not None:
                self._look_through(event.client, camera)
                self._on_click(view)

        return frame

    def _look_through(self, client: viser.ClientHandle, camera: Camera) -> None:
        position, wxyz, fov_y = window_pose(camera)
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = self._ahead(camera)
            client.camera.wxyz = wxyz
            client.camera.fov = fov_y

    def _ahead(self, camera: Camera) -> np.ndarray:
        """The point on a camera's axis to orbit: as far away as the centre of the scene."""
        position, forward = camera.world_from_camera[:3, 3], -camera.world_from_camera[:3, 2]
        return position + forward * max(float(np.linalg.norm(self.middle - position)), 1e-3)


def _places(dataset: Dataset) -> np.ndarray:
    """The positions of all cameras."""
    return np.concatenate([dataset.cameras(split).world_from_camera[:, :3, 3] for split in dataset.splits])


NO_MESHES = "none"


class Panel:
    """The controls, shared by all browsers; they change in viser's threads."""

    def __init__(
        self,
        server: viser.ViserServer,
        dataset: Dataset,
        *,
        has_run: bool,
        on_sight: Callable[[], None],
        on_cameras: Callable[[bool], None],
        on_meshes: Callable[[str | None], None],
    ) -> None:
        """
        Args:
            on_sight: called when the prediction is switched on or off.
            on_cameras: called with whether to show the dataset's cameras.
            on_meshes: called with the geometry whose meshes to show; it may raise a HyalineError.
        """
        gui, geometries = server.gui, list_geometries(dataset) if dataset.objects else []
        self._status, self._trouble = gui.add_markdown(as_text(dataset.name)), gui.add_markdown("", visible=False)
        self._prediction = gui.add_checkbox("prediction", has_run, visible=has_run)
        self._prediction.on_update(lambda _: on_sight())
        shown = NO_MESHES if has_run or not geometries else TRUTH  # Meshes and frames would cover the prediction.
        meshes = gui.add_dropdown("meshes", (NO_MESHES, *geometries), initial_value=shown)
        cameras = gui.add_checkbox("cameras", not has_run)
        self._view = gui.add_markdown("Click a camera to look through it.")
        self._truth: viser.GuiImageHandle | None = None
        self._gui = gui

        choosing = threading.Lock()

        def show_meshes(_: object) -> None:
            with choosing:  # Two threads would remove the same meshes, and the last choice might not be the last shown.
                try:
                    on_meshes(None if meshes.value == NO_MESHES else meshes.value)
                except HyalineError as error:
                    self.tell_trouble(str(error))

        meshes.on_update(show_meshes)
        on_meshes(None if shown == NO_MESHES else shown)
        cameras.on_update(lambda _: on_cameras(cameras.value))
        on_cameras(cameras.value)

    @property
    def shows_prediction(self) -> bool:
        """Whether the free camera shows what the run predicts."""
        return self._prediction.value

    def tell_run(self, status: str) -> None:
        """Shows the run's progress."""
        self._status.content = as_text(status)

    def tell_trouble(self, trouble: str) -> None:
        """Shows why there is no picture; empty: hides the message."""
        self._trouble.content, self._trouble.visible = as_text(trouble), bool(trouble)

    def show_view(self, view: View) -> None:
        """Shows the true picture of a view."""
        self._view.content = f"{view.split} view {view.index}: truth"
        try:
            picture = view.image
        except HyalineError:
            self._view.content = f"{view.split} view {view.index}: not built"
            return
        if self._truth is None:
            self._truth = self._gui.add_image(picture, format="png")
        self._truth.image = picture
