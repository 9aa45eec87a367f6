"""What the viewer shows: the dataset's cameras with their pictures, the meshes of one geometry, and a panel.

All browsers share it; viser calls its callbacks in threads of its own.
"""

import contextlib
import re
import threading
from collections.abc import Iterator

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
NO_MESHES = "none"


def as_text(text: str) -> str:
    """Markdown that shows a text as it is, such as a folder's name, and loads nothing."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


class Stage:
    """A dataset in the viewer's scene, and its controls."""

    def __init__(self, server: viser.ViserServer, dataset: Dataset, *, has_run: bool) -> None:
        """Adds the cameras without pictures, and the controls."""
        self._server, self._dataset, gui = server, dataset, server.gui
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
        self._meshes: list[viser.MeshHandle] = []
        self._choosing = threading.Lock()

        self._status, self._trouble = gui.add_markdown(as_text(dataset.name)), gui.add_markdown("", visible=False)
        geometries = list_geometries(dataset) if dataset.objects else []
        shown = NO_MESHES if has_run or not geometries else TRUTH  # Meshes and frames would cover the prediction.
        choice = gui.add_dropdown("meshes", (NO_MESHES, *geometries), initial_value=shown)
        choice.on_update(lambda _: self._show_meshes(choice.value))
        self._show_meshes(shown)
        cameras = gui.add_checkbox("cameras", not has_run)
        cameras.on_update(lambda _: self._show_cameras(cameras.value))
        self._show_cameras(cameras.value)
        gui.add_markdown("Click a camera to look through it.")

    def tell_run(self, status: str) -> None:
        """Shows the run's progress."""
        self._status.content = as_text(status)

    def tell_trouble(self, trouble: str) -> None:
        """Shows why there is no picture; empty: hides the message."""
        self._trouble.content, self._trouble.visible = as_text(trouble), bool(trouble)

    def pictures(self) -> Iterator[None]:
        """Adds the pictures to the cameras' frames, one per step; views that are not built stay empty."""
        for view, frame in self._frames:
            with contextlib.suppress(HyalineError):
                picture = view.image
                step = -(-max(picture.shape[:2]) // MOST_PIXELS)
                frame.image = picture[::step, ::step]
                yield

    def _show_cameras(self, is_shown: bool) -> None:
        for _, frame in self._frames:
            frame.visible = is_shown

    def _show_meshes(self, geometry: str) -> None:
        """Replaces the shown meshes by those of this geometry."""
        # Two threads would remove the same meshes, and the last choice might not be the last shown.
        with self._choosing:
            try:
                meshes = () if geometry == NO_MESHES else read_meshes(self._dataset, geometry)
            except HyalineError as error:
                self.tell_trouble(str(error))
                return
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
            color=COLORS.get(view.split, COLORS["extrapolating"]),
            wxyz=wxyz,
            position=position,
        )

        @frame.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
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
